"""Who is let in: a bearer's token, the scope that a call needs, and how often it may call."""

from __future__ import annotations

import asyncio
import time
import weakref
from collections.abc import Callable

from trajectron_service import logs, passes, tenancy
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.metrics import Metrics
from trajectron_service.passes import Pass
from trajectron_service.tenancy import Scope
from trajectron_service.tokens import Token, Tokens

_SCHEME = "bearer"
# How often the file is looked at, and passes are checked.
LOOK_S = 1.0
# A tenant may save up a second's worth of requests, one at least.
_BURST_S = 1.0

log = logs.get(__name__)


class Admission:
    """The gate that both transports ask before the core.

    Args:
        tokens: None lets everybody in, as the one default tenant.
        metrics: told of those refused.
        clock: seconds that never go back.
    """

    def __init__(
        self,
        tokens: Tokens | None,
        metrics: Metrics,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._tokens = tokens
        self._metrics = metrics
        self._clock = clock
        self._buckets: dict[str, _Bucket] = {}
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
            self._count(token)
        except ServiceError as error:
            self._metrics.refusals.labels(error.kind.value).inc()
            raise
        tenancy.enter(token.tenant)
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

    def _count(self, token: Token) -> None:
        if token.requests_per_s is None:
            return
        bucket = self._buckets.get(token.sha256)
        if bucket is None or bucket.rate != token.requests_per_s:
            bucket = self._buckets[token.sha256] = _Bucket(token.requests_per_s, self._clock())
        wait_s = bucket.take(self._clock())
        if wait_s > 0.0:
            raise ServiceError(
                ErrorKind.RATE_LIMITED,
                f"this token may make {token.requests_per_s:g} requests a second",
                retry_after_s=wait_s,
            )


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


class _Bucket:
    """Fills at ``rate`` a second up to a burst; each call takes one out."""

    def __init__(self, rate: float, now: float) -> None:
        self.rate = rate
        self._most = max(1.0, rate * _BURST_S)
        self._level = self._most
        self._filled_at = now

    def take(self, now: float) -> float:
        """0 where there was one to take, else the seconds until there will be."""
        self._level = min(self._most, self._level + (now - self._filled_at) * self.rate)
        self._filled_at = now
        if self._level >= 1.0:
            self._level -= 1.0
            return 0.0
        return (1.0 - self._level) / self.rate
