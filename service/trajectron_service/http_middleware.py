"""What every HTTP request goes through: an id, a log line, a measurement, a last safety net."""

from __future__ import annotations

import asyncio
import re
import time
import uuid

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from structlog.contextvars import bound_contextvars

from trajectron_service import logs
from trajectron_service.access import scope_of_path
from trajectron_service.admission import Admission
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.http_errors import problem_response
from trajectron_service.metrics import Metrics
from trajectron_service.tracing import CARRIED, TRACEPARENT, Call

REQUEST_ID = "X-Request-Id"
# Probes and scrapes come all the time and say nothing.
_QUIET = frozenset({"/healthz", "/readyz", "/metrics"})
# A client may send any word as a verb; not each may become a label.
_VERBS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
# Ids of clients go into our log: short, and of letters that cannot forge a line.
_ID = re.compile(r"[A-Za-z0-9._:/+=-]{1,128}")

_FAULT = ServiceError(ErrorKind.INTERNAL, "a fault of the service; its log has more")
_STOPPED = ServiceError(ErrorKind.DRAINING, "the service stopped before the work was done")

log = logs.get(__name__)


class RequestMiddleware:
    """Pure ASGI, so that a client's hanging up still reaches the routes.

    Args:
        app: what answers.
        metrics: where durations go, by the route's template and not by its path.
        admission: who is let in.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, admission: Admission) -> None:
        self._admission = admission
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI's entry."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        carried = {name: value for name in CARRIED if (value := Headers(scope=scope).get(name))}
        call = self._metrics.tracing.call("http", scope["method"], carried)
        sender = _Sender(send, _request_id(scope), call.traceparent)
        start = time.perf_counter()
        with bound_contextvars(request_id=sender.request_id):
            try:
                needed = scope_of_path(scope["path"])
                self._admission.admit(Headers(scope=scope).get("authorization"), needed)
                await self._app(scope, receive, sender)
            except ServiceError as error:
                # Not let in; errors of the routes are answered further in.
                await sender.fail(scope, receive, error)
            except asyncio.CancelledError:
                # Requests are cancelled only when a stop has run out of grace.
                await sender.fail(scope, receive, _STOPPED)
            except Exception:
                log.exception("fault", protocol="http", path=scope["path"])
                await sender.fail(scope, receive, _FAULT)
            finally:
                self._note(scope, sender.status, time.perf_counter() - start, call)

    def _note(self, scope: Scope, status: int, duration_s: float, call: Call) -> None:
        template = getattr(scope.get("route"), "path", "unknown")
        verb = scope["method"] if scope["method"] in _VERBS else "other"
        method = f"{verb} {template}"
        self._metrics.request("http", method, str(status), duration_s)
        call.end(method, str(status), failed=status >= 500)
        if template not in _QUIET:
            log.info(
                "call",
                protocol="http",
                method=method,
                path=scope["path"],
                code=status,
                duration_s=round(duration_s, 6),
            )


class _Sender:
    """Sends an answer with the request's id, and remembers its status."""

    def __init__(self, send: Send, request_id: str, traceparent: str | None) -> None:
        self.request_id = request_id
        self.status = 499  # until an answer starts: the client has gone
        self._send = send
        self._traceparent = traceparent
        self._started = False

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self._started = True
            self.status = message["status"]
            headers = MutableHeaders(scope=message)
            headers[REQUEST_ID] = self.request_id
            if self._traceparent is not None:
                headers[TRACEPARENT] = self._traceparent
        await self._send(message)

    async def fail(self, scope: Scope, receive: Receive, error: ServiceError) -> None:
        """Answers with an error unless an answer has begun, which then just breaks off."""
        if not self._started:
            await problem_response(error)(scope, receive, self)


def _request_id(scope: Scope) -> str:
    given = Headers(scope=scope).get(REQUEST_ID, "")
    return given if _ID.fullmatch(given) else uuid.uuid4().hex
