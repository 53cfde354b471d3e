"""What ``trajectron_client`` exports, and what it does not drag in."""

from __future__ import annotations

import subprocess
import sys

import trajectron_client

EXPORTED = [
    "Access",
    "Agent",
    "AgentForecast",
    "AsyncClient",
    "AsyncHttpClient",
    "AsyncSession",
    "AsyncStream",
    "CancelledError",
    "Client",
    "ConflictError",
    "DatasetUnavailableError",
    "DeadlineExceededError",
    "Delivery",
    "DrainingError",
    "Evaluation",
    "EvaluationExistsError",
    "EvaluationOptions",
    "EvaluationProgress",
    "EvaluationState",
    "Forecast",
    "ForecastMode",
    "ForecastOptions",
    "Frame",
    "FrameConflictError",
    "FrameOutOfOrderError",
    "FrameResult",
    "GraphEdge",
    "GraphNode",
    "HttpClient",
    "InternalError",
    "InvalidArgumentError",
    "MalformedError",
    "ModelInfo",
    "NoFramesError",
    "NoResultError",
    "NotFoundError",
    "Outcome",
    "OverloadedError",
    "PermissionDeniedError",
    "RateLimitedError",
    "RecordingFile",
    "ResourceExhaustedError",
    "Sampling",
    "SceneGraph",
    "ServiceError",
    "Session",
    "SessionDamagedError",
    "SessionExistsError",
    "SessionInfo",
    "SessionLostError",
    "SessionOptions",
    "SessionSnapshot",
    "StoreUnavailableError",
    "Stream",
    "StreamFrame",
    "StreamReply",
    "TooLargeError",
    "TooManyEvaluationsError",
    "TooManySessionsError",
    "TooManyStreamsError",
    "TrajectronError",
    "TransportError",
    "UnauthenticatedError",
    "UnknownAgentError",
    "UnknownEvaluationError",
    "UnknownModelError",
    "UnknownSessionError",
    "UnknownTypes",
    "Violation",
]


def test_exported_names_are_pinned() -> None:
    assert trajectron_client.__all__ == EXPORTED
    assert all(hasattr(trajectron_client, name) for name in EXPORTED)


def test_every_error_is_a_trajectron_error() -> None:
    errors = [getattr(trajectron_client, name) for name in EXPORTED if name.endswith("Error")]
    assert all(issubclass(error, trajectron_client.TrajectronError) for error in errors)
    assert not issubclass(trajectron_client.TransportError, trajectron_client.ServiceError)


def test_importing_the_client_imports_neither_torch_nor_the_service() -> None:
    script = (
        "import sys, trajectron_client\n"
        "roots = {name.partition('.')[0] for name in sys.modules}\n"
        "print(sorted(roots & {'torch', 'scipy', 'fastapi', 'pydantic', 'matplotlib',\n"
        "                      'trajectron_service', 'trajectron_model'}))\n"
        "sys.exit('trajectron_client' not in roots)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", script],
        env={"PYTHONPATH": ":".join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.strip() == "[]"
