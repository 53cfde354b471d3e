"""Reads request bodies: within a limit, while the client is still there."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from contextlib import AbstractContextManager
from typing import Any, TypeVar

from pydantic import ValidationError
from starlette.requests import ClientDisconnect, Request

from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.http_errors import invalid_body
from trajectron_service.http_schemas import Body
from trajectron_service.metrics import Metrics, Stage

# Most clients look for an answer only after sending all: a body that is too large is read on,
# and thrown away, up to this many times the limit.
_PATIENCE = 16

B = TypeVar("B", bound=Body)
T = TypeVar("T")


class Arriving:
    """Bytes of bodies that are being received, all requests together.

    Args:
        limit_bytes: at most so many; not less than one body may have.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._held = 0

    def take(self, size: int) -> None:
        """Counts more bytes in; raises ``OVERLOADED`` where that would be too many."""
        if self._held + size > self._limit:
            raise ServiceError(
                ErrorKind.OVERLOADED,
                "the service is receiving too much at once; try again later",
                retry_after_s=1.0,
            )
        self._held += size

    def give_back(self, size: int) -> None:
        """Counts bytes out again."""
        self._held -= size


async def read_body(request: Request, shape: type[B], limit_bytes: int) -> B:
    """A request's body in its shape; an empty one is an empty object.

    Raises:
        ServiceError: ``TOO_LARGE`` for more than ``limit_bytes``, of which no more are kept;
            ``MALFORMED`` for what is no JSON; ``INVALID_ARGUMENT`` naming the fields.
    """
    raw = await read_raw(request, limit_bytes)
    with timed(request, "decode"):
        return parse_body(raw, shape)


def timed(request: Request, stage: Stage) -> AbstractContextManager[None]:
    """Times a block of a request's way as one stage; ``http_routes`` says on which metrics."""
    metrics: Metrics = request.app.state.metrics
    return metrics.stage(stage)


def parse_body(raw: bytes, shape: type[B]) -> B:
    """JSON in its shape; raises as ``read_body`` does."""
    try:
        return shape.model_validate_json(raw or b"{}")
    except ValidationError as error:
        raise invalid_body(error) from None


async def read_raw(request: Request, limit_bytes: int) -> bytes:
    """A request's body as it is; raises as ``read_body`` does, and ``OVERLOADED``."""
    if request.headers.get("content-encoding", "identity") != "identity":
        raise ServiceError(ErrorKind.MALFORMED, "the body has a Content-Encoding; send it as it is")
    announced = request.headers.get("content-length", "0")
    size = int(announced) if announced.isdecimal() else 0
    waits = request.headers.get("expect", "").lower() == "100-continue"
    if size > limit_bytes * _PATIENCE or (size > limit_bytes and waits):
        raise _too_large(limit_bytes)
    try:
        return await _collect(request, limit_bytes)
    except ClientDisconnect:
        raise _gone() from None


async def _collect(request: Request, limit_bytes: int) -> bytes:
    arriving: Arriving = request.app.state.arriving
    chunks: list[bytes] = []
    size = held = 0
    try:
        async for chunk in request.stream():
            size += len(chunk)
            if size <= limit_bytes:
                arriving.take(len(chunk))
                held += len(chunk)
                chunks.append(chunk)
            elif size > limit_bytes * _PATIENCE:
                break
            else:
                chunks.clear()
    finally:
        arriving.give_back(held)
    if size > limit_bytes:
        raise _too_large(limit_bytes)
    return b"".join(chunks)


async def while_connected(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """The result of some work, cancelled as soon as the client hangs up.

    Call it only after the body was read. Raises ``CANCELLED`` when the client has gone.
    """
    working = asyncio.create_task(work)
    hanging_up = asyncio.create_task(_hang_up(request))
    try:
        await asyncio.wait({working, hanging_up}, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        raise _gone()
    finally:
        hanging_up.cancel()
        working.cancel()


async def _hang_up(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _too_large(limit_bytes: int) -> ServiceError:
    return ServiceError(
        ErrorKind.TOO_LARGE,
        f"the body is larger than {limit_bytes} bytes; send less at a time",
    )


def _gone() -> ServiceError:
    return ServiceError(ErrorKind.CANCELLED, "the client hung up")
