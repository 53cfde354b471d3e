"""The clients over gRPC."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import AsyncIterable, AsyncIterator, Iterable, Iterator, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any, Self, TypeVar, Unpack

import grpc
from grpc_health.v1 import health_pb2

from trajectron_client import evaluations, operations, protobuf
from trajectron_client.access import Access
from trajectron_client.async_calls import AsyncCalls
from trajectron_client.async_streams import AsyncCall, AsyncStream
from trajectron_client.connections import Connections, Route, elsewhere
from trajectron_client.evaluations import Evaluation
from trajectron_client.exceptions import DeadlineExceededError, TrajectronError, TransportError
from trajectron_client.grpc_errors import translated
from trajectron_client.operations import Operation
from trajectron_client.scene import (
    Delivery,
    ForecastOptions,
    Frame,
    SessionOptions,
    StreamFrame,
)
from trajectron_client.streams import Stream, SyncCall
from trajectron_client.sync_calls import SyncCalls
from trajectron_proto.v1 import evaluation_pb2
from trajectron_proto.v1 import trajectron_pb2 as pb

T = TypeVar("T")
Metadata = Sequence[tuple[str, str | bytes]]

_SERVING = health_pb2.HealthCheckResponse.SERVING


class Client(SyncCalls):
    """The service over gRPC, synchronous; safe to share between threads.

    Calls that change nothing are repeated, at most three times, by gRPC itself while the server
    cannot be reached.

    Args:
        target: ``host:port`` of the service, or of each of its replicas: one is used until it
            fails or stops, then the next.
        timeout_s: for calls that bring none of their own; None for as long as it takes.
        access: token and certificates for a protected service.
        credentials: for TLS, in place of those of ``access``.
        metadata: sent with every call.
        reconnect_for_s: how long a stream tries to go on after its connection broke; 0 for not at
            all.
        options: further gRPC channel options.
    """

    def __init__(
        self,
        target: str | Sequence[str] = "127.0.0.1:50051",
        *,
        timeout_s: float | None = 10.0,
        access: Access | None = None,
        credentials: grpc.ChannelCredentials | None = None,
        metadata: Metadata = (),
        reconnect_for_s: float = 60.0,
        options: Sequence[tuple[str, Any]] = (),
    ) -> None:
        self._timeout_s = timeout_s
        access = access or Access()
        credentials = credentials or access.credentials()
        self._metadata = (*access.metadata, *metadata)
        self._reconnect_for_s = reconnect_for_s

        def connect(address: str, merged: list[tuple[str, Any]]) -> grpc.Channel:
            if credentials is None:
                return grpc.insecure_channel(address, merged)
            return grpc.secure_channel(address, credentials, merged)

        self._connections = Connections(_addresses(target), connect, options)

    def close(self) -> None:
        """Closes the connection; calls under way are cancelled."""
        for connection in self._connections:
            connection.channel.close()

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
        for connection in self._connections:
            with suppress(TransportError, DeadlineExceededError), translated():
                reply = connection.health.Check(
                    health_pb2.HealthCheckRequest(),
                    timeout=_first(timeout_s, self._timeout_s),
                    metadata=self._metadata,
                )
                if reply.status == _SERVING:
                    return True
        return False

    def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Returns once the service takes work; raises ``DeadlineExceededError`` otherwise."""
        watch = self._connections.current.health.Watch(
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
            session_id: a session to go on with, or the name of a new one; a random name when
                None.
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
                connection broke and the stream could not go on within ``reconnect_for_s``.
            SessionLostError: by iterating, when the service has lost frames that it acknowledged.
        """
        opening = _opening(
            session_id, config, options, forecast_every_frame, delivery, close_session_at_end
        )
        route = Route(self._connections, self._reconnect_for_s)
        until = None if timeout_s is None else time.monotonic() + timeout_s

        def start(requests: Iterator[pb.StreamPredictRequest]) -> SyncCall:
            left_s = None if until is None else max(0.0, until - time.monotonic())
            stub = route.next().service
            call: SyncCall = stub.StreamPredict(requests, timeout=left_s, metadata=self._metadata)
            return call

        return Stream(start, opening, frames, route.reopening)

    def watch_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> Iterator[Evaluation]:
        """See ``SyncEvaluations``."""
        request = evaluation_pb2.WatchEvaluationRequest(evaluation_id=evaluation_id)
        call = self._connections.current.evaluations.WatchEvaluation(
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
        request = operation.message()
        for left in reversed(range(len(self._connections))):
            connection = self._connections.current
            call = getattr(connection.service if ours else connection.evaluations, operation.rpc)
            try:
                with translated():
                    reply = call(
                        request, timeout=_first(timeout_s, self._timeout_s), metadata=self._metadata
                    )
                return operation.from_message(reply)
            except TrajectronError as error:
                if not left or not elsewhere(operation, error):
                    raise
                self._connections.turn(connection)
        raise AssertionError("unreachable: the last attempt returns or raises")


class AsyncClient(AsyncCalls):
    """The service over gRPC, for asyncio; make it inside the loop that uses it.

    Calls that change nothing are repeated, at most three times, by gRPC itself while the server
    cannot be reached.

    Args:
        target: ``host:port`` of the service, or of each of its replicas: one is used until it
            fails or stops, then the next.
        timeout_s: for calls that bring none of their own; None for as long as it takes.
        access: token and certificates for a protected service.
        credentials: for TLS, in place of those of ``access``.
        metadata: sent with every call.
        reconnect_for_s: how long a stream tries to go on after its connection broke; 0 for not at
            all.
        options: further gRPC channel options.

    Raises:
        RuntimeError: no event loop is running.
    """

    def __init__(
        self,
        target: str | Sequence[str] = "127.0.0.1:50051",
        *,
        timeout_s: float | None = 10.0,
        access: Access | None = None,
        credentials: grpc.ChannelCredentials | None = None,
        metadata: Metadata = (),
        reconnect_for_s: float = 60.0,
        options: Sequence[tuple[str, Any]] = (),
    ) -> None:
        asyncio.get_running_loop()  # gRPC binds a channel to a loop when it is made
        self._timeout_s = timeout_s
        access = access or Access()
        credentials = credentials or access.credentials()
        self._metadata = (*access.metadata, *metadata)
        self._reconnect_for_s = reconnect_for_s

        def connect(address: str, merged: list[tuple[str, Any]]) -> grpc.aio.Channel:
            if credentials is None:
                return grpc.aio.insecure_channel(address, merged)
            return grpc.aio.secure_channel(address, credentials, merged)

        self._connections = Connections(_addresses(target), connect, options)

    async def close(self) -> None:
        """Closes the connection; calls under way are cancelled."""
        for connection in self._connections:
            await connection.channel.close()

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
        for connection in self._connections:
            with suppress(TransportError, DeadlineExceededError), translated():
                reply = await connection.health.Check(
                    health_pb2.HealthCheckRequest(),
                    timeout=_first(timeout_s, self._timeout_s),
                    metadata=self._metadata,
                )
                if reply.status == _SERVING:
                    return True
        return False

    async def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Returns once the service takes work; raises ``DeadlineExceededError`` otherwise."""
        watch = self._connections.current.health.Watch(
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
        route = Route(self._connections, self._reconnect_for_s)
        until = None if timeout_s is None else time.monotonic() + timeout_s

        def start(requests: AsyncIterator[pb.StreamPredictRequest]) -> AsyncCall:
            left_s = None if until is None else max(0.0, until - time.monotonic())
            stub = route.next().service
            call: AsyncCall = stub.StreamPredict(requests, timeout=left_s, metadata=self._metadata)
            return call

        return AsyncStream(start, opening, frames, route.reopening)

    async def watch_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> AsyncIterator[Evaluation]:
        """See ``AsyncEvaluations``."""
        request = evaluation_pb2.WatchEvaluationRequest(evaluation_id=evaluation_id)
        call: Any = self._connections.current.evaluations.WatchEvaluation(
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
        request = operation.message()
        for left in reversed(range(len(self._connections))):
            connection = self._connections.current
            call = getattr(connection.service if ours else connection.evaluations, operation.rpc)
            try:
                with translated():
                    reply = await call(
                        request, timeout=_first(timeout_s, self._timeout_s), metadata=self._metadata
                    )
                return operation.from_message(reply)
            except TrajectronError as error:
                if not left or not elsewhere(operation, error):
                    raise
                self._connections.turn(connection)
        raise AssertionError("unreachable: the last attempt returns or raises")


def _opening(
    session_id: str | None,
    config: SessionOptions | None,
    options: ForecastOptions,
    forecast_every_frame: bool,
    delivery: Delivery,
    close_session_at_end: bool,
) -> pb.StreamOpen:
    return pb.StreamOpen(
        # Named here, so that an opening whose answer is lost can be repeated.
        session_id=session_id or secrets.token_hex(16),
        config=protobuf.session_config(**(config or {})),
        options=protobuf.forecast_options(**options),
        forecast_every_frame=forecast_every_frame,
        delivery=protobuf.delivery(delivery),
        close_session_at_end=close_session_at_end,
    )


def _addresses(target: str | Sequence[str]) -> Sequence[str]:
    return (target,) if isinstance(target, str) else target


def _first(timeout_s: float | None, default_s: float | None) -> float | None:
    return default_s if timeout_s is None else timeout_s
