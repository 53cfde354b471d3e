"""The stream of a session for asyncio; see ``streams``."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterable, AsyncIterator, Callable, Iterable
from types import TracebackType
from typing import Self

import grpc

from trajectron_client import protobuf, resuming
from trajectron_client.exceptions import TrajectronError, UnknownSessionError
from trajectron_client.grpc_errors import translated
from trajectron_client.replies import SessionInfo, StreamReply
from trajectron_client.resuming import Attempts, Numbering, Reopening
from trajectron_client.scene import Frame, StreamFrame
from trajectron_proto.v1 import trajectron_pb2 as pb

AsyncCall = grpc.aio.StreamStreamCall[pb.StreamPredictRequest, pb.StreamPredictResponse]
Frames = Iterable[Frame | StreamFrame] | AsyncIterable[Frame | StreamFrame]


class AsyncOutgoing:
    """The frames of a stream on their way: taken once, sent until they are answered.

    They are taken in a task of their own, one when the current attempt has sent all before:
    gRPC cancels whatever takes requests when an attempt ends.
    """

    def __init__(self, frames: Frames, on_fault: Callable[[], None]) -> None:
        self.fault: Exception | None = None
        self._frames = frames
        self._on_fault = on_fault
        self._changed = asyncio.Condition()
        self._unanswered: deque[pb.StreamPredictRequest] = deque()
        self._answered = 0
        self._attempt = 0
        self._acknowledged = 0
        self._wanted = False
        self._ended = False
        self._taker: asyncio.Task[None] | None = None

    @property
    def finished(self) -> bool:
        """Whether there are no more frames, and all have their replies."""
        return self._ended and not self._unanswered

    def attempt(self, opening: pb.StreamOpen) -> AsyncIterator[pb.StreamPredictRequest]:
        """The requests of a new attempt."""
        self._attempt += 1
        return self._requests(self._attempt, opening)

    async def acknowledge(self, session: SessionInfo) -> None:
        """The service has opened the stream: frames may go."""
        async with self._changed:
            self._acknowledged = self._attempt
            if self._taker is None:
                self._taker = asyncio.create_task(self._take(Numbering(session)))
            self._changed.notify_all()

    def answered(self) -> None:
        """The reply to the first frame without one has come."""
        self._unanswered.popleft()
        self._answered += 1

    def stop(self) -> None:
        """Takes no more frames."""
        self._attempt += 1
        if self._taker is not None:
            self._taker.cancel()

    async def _requests(
        self, attempt: int, opening: pb.StreamOpen
    ) -> AsyncIterator[pb.StreamPredictRequest]:
        yield pb.StreamPredictRequest(open=opening)
        async with self._changed:
            await self._changed.wait_for(lambda: self._acknowledged >= attempt)
            position = self._answered
        while (request := await self._at(position, attempt)) is not None:
            yield request
            position += 1

    async def _at(self, position: int, attempt: int) -> pb.StreamPredictRequest | None:
        """The request at a position, taken now if need be; None at the end."""
        async with self._changed:
            while attempt == self._attempt:
                if position - self._answered < len(self._unanswered):
                    return self._unanswered[position - self._answered]
                if self._ended:
                    return None
                self._wanted = True
                self._changed.notify_all()
                await self._changed.wait()
        return None

    async def _take(self, numbering: Numbering) -> None:
        """Takes frames, one whenever one is wanted, until they end."""
        frames = _each(self._frames)
        try:
            while True:
                async with self._changed:
                    await self._changed.wait_for(lambda: self._wanted)
                    self._wanted = False
                request = numbering.request(await anext(frames))
                async with self._changed:
                    self._unanswered.append(request)
                    self._changed.notify_all()
        except StopAsyncIteration:
            pass
        except Exception as error:  # noqa: BLE001  raised where the replies are read
            self.fault = error
        async with self._changed:
            self._ended = True
            self._changed.notify_all()
        if self.fault is not None:
            self._on_fault()


class AsyncStream(AsyncIterator[StreamReply]):
    """A stream for asyncio: ``async with`` opens it, ``async for`` gives one reply per frame.

    Iterating opens it too. It ends after the last reply, when the frames have ended. Leaving its
    block, or ``close``, ends it at once; the session lives on unless the stream was to close it.
    After a break it goes on by itself, as ``Stream`` does.

    Attributes:
        reconnects: how often the stream has gone on after a break.
    """

    def __init__(
        self,
        start: Callable[[AsyncIterator[pb.StreamPredictRequest]], AsyncCall],
        opening: pb.StreamOpen,
        frames: Frames,
        reopening: Reopening,
    ) -> None:
        self._start = start
        self._opening = opening
        self._outgoing = AsyncOutgoing(frames, self._cancel)
        self._reopening = reopening
        self._attempts = Attempts(reopening)
        self._acknowledged = 0
        self._closed = False
        self._opened: pb.StreamOpened | None = None
        self._call: AsyncCall | None = None
        self._replies: AsyncIterator[pb.StreamPredictResponse]
        self.reconnects = 0

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
        if self._opened is None:
            raise RuntimeError("the stream is not open; use `async with` before asking")
        return self._opened

    async def __anext__(self) -> StreamReply:
        if self._closed:
            raise StopAsyncIteration
        if self._opened is None:
            await self._begin()
        while True:
            try:
                response = await anext(self._replies)
            except StopAsyncIteration:
                if self._outgoing.fault is not None:
                    raise self._outgoing.fault from None
                raise
            except grpc.RpcError as error:
                if self._outgoing.fault is not None:
                    raise self._outgoing.fault from None
                try:
                    await self._go_on(resuming.broken(error))
                except BaseException:
                    self._outgoing.stop()
                    raise
                continue
            except asyncio.CancelledError:
                # gRPC raises this too when the call, and not the task that reads, was cancelled.
                if self._outgoing.fault is not None:
                    raise self._outgoing.fault from None
                if self._closed:
                    raise StopAsyncIteration from None
                raise
            reply = protobuf.to_stream_reply(response.reply)
            self._outgoing.answered()
            self._acknowledged = max(self._acknowledged, reply.sequence)
            self._attempts.succeeded()
            return reply

    async def close(self) -> None:
        """Ends the stream at once; replies not read yet are lost."""
        self._closed = True
        self._outgoing.stop()
        self._cancel()

    def _cancel(self) -> None:
        if self._call is not None:
            self._call.cancel()

    async def _begin(self) -> None:
        """Opens the stream on the first address that takes it."""
        for _ in range(self._reopening.addresses - 1):
            try:
                self._opened = await self._open(self._opening)
                break
            except grpc.RpcError as error:
                resuming.broken(error)  # raises any other fault
                self._reopening.turn()
        else:
            with translated():
                self._opened = await self._open(self._opening)
        await self._outgoing.acknowledge(self.session)

    async def _open(self, opening: pb.StreamOpen) -> pb.StreamOpened:
        self._call = self._start(self._outgoing.attempt(opening))
        self._replies = aiter(self._call)
        return (await anext(self._replies)).opened

    async def _go_on(self, error: TrajectronError) -> None:
        """Opens the stream again, as often as it takes; raises when that leads nowhere."""
        opening = resuming.again(self._opening, self.session)
        while True:
            if self._outgoing.finished and not self._opening.close_session_at_end:
                raise StopAsyncIteration
            await asyncio.sleep(self._attempts.pause_s(error))
            if self._closed:
                raise StopAsyncIteration
            try:
                opened = await self._open(opening)
            except grpc.RpcError as fault:
                try:
                    error = resuming.broken(fault)
                except UnknownSessionError:
                    if self._outgoing.finished:  # closed at its end, as was asked
                        raise StopAsyncIteration from None
                    raise
                continue
            session = protobuf.to_session_info(opened.session)
            resuming.same_session(self.session, session, self._acknowledged)
            self.reconnects += 1
            await self._outgoing.acknowledge(session)
            return

    async def __aenter__(self) -> Self:
        await self._begin()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()


async def _each(frames: Frames) -> AsyncIterator[Frame | StreamFrame]:
    if isinstance(frames, AsyncIterable):
        async for frame in frames:
            yield frame
    else:
        for frame in frames:
            yield frame
