"""Who is let in: a bearer's token, the scope that a call needs, and how often it may call."""

from __future__ import annotations

import asyncio
import weakref

from trajectron_service import logs, passes, tenancy
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.metrics import Metrics
from trajectron_service.passes import Pass
from trajectron_service.quotas import Rate, Usage
from trajectron_service.tenancy import Scope
from trajectron_service.tokens import Token, Tokens

_SCHEME = "bearer"
# How often the file is looked at, and passes are checked.
LOOK_S = 1.0

log = logs.get(__name__)


class Admission:
    """The gate that both transports ask before the core.

    Args:
        tokens: None lets everybody in, as the one default tenant.
        metrics: told of those refused.
        usage: counts the calls of each tenant.
    """

    def __init__(
        self,
        tokens: Tokens | None,
        metrics: Metrics,
        usage: Usage,
    ) -> None:
        self._tokens = tokens
        self._metrics = metrics
        self._usage = usage
        self._passes: weakref.WeakSet[Pass] = weakref.WeakSet()
        if tokens is not None:
            metrics.tokens.set_function(lambda: len(tokens))
            metrics.tokens_stale.set_function(lambda: float(tokens.stale))

    def admit(self, authorization: str | None, scope: Scope | None) -> None:
        """Lets a call in, and has the running task work for its tenant, under a pass.

        Args:
            authorization: the header or metadata of that name, ``Bearer TOKEN``.
            scope: what the call needs; None where anybody may come in.

        Raises:
            ServiceError: UNAUTHENTICATED, PERMISSION_DENIED, RATE_LIMITED.
        """
        if self._tokens is None or scope is None:
            return
        try:
            token = self._bearer(self._tokens, authorization)
            refusal = _beyond(token, scope)
            if refusal is not None:
                raise refusal
            tenancy.enter(token.tenant)
            self._usage.take(Rate.REQUESTS)
        except ServiceError as error:
            self._metrics.refusals.labels(error.kind.value).inc()
            raise
        held = _pass(self._tokens, token, scope)
        self._passes.add(held)
        passes.enter(held)

    def reload(self) -> None:
        """Reads the file of tokens again, where there is one, and ends streams accordingly."""
        if self._tokens is not None:
            self._tokens.reload()
            self._check()

    def look(self) -> None:
        """Sees whether the file has changed, and ends streams whose token is not good any more."""
        if self._tokens is not None:
            self._tokens.look()
            self._check()

    async def keep_watch(self) -> None:
        """Looks every second (``LOOK_S``), until cancelled."""
        while True:
            await asyncio.sleep(LOOK_S)
            try:
                self.look()
            except Exception:
                log.exception("tokens not looked at")

    def _check(self) -> None:
        ended = sum(held.check() for held in list(self._passes))
        if ended:
            log.info("streams ended, their tokens are not good any more", count=ended)

    def _bearer(self, tokens: Tokens, authorization: str | None) -> Token:
        scheme, _, presented = (authorization or "").partition(" ")
        found = tokens.find(presented.strip()) if scheme.lower() == _SCHEME else None
        if found is None:
            raise ServiceError(
                ErrorKind.UNAUTHENTICATED,
                "a valid token is required: send `authorization: Bearer TOKEN`",
            )
        return found


def _pass(tokens: Tokens, token: Token, scope: Scope) -> Pass:
    def fault() -> ServiceError | None:
        now = tokens.again(token)
        if now is None:
            return ServiceError(
                ErrorKind.UNAUTHENTICATED,
                "the token that this was opened with has expired or was withdrawn",
            )
        return _beyond(now, scope)

    return Pass(fault)


def _beyond(token: Token, scope: Scope) -> ServiceError | None:
    """The refusal where the token is not good for the scope."""
    if scope in token.scopes:
        return None
    return ServiceError(
        ErrorKind.PERMISSION_DENIED, f"this token has no scope {scope.value}, which the call needs"
    )
