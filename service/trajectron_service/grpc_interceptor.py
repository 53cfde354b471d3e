"""What every RPC of ours goes through: decoding, errors into statuses, measuring, logging."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import aclosing, contextmanager
from dataclasses import dataclass
from typing import Any, TypeAlias

import grpc
from google.protobuf.message import DecodeError

from trajectron_service import logs, passes
from trajectron_service.access import scope_of_rpc
from trajectron_service.admission import Admission
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.grpc_errors import abort
from trajectron_service.metrics import Metrics
from trajectron_service.tracing import CARRIED, TRACEPARENT

# Requests, answers and handlers of all methods: gRPC gives them no common type.
Handler: TypeAlias = "grpc.RpcMethodHandler[Any, Any]"
Context = grpc.aio.ServicerContext[Any, Any]

_FAULTS = frozenset(
    code.name
    for code in (
        grpc.StatusCode.UNKNOWN,
        grpc.StatusCode.INTERNAL,
        grpc.StatusCode.UNAVAILABLE,
        grpc.StatusCode.DEADLINE_EXCEEDED,
        grpc.StatusCode.DATA_LOSS,
        grpc.StatusCode.UNIMPLEMENTED,
    )
)

log = logs.get(__name__)


@dataclass(frozen=True, slots=True)
class _Malformed:
    """Stands for a request whose bytes are no message, until the handler can refuse it."""

    reason: str


class GrpcInterceptor(grpc.aio.ServerInterceptor):
    """Wraps the handlers of our services; those of others (health, reflection) pass as they are.

    Args:
        services: their full names, such as ``trajectron.v1.TrajectronService``.
        metrics: where durations and stages go.
        admission: who is let in.
        max_calls: at once; more are refused.
    """

    def __init__(
        self, services: Sequence[str], metrics: Metrics, admission: Admission, max_calls: int
    ) -> None:
        self._admission = admission
        self._max_calls = max_calls
        self._calls = 0
        self._services = frozenset(services)
        self._metrics = metrics

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler | None]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler | None:
        """The handler of a call, wrapped (the hook that gRPC calls)."""
        handler = await continuation(handler_call_details)
        service, _, method = handler_call_details.method.removeprefix("/").partition("/")
        if handler is None or service not in self._services:
            return handler
        wrap: Any = grpc.unary_unary_rpc_method_handler
        call: Any = self._unary(method, handler.unary_unary)
        if handler.request_streaming:
            wrap = grpc.stream_stream_rpc_method_handler
            call = self._stream(method, handler.stream_stream, _all_checked)
        elif handler.response_streaming:
            wrap = grpc.unary_stream_rpc_method_handler
            call = self._stream(method, handler.unary_stream, _checked)
        wrapped: Handler = wrap(
            call,
            request_deserializer=self._decoder(handler.request_deserializer),
            response_serializer=self._encoder(handler.response_serializer),
        )
        return wrapped

    def _unary(self, method: str, behaviour: Any) -> Any:
        async def call(request: Any, context: Context) -> Any:
            with self._measured(method, context) as record:
                await record.send_traceparent(context)
                try:
                    self._admit(method, context)
                    return await behaviour(_checked(request), context)
                except Exception as error:  # noqa: BLE001  every fault becomes a status
                    await abort(context, record.failed(error))

        return call

    def _stream(self, method: str, behaviour: Any, checked: Callable[[Any], Any]) -> Any:
        async def call(request: Any, context: Context) -> AsyncIterator[Any]:
            with self._measured(method, context) as record:
                await record.send_traceparent(context)
                try:
                    self._admit(method, context)
                    # Closed here, not by the garbage collector: a cancelled stream frees its
                    # session at once.
                    behaved = behaviour(checked(request), context)
                    async with aclosing(passes.while_good(behaved)) as answers:
                        async for answer in answers:
                            yield answer
                except Exception as error:  # noqa: BLE001  every fault becomes a status
                    await abort(context, record.failed(error))

        return call

    def _admit(self, method: str, context: Context) -> None:
        if self._calls > self._max_calls:
            self._metrics.refusals.labels(ErrorKind.OVERLOADED.value).inc()
            raise ServiceError(
                ErrorKind.OVERLOADED,
                f"{self._max_calls} calls are open, the most that there may be; try again later",
                retry_after_s=1.0,
            )
        given = dict(context.invocation_metadata() or ()).get("authorization")
        text = given.decode("latin-1") if isinstance(given, bytes) else given
        self._admission.admit(text, scope_of_rpc(method))

    @contextmanager
    def _measured(self, method: str, context: Context) -> Iterator[_Record]:
        carried = {
            str(name): str(value)
            for name, value in context.invocation_metadata() or ()
            if name in CARRIED
        }
        call = self._metrics.tracing.call("grpc", method, carried)
        record = _Record(method, call.traceparent)
        start = time.perf_counter()
        self._calls += 1
        try:
            yield record
        except (asyncio.CancelledError, GeneratorExit):
            record.code = grpc.StatusCode.CANCELLED.name
            raise
        finally:
            self._calls -= 1
            duration_s = time.perf_counter() - start
            self._metrics.request("grpc", method, record.code, duration_s)
            call.end(method, record.code, failed=record.code in _FAULTS)
            log.info(
                "call",
                protocol="grpc",
                method=method,
                code=record.code,
                duration_s=round(duration_s, 6),
            )

    def _decoder(self, parse: Any) -> Callable[[bytes], Any]:
        def decode(data: bytes) -> Any:
            with self._metrics.stage("decode"):
                try:
                    return parse(data)
                except DecodeError as error:
                    return _Malformed(str(error))

        return decode

    def _encoder(self, serialise: Any) -> Callable[[Any], bytes]:
        def encode(message: Any) -> bytes:
            with self._metrics.stage("serialise"):
                data: bytes = serialise(message)
                return data

        return encode


class _Record:
    """How a call ended."""

    def __init__(self, method: str, traceparent: str | None) -> None:
        self.code = grpc.StatusCode.OK.name
        self._method = method
        self._traceparent = traceparent

    async def send_traceparent(self, context: Context) -> None:
        """Tells the client its trace, before anything else, where there is one."""
        if self._traceparent is not None:
            await context.send_initial_metadata(((TRACEPARENT, self._traceparent),))

    def failed(self, error: Exception) -> ServiceError:
        """The error to tell the client; one of no known kind is logged whole."""
        if not isinstance(error, ServiceError):
            log.error("fault", protocol="grpc", method=self._method, exc_info=error)
            error = ServiceError(ErrorKind.INTERNAL, "a fault of the service; its log has more")
        self.code = error.codes.grpc
        return error


def _checked(request: Any) -> Any:
    if isinstance(request, _Malformed):
        raise ServiceError(
            ErrorKind.MALFORMED, f"the request is not a message of the contract: {request.reason}"
        )
    return request


async def _all_checked(requests: AsyncIterator[Any]) -> AsyncIterator[Any]:
    async for request in requests:
        yield _checked(request)
