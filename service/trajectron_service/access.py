"""Which scope each call needs, on both transports. What is not listed needs ``admin``."""

from __future__ import annotations

from trajectron_service.tenancy import Scope

OPEN = None
"""Anybody may call: probes, and descriptions of the public contract."""

RPCS: dict[str, Scope] = {
    "Predict": Scope.PREDICT,
    "ListModels": Scope.PREDICT,
    "CreateSession": Scope.SESSIONS,
    "GetSession": Scope.SESSIONS,
    "ListSessions": Scope.SESSIONS,
    "DeleteSession": Scope.SESSIONS,
    "Observe": Scope.SESSIONS,
    "PredictSession": Scope.SESSIONS,
    "StreamPredict": Scope.SESSIONS,
    "CreateEvaluation": Scope.EVALUATE,
    "GetEvaluation": Scope.EVALUATE,
    "ListEvaluations": Scope.EVALUATE,
    "WatchEvaluation": Scope.EVALUATE,
    "CancelEvaluation": Scope.EVALUATE,
    "DeleteEvaluation": Scope.EVALUATE,
    "GetEvaluationResult": Scope.EVALUATE,
}

# A path belongs to the first rule that is the path itself, or a folder that it lies in.
PATHS: tuple[tuple[str, Scope | None], ...] = (
    ("/healthz", OPEN),
    ("/readyz", OPEN),
    ("/openapi.json", OPEN),
    ("/docs", OPEN),
    ("/", OPEN),
    ("/metrics", Scope.ADMIN),
    ("/predict", Scope.PREDICT),
    ("/v1/predict", Scope.PREDICT),
    ("/v1/models", Scope.PREDICT),
    ("/v1/sessions", Scope.SESSIONS),
    ("/v1/evaluations", Scope.EVALUATE),
)


def declared(path: str) -> bool:
    """Whether there is a rule for a path."""
    return any(_covers(rule, path) for rule, _ in PATHS)


def scope_of_path(path: str) -> Scope | None:
    """What a call of a path needs, None for nothing."""
    for rule, scope in PATHS:
        if _covers(rule, path):
            return scope
    return Scope.ADMIN


def scope_of_rpc(method: str) -> Scope:
    """What a call of an RPC of ours needs."""
    return RPCS.get(method, Scope.ADMIN)


def _covers(rule: str, path: str) -> bool:
    return path == rule or (rule != "/" and path.startswith(rule + "/"))
