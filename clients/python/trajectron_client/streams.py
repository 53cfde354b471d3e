"""The stream of a session: frames go in from any iterable, replies come out by iterating."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, AsyncIterator, Callable, Iterable, Iterator
from concurrent.futures import Future
from types import TracebackType
from typing import Protocol, Self

import grpc

from trajectron_client import protobuf
from trajectron_client.grpc_errors import from_rpc_error, translated
from trajectron_client.replies import SessionInfo, StreamReply
from trajectron_client.scene import Frame, StreamFrame
from trajectron_proto.v1 import trajectron_pb2 as pb

AsyncCall = grpc.aio.StreamStreamCall[pb.StreamPredictRequest, pb.StreamPredictResponse]


class SyncCall(Protocol):
    """What gRPC gives for a running synchronous stream."""

    def __next__(self) -> pb.StreamPredictResponse: ...

    def cancel(self) -> object:
        """Ends the stream at once."""


class _Numbering:
    """Numbers the frames of a stream on from the last one that the session acknowledged."""

    def __init__(self, session: SessionInfo) -> None:
        self._last = session.last_sequence or 0

    def request(self, value: Frame | StreamFrame) -> pb.StreamPredictRequest:
        item = StreamFrame(value) if isinstance(value, Frame) else value
        self._last = self._last + 1 if item.sequence is None else item.sequence
        own = None if item.options is None else protobuf.forecast_options(**item.options)
        return pb.StreamPredictRequest(
            frame=pb.StreamFrame(sequence=self._last, frame=protobuf.frame(item.frame), options=own)
        )


class Stream(Iterator[StreamReply]):
    """A running stream: iterate it for one reply per frame, in order.

    It ends after the last reply, when the frames have ended. Leaving its ``with`` block, or
    ``close``, ends it at once; the session lives on unless the stream was to close it.

    Attributes:
        session: the session as it was when the stream began.
        resumed: whether the session existed before; ``session.last_sequence`` is then the last
            frame that the service has seen.
    """

    def __init__(
        self,
        start: Callable[[Iterator[pb.StreamPredictRequest]], SyncCall],
        opening: pb.StreamOpen,
        frames: Iterable[Frame | StreamFrame],
    ) -> None:
        self._opening = opening
        self._frames = frames
        self._numbering: Future[_Numbering | None] = Future()
        self._fault: Exception | None = None
        self._closed = False
        self._call = start(self._requests())
        try:
            with translated():
                opened = next(self._call).opened
        except BaseException:
            self._numbering.set_result(None)
            raise
        self.session = protobuf.to_session_info(opened.session)
        self.resumed = opened.resumed
        self._numbering.set_result(_Numbering(self.session))

    def _requests(self) -> Iterator[pb.StreamPredictRequest]:
        """What gRPC sends; it iterates this in a thread of its own."""
        yield pb.StreamPredictRequest(open=self._opening)
        numbering = self._numbering.result()
        if numbering is None:
            return
        try:
            for value in self._frames:
                yield numbering.request(value)
        except Exception as error:  # noqa: BLE001  raised where the replies are read
            self._fault = error
            self._call.cancel()

    def __next__(self) -> StreamReply:
        if self._closed:
            raise StopIteration
        try:
            response = next(self._call)
        except grpc.RpcError as error:
            if self._fault is not None:
                raise self._fault from None
            raise from_rpc_error(error) from error
        return protobuf.to_stream_reply(response.reply)

    def close(self) -> None:
        """Ends the stream at once; replies not read yet are lost."""
        self._closed = True
        self._call.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class AsyncStream(AsyncIterator[StreamReply]):
    """A stream for asyncio: ``async with`` opens it, ``async for`` gives one reply per frame.

    Iterating opens it too. It ends after the last reply, when the frames have ended. Leaving its
    block, or ``close``, ends it at once; the session lives on unless the stream was to close it.
    """

    def __init__(
        self,
        start: Callable[[AsyncIterator[pb.StreamPredictRequest]], AsyncCall],
        opening: pb.StreamOpen,
        frames: Iterable[Frame | StreamFrame] | AsyncIterable[Frame | StreamFrame],
    ) -> None:
        self._start = start
        self._opening = opening
        self._frames = frames
        self._fault: Exception | None = None
        self._closed = False
        self._opened: asyncio.Future[pb.StreamOpened | None] | None = None
        self._call: AsyncCall
        self._replies: AsyncIterator[pb.StreamPredictResponse]

    @property
    def session(self) -> SessionInfo:
        """The session as it was when the stream began.

        Raises:
            RuntimeError: the stream is not open yet.
        """
        return protobuf.to_session_info(self._acknowledgement().session)

    @property
    def resumed(self) -> bool:
        """Whether the session existed before; raises ``RuntimeError`` before the stream is open."""
        return self._acknowledgement().resumed

    def _acknowledgement(self) -> pb.StreamOpened:
        opened = self._opened.result() if self._opened and self._opened.done() else None
        if opened is None:
            raise RuntimeError("the stream is not open; use `async with` before asking")
        return opened

    async def _open(self) -> None:
        self._opened = asyncio.get_running_loop().create_future()
        self._call = self._start(self._requests(self._opened))
        self._replies = aiter(self._call)
        try:
            with translated():
                opened = (await anext(self._replies)).opened
        except BaseException:
            self._opened.set_result(None)
            raise
        self._opened.set_result(opened)

    async def _requests(
        self, acknowledged: asyncio.Future[pb.StreamOpened | None]
    ) -> AsyncIterator[pb.StreamPredictRequest]:
        """What gRPC sends; it iterates this in a task of its own."""
        yield pb.StreamPredictRequest(open=self._opening)
        opened = await acknowledged
        if opened is None:
            return
        numbering = _Numbering(protobuf.to_session_info(opened.session))
        try:
            async for value in _each(self._frames):
                yield numbering.request(value)
        except Exception as error:  # noqa: BLE001  raised where the replies are read
            self._fault = error
            self._call.cancel()

    async def __anext__(self) -> StreamReply:
        if self._opened is None:
            await self._open()
        try:
            response = await anext(self._replies)
        except grpc.RpcError as error:
            raise self._fault or from_rpc_error(error) from error
        except asyncio.CancelledError:
            # gRPC raises this too when the call, and not the task that reads it, was cancelled.
            if self._fault is not None:
                raise self._fault from None
            if self._closed:
                raise StopAsyncIteration from None
            raise
        return protobuf.to_stream_reply(response.reply)

    async def close(self) -> None:
        """Ends the stream at once; replies not read yet are lost."""
        self._closed = True
        if self._opened is not None:
            self._call.cancel()

    async def __aenter__(self) -> Self:
        await self._open()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()


async def _each(
    frames: Iterable[Frame | StreamFrame] | AsyncIterable[Frame | StreamFrame],
) -> AsyncIterator[Frame | StreamFrame]:
    if isinstance(frames, AsyncIterable):
        async for frame in frames:
            yield frame
    else:
        for frame in frames:
            yield frame
