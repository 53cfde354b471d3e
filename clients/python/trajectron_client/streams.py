"""The stream of a session: frames go in from any iterable, replies come out by iterating."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import Protocol, Self

import grpc

from trajectron_client import protobuf, resuming
from trajectron_client.exceptions import TrajectronError, UnknownSessionError
from trajectron_client.grpc_errors import translated
from trajectron_client.outgoing import Outgoing
from trajectron_client.replies import StreamReply
from trajectron_client.resuming import Attempts, Reopening
from trajectron_client.scene import Frame, StreamFrame
from trajectron_proto.v1 import trajectron_pb2 as pb


class SyncCall(Protocol):
    """What gRPC gives for a running synchronous stream."""

    def __next__(self) -> pb.StreamPredictResponse: ...

    def cancel(self) -> object:
        """Ends the stream at once."""


class Stream(Iterator[StreamReply]):
    """A running stream: iterate it for one reply per frame, in order.

    It ends after the last reply, when the frames have ended. Leaving its ``with`` block, or
    ``close``, ends it at once; the session lives on unless the stream was to close it.

    When the connection breaks, or the server stops, it goes on by itself, on another address
    where there is one: frames without a reply are sent again, and count once. The reply to such
    a frame says ``duplicate`` where only its first reply was lost.

    Attributes:
        session: the session as it was when the stream began.
        resumed: whether the session existed before; ``session.last_sequence`` is then the last
            frame that the service has seen.
        reconnects: how often the stream has gone on after a break.
    """

    def __init__(
        self,
        start: Callable[[Iterator[pb.StreamPredictRequest]], SyncCall],
        opening: pb.StreamOpen,
        frames: Iterable[Frame | StreamFrame],
        reopening: Reopening,
    ) -> None:
        self._start = start
        self._opening = opening
        self._outgoing = Outgoing(frames, self._cancel)
        self._attempts = Attempts(reopening)
        self._acknowledged = 0
        self._closing = threading.Event()
        self._call: SyncCall
        self.reconnects = 0
        opened = self._open_somewhere(reopening)
        self.session = protobuf.to_session_info(opened.session)
        self.resumed = opened.resumed
        self._outgoing.acknowledge(self.session)

    def __next__(self) -> StreamReply:
        if self._closing.is_set():
            raise StopIteration
        while True:
            try:
                response = next(self._call)
            except StopIteration:
                if self._outgoing.fault is not None:
                    raise self._outgoing.fault from None
                raise
            except grpc.RpcError as error:
                if self._outgoing.fault is not None:
                    raise self._outgoing.fault from None
                try:
                    self._go_on(resuming.broken(error))
                except BaseException:
                    self._outgoing.stop()
                    raise
                continue
            reply = protobuf.to_stream_reply(response.reply)
            self._outgoing.answered()
            self._acknowledged = max(self._acknowledged, reply.sequence)
            self._attempts.succeeded()
            return reply

    def close(self) -> None:
        """Ends the stream at once; replies not read yet are lost."""
        self._closing.set()
        self._outgoing.stop()
        self._cancel()

    def _cancel(self) -> None:
        self._call.cancel()

    def _open_somewhere(self, reopening: Reopening) -> pb.StreamOpened:
        """Opens the stream on the first address that takes it."""
        for _ in range(reopening.addresses - 1):
            try:
                return self._open(self._opening)
            except grpc.RpcError as error:
                resuming.broken(error)  # raises any other fault
                reopening.turn()
        with translated():
            return self._open(self._opening)

    def _open(self, opening: pb.StreamOpen) -> pb.StreamOpened:
        self._call = self._start(self._outgoing.attempt(opening))
        try:
            return next(self._call).opened
        except BaseException:
            self._outgoing.stop()
            raise

    def _go_on(self, error: TrajectronError) -> None:
        """Opens the stream again, as often as it takes; raises when that leads nowhere."""
        opening = resuming.again(self._opening, self.session)
        while True:
            if self._outgoing.finished and not self._opening.close_session_at_end:
                raise StopIteration
            if self._closing.wait(self._attempts.pause_s(error)):
                raise StopIteration
            try:
                opened = self._open(opening)
            except grpc.RpcError as fault:
                try:
                    error = resuming.broken(fault)
                except UnknownSessionError:
                    if self._outgoing.finished:  # closed at its end, as was asked
                        raise StopIteration from None
                    raise
                continue
            session = protobuf.to_session_info(opened.session)
            resuming.same_session(self.session, session, self._acknowledged)
            self.reconnects += 1
            self._outgoing.acknowledge(session)
            return

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
