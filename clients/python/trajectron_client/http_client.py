"""The clients over HTTP: no streams of forecasts, for where only HTTP gets through."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx
from httpx_sse import SSEError, aconnect_sse, connect_sse

from trajectron_client import http_errors, http_events
from trajectron_client.access import Access
from trajectron_client.async_calls import AsyncCalls
from trajectron_client.evaluation_operations import path
from trajectron_client.evaluations import Evaluation
from trajectron_client.exceptions import (
    DeadlineExceededError,
    TransportError,
)
from trajectron_client.operations import Operation
from trajectron_client.sync_calls import SyncCalls

T = TypeVar("T")

# Attempts to connect, not to send: nothing that may have arrived is sent again.
_CONNECT_RETRIES = 2
_READY_POLL_S = 0.1


class HttpClient(SyncCalls):
    """The service over HTTP, synchronous; safe to share between threads.

    Args:
        base_url: where the service answers.
        timeout_s: for calls that bring none of their own: how long connecting may take, and how
            long any wait for the answer; None for as long as it takes.
        access: token and certificates for a protected service.
        headers: sent with every call.
        transport: your own httpx transport, for TLS settings or proxies.
    """

    def __init__(
        self,
        base_url: str = "http://127.0.0.1:8000",
        *,
        timeout_s: float | None = 10.0,
        access: Access | None = None,
        headers: Mapping[str, str] | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self._timeout_s = timeout_s
        access = access or Access()
        verify = access.ssl_context() if base_url.startswith("https:") else True
        self._http = httpx.Client(
            base_url=base_url,
            headers={**access.headers, **(headers or {})},
            transport=transport or httpx.HTTPTransport(verify=verify, retries=_CONNECT_RETRIES),
        )

    def close(self) -> None:
        """Closes the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def is_ready(self, *, timeout_s: float | None = None) -> bool:
        """Whether the service takes work now; False as well when it cannot be reached."""
        try:
            with _translated():
                timeout = _first(timeout_s, self._timeout_s)
                return self._http.get("/readyz", timeout=timeout).is_success
        except (TransportError, DeadlineExceededError):
            return False

    def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Returns once the service takes work; raises ``DeadlineExceededError`` otherwise."""
        deadline = time.monotonic() + timeout_s
        while not self.is_ready(timeout_s=max(deadline - time.monotonic(), _READY_POLL_S)):
            if time.monotonic() >= deadline:
                raise _not_ready(timeout_s)
            time.sleep(_READY_POLL_S)

    def watch_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> Iterator[Evaluation]:
        """See ``SyncEvaluations``."""
        where = f"{path(evaluation_id)}:watch"
        timeout = http_events.timeout(timeout_s, self._timeout_s)
        with _translated(), connect_sse(self._http, "GET", where, timeout=timeout) as events:
            if not events.response.is_success:
                events.response.read()
                raise http_errors.from_response(events.response)
            for event in events.iter_sse():
                yield http_events.evaluation(event)

    def _run(self, operation: Operation[T], timeout_s: float | None) -> T:
        with _translated():
            response = self._http.request(
                operation.verb, timeout=_first(timeout_s, self._timeout_s), **_request(operation)
            )
        return _answer(operation, response)


class AsyncHttpClient(AsyncCalls):
    """The service over HTTP, for asyncio.

    Args:
        base_url: where the service answers.
        timeout_s: for calls that bring none of their own: how long connecting may take, and how
            long any wait for the answer; None for as long as it takes.
        access: token and certificates for a protected service.
        headers: sent with every call.
        transport: your own httpx transport, for TLS settings or proxies.
    """

    def __init__(
        self,
        base_url: str = "http://127.0.0.1:8000",
        *,
        timeout_s: float | None = 10.0,
        access: Access | None = None,
        headers: Mapping[str, str] | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._timeout_s = timeout_s
        access = access or Access()
        verify = access.ssl_context() if base_url.startswith("https:") else True
        self._http = httpx.AsyncClient(
            base_url=base_url,
            headers={**access.headers, **(headers or {})},
            transport=transport
            or httpx.AsyncHTTPTransport(verify=verify, retries=_CONNECT_RETRIES),
        )

    async def close(self) -> None:
        """Closes the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def is_ready(self, *, timeout_s: float | None = None) -> bool:
        """Whether the service takes work now; False as well when it cannot be reached."""
        try:
            with _translated():
                timeout = _first(timeout_s, self._timeout_s)
                return (await self._http.get("/readyz", timeout=timeout)).is_success
        except (TransportError, DeadlineExceededError):
            return False

    async def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Returns once the service takes work; raises ``DeadlineExceededError`` otherwise."""
        try:
            async with asyncio.timeout(timeout_s):
                while not await self.is_ready():  # noqa: ASYNC110  the event is elsewhere
                    await asyncio.sleep(_READY_POLL_S)
        except TimeoutError:
            raise _not_ready(timeout_s) from None

    async def watch_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> AsyncIterator[Evaluation]:
        """See ``AsyncEvaluations``."""
        where = f"{path(evaluation_id)}:watch"
        timeout = http_events.timeout(timeout_s, self._timeout_s)
        with _translated():
            async with aconnect_sse(self._http, "GET", where, timeout=timeout) as events:
                if not events.response.is_success:
                    await events.response.aread()
                    raise http_errors.from_response(events.response)
                async with contextlib.aclosing(events.aiter_sse()) as told:
                    async for event in told:
                        yield http_events.evaluation(event)

    async def _run(self, operation: Operation[T], timeout_s: float | None) -> T:
        with _translated():
            response = await self._http.request(
                operation.verb, timeout=_first(timeout_s, self._timeout_s), **_request(operation)
            )
        return _answer(operation, response)


def _request(operation: Operation[Any]) -> dict[str, Any]:
    headers = dict(operation.headers)
    request: dict[str, Any] = {"url": operation.path, "params": operation.params}
    body = operation.body()
    if body is None:
        return request | {"headers": headers}
    # Not httpx's own encoder: it refuses NaN, which is the service's to refuse, by field.
    text = json.dumps(body)
    field, files = operation.files()
    if files:
        form = [(field, (None, text, "application/json")), *(("files", file) for file in files)]
        return request | {"files": form, "headers": headers}
    return request | {"content": text, "headers": headers | {"content-type": "application/json"}}


def _answer(operation: Operation[T], response: httpx.Response) -> T:
    if not response.is_success:
        raise http_errors.from_response(response)
    if operation.raw:
        return operation.from_body(response.content)
    return operation.from_body(response.json() if response.content else None)


def _first(timeout_s: float | None, default_s: float | None) -> float | None:
    return default_s if timeout_s is None else timeout_s


def _not_ready(timeout_s: float) -> DeadlineExceededError:
    return DeadlineExceededError(
        f"the service was not ready within {timeout_s} s", reason="DEADLINE_EXCEEDED"
    )


@contextlib.contextmanager
def _translated() -> Iterator[None]:
    try:
        yield
    except (httpx.HTTPError, SSEError) as error:
        raise http_errors.from_httpx(error) from error
