"""The clients over gRPC."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterable, AsyncIterator, Iterable, Iterator, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from trajectron_client import evaluation_operations, evaluations, operations, protobuf
from trajectron_client.async_calls import AsyncCalls
from trajectron_client.evaluations import Evaluation
from trajectron_client.exceptions import DeadlineExceededError, TransportError
from trajectron_client.grpc_errors import translated
from trajectron_client.operations import Operation
from trajectron_client.scene import (
    Delivery,
    ForecastOptions,
    Frame,
    SessionOptions,
    StreamFrame,
)
from trajectron_client.streams import AsyncCall, AsyncStream, Stream, SyncCall
from trajectron_client.sync_calls import SyncCalls
from trajectron_proto.v1 import evaluation_pb2, evaluation_pb2_grpc, trajectron_pb2_grpc
from trajectron_proto.v1 import trajectron_pb2 as pb

T = TypeVar("T")
Metadata = Sequence[tuple[str, str | bytes]]

# 200 samples x 12 steps of 2000 agents are 38 MB.
_MAX_ANSWER_BYTES = 64 * 1024 * 1024
# Calls that change nothing, so that sending one twice does no harm.
_SAFE_TO_REPEAT = {
    operations.SERVICE: (
        "Predict", "PredictSession", "GetSession", "ListSessions", "ListModels",
    ),
    evaluation_operations.SERVICE: ("GetEvaluation", "ListEvaluations", "GetEvaluationResult"),
}  # fmt: skip
_SERVICE_CONFIG = {
    "methodConfig": [
        {
            "name": [
                {"service": service, "method": method}
                for service, methods in _SAFE_TO_REPEAT.items()
                for method in methods
            ],
            "retryPolicy": {
                "maxAttempts": 4,
                "initialBackoff": "0.05s",
                "maxBackoff": "1s",
                "backoffMultiplier": 2,
                "retryableStatusCodes": ["UNAVAILABLE"],
            },
        }
    ]
}
_SERVING = health_pb2.HealthCheckResponse.SERVING


class Client(SyncCalls):
    """The service over gRPC, synchronous; safe to share between threads.

    Calls that change nothing are repeated, at most three times, by gRPC itself while the server
    cannot be reached.

    Args:
        target: ``host:port`` of the service.
        timeout_s: for calls that bring none of their own; None for as long as it takes.
        credentials: for TLS; plain text when None.
        metadata: sent with every call.
        options: further gRPC channel options.
    """

    def __init__(
        self,
        target: str = "127.0.0.1:50051",
        *,
        timeout_s: float | None = 10.0,
        credentials: grpc.ChannelCredentials | None = None,
        metadata: Metadata = (),
        options: Sequence[tuple[str, Any]] = (),
    ) -> None:
        self._timeout_s = timeout_s
        self._metadata = tuple(metadata)
        merged = _channel_options(options)
        self._channel = (
            grpc.insecure_channel(target, merged)
            if credentials is None
            else grpc.secure_channel(target, credentials, merged)
        )
        self._stub = trajectron_pb2_grpc.TrajectronServiceStub(self._channel)
        self._evaluations = evaluation_pb2_grpc.EvaluationServiceStub(self._channel)
        self._health: Any = health_pb2_grpc.HealthStub(self._channel)

    def close(self) -> None:
        """Closes the connection; calls under way are cancelled."""
        self._channel.close()

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
            with translated():
                reply = self._health.Check(
                    health_pb2.HealthCheckRequest(),
                    timeout=_first(timeout_s, self._timeout_s),
                    metadata=self._metadata,
                )
        except (TransportError, DeadlineExceededError):
            return False
        return bool(reply.status == _SERVING)

    def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Returns once the service takes work; raises ``DeadlineExceededError`` otherwise."""
        watch = self._health.Watch(
            health_pb2.HealthCheckRequest(),
            timeout=timeout_s,
            metadata=self._metadata,
            wait_for_ready=True,
        )
        with translated():
            for reply in watch:
                if reply.status == _SERVING:
                    watch.cancel()
                    return
        raise TransportError("the service stopped telling its health before it was ready")

    def stream(
        self,
        frames: Iterable[Frame | StreamFrame],
        *,
        session_id: str | None = None,
        config: SessionOptions | None = None,
        forecast_every_frame: bool = True,
        delivery: Delivery = "all",
        close_session_at_end: bool = False,
        timeout_s: float | None = None,
        **options: Unpack[ForecastOptions],
    ) -> Stream:
        """Streams frames to a session and gives one reply per frame, in order.

        Frames are taken from the iterable in a thread of gRPC's, as fast as it gives them;
        ``iter(queue.get, None)`` makes one of a queue.

        Args:
            frames: frames in order of time, or ``StreamFrame`` to number them yourself.
            session_id: a session to go on with, or the name of a new one; named by the server
                when None.
            config: for a new session.
            forecast_every_frame: False for results only, but for frames with options of their own.
            delivery: ``"latest"`` leaves out forecasts that newer frames have superseded before
                they could be sent; every frame still counts and gets its result.
            close_session_at_end: whether the session closes when the frames have ended.
            timeout_s: for the whole stream; None for none, whatever the client's own is.
            **options: see ``ForecastOptions``; asked of every frame that brings none.

        Raises:
            ServiceError: the stream was refused; later faults of the stream are raised by
                iterating, faults of one frame stand in its reply.
            TransportError: the service could not be reached; iterating raises it when the
                connection breaks.
        """
        opening = _opening(
            session_id, config, options, forecast_every_frame, delivery, close_session_at_end
        )

        def start(requests: Iterator[pb.StreamPredictRequest]) -> SyncCall:
            return self._stub.StreamPredict(requests, timeout=timeout_s, metadata=self._metadata)

        return Stream(start, opening, frames)

    def watch_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> Iterator[Evaluation]:
        """See ``SyncEvaluations``."""
        request = evaluation_pb2.WatchEvaluationRequest(evaluation_id=evaluation_id)
        call = self._evaluations.WatchEvaluation(
            request, timeout=timeout_s, metadata=self._metadata
        )
        try:
            with translated():
                for reply in call:
                    yield evaluations.from_message(reply.evaluation)
        finally:
            call.cancel()

    def _run(self, operation: Operation[T], timeout_s: float | None) -> T:
        ours = operation.service == operations.SERVICE
        call = getattr(self._stub if ours else self._evaluations, operation.rpc)
        request = operation.message()
        with translated():
            reply = call(
                request, timeout=_first(timeout_s, self._timeout_s), metadata=self._metadata
            )
        return operation.from_message(reply)


class AsyncClient(AsyncCalls):
    """The service over gRPC, for asyncio; make it inside the loop that uses it.

    Calls that change nothing are repeated, at most three times, by gRPC itself while the server
    cannot be reached.

    Args:
        target: ``host:port`` of the service.
        timeout_s: for calls that bring none of their own; None for as long as it takes.
        credentials: for TLS; plain text when None.
        metadata: sent with every call.
        options: further gRPC channel options.

    Raises:
        RuntimeError: no event loop is running.
    """

    def __init__(
        self,
        target: str = "127.0.0.1:50051",
        *,
        timeout_s: float | None = 10.0,
        credentials: grpc.ChannelCredentials | None = None,
        metadata: Metadata = (),
        options: Sequence[tuple[str, Any]] = (),
    ) -> None:
        asyncio.get_running_loop()  # gRPC binds a channel to a loop when it is made
        self._timeout_s = timeout_s
        self._metadata = tuple(metadata)
        merged = _channel_options(options)
        self._channel = (
            grpc.aio.insecure_channel(target, merged)
            if credentials is None
            else grpc.aio.secure_channel(target, credentials, merged)
        )
        self._stub = trajectron_pb2_grpc.TrajectronServiceStub(self._channel)
        self._evaluations = evaluation_pb2_grpc.EvaluationServiceStub(self._channel)
        self._health: Any = health_pb2_grpc.HealthStub(self._channel)

    async def close(self) -> None:
        """Closes the connection; calls under way are cancelled."""
        await self._channel.close()

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
            with translated():
                reply = await self._health.Check(
                    health_pb2.HealthCheckRequest(),
                    timeout=_first(timeout_s, self._timeout_s),
                    metadata=self._metadata,
                )
        except (TransportError, DeadlineExceededError):
            return False
        return bool(reply.status == _SERVING)

    async def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Returns once the service takes work; raises ``DeadlineExceededError`` otherwise."""
        watch = self._health.Watch(
            health_pb2.HealthCheckRequest(),
            timeout=timeout_s,
            metadata=self._metadata,
            wait_for_ready=True,
        )
        with translated():
            async for reply in watch:
                if reply.status == _SERVING:
                    watch.cancel()
                    return
        raise TransportError("the service stopped telling its health before it was ready")

    def stream(
        self,
        frames: Iterable[Frame | StreamFrame] | AsyncIterable[Frame | StreamFrame],
        *,
        session_id: str | None = None,
        config: SessionOptions | None = None,
        forecast_every_frame: bool = True,
        delivery: Delivery = "all",
        close_session_at_end: bool = False,
        timeout_s: float | None = None,
        **options: Unpack[ForecastOptions],
    ) -> AsyncStream:
        """Streams frames to a session and gives one reply per frame, in order.

        As ``Client.stream``, but that frames may come from an async iterable, too, and that the
        stream is opened, and its errors raised, by ``async with`` or by iterating.
        """
        opening = _opening(
            session_id, config, options, forecast_every_frame, delivery, close_session_at_end
        )

        def start(requests: AsyncIterator[pb.StreamPredictRequest]) -> AsyncCall:
            return self._stub.StreamPredict(requests, timeout=timeout_s, metadata=self._metadata)

        return AsyncStream(start, opening, frames)

    async def watch_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> AsyncIterator[Evaluation]:
        """See ``AsyncEvaluations``."""
        request = evaluation_pb2.WatchEvaluationRequest(evaluation_id=evaluation_id)
        call: Any = self._evaluations.WatchEvaluation(
            request, timeout=timeout_s, metadata=self._metadata
        )
        try:
            with translated():
                async for reply in call:
                    yield evaluations.from_message(reply.evaluation)
        finally:
            call.cancel()

    async def _run(self, operation: Operation[T], timeout_s: float | None) -> T:
        ours = operation.service == operations.SERVICE
        call = getattr(self._stub if ours else self._evaluations, operation.rpc)
        request = operation.message()
        with translated():
            reply = await call(
                request, timeout=_first(timeout_s, self._timeout_s), metadata=self._metadata
            )
        return operation.from_message(reply)


def _channel_options(given: Sequence[tuple[str, Any]]) -> list[tuple[str, Any]]:
    ours = {
        "grpc.max_receive_message_length": _MAX_ANSWER_BYTES,
        "grpc.service_config": json.dumps(_SERVICE_CONFIG),
    }
    return list((ours | dict(given)).items())


def _opening(
    session_id: str | None,
    config: SessionOptions | None,
    options: ForecastOptions,
    forecast_every_frame: bool,
    delivery: Delivery,
    close_session_at_end: bool,
) -> pb.StreamOpen:
    return pb.StreamOpen(
        session_id=session_id or "",
        config=protobuf.session_config(**(config or {})),
        options=protobuf.forecast_options(**options),
        forecast_every_frame=forecast_every_frame,
        delivery=protobuf.delivery(delivery),
        close_session_at_end=close_session_at_end,
    )


def _first(timeout_s: float | None, default_s: float | None) -> float | None:
    return default_s if timeout_s is None else timeout_s
