"""The frames of a stream on their way: taken once, sent until they are answered.

gRPC takes requests from an iterator in a thread of its own, and each attempt at a stream has
another one. All of them share the frames: whichever attempt is the current one sends what has no
reply yet, and only then takes more.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator

from trajectron_client.replies import SessionInfo
from trajectron_client.resuming import Numbering
from trajectron_client.scene import Frame, StreamFrame
from trajectron_proto.v1 import trajectron_pb2 as pb


class Outgoing:
    """The frames of a synchronous stream.

    Args:
        frames: taken one by one, when the current attempt has sent all before.
        on_fault: called in gRPC's thread when taking one raised; see ``fault``.
    """

    def __init__(self, frames: Iterable[Frame | StreamFrame], on_fault: Callable[[], None]) -> None:
        self.fault: Exception | None = None
        self._frames = frames
        self._iterator: Iterator[Frame | StreamFrame] | None = None
        self._on_fault = on_fault
        self._changed = threading.Condition()
        self._unanswered: deque[pb.StreamPredictRequest] = deque()
        self._answered = 0
        self._attempt = 0
        self._acknowledged = 0  # the attempt that the service has acknowledged
        self._numbering: Numbering | None = None
        self._taking = False
        self._ended = False

    @property
    def finished(self) -> bool:
        """Whether there are no more frames, and all have their replies."""
        with self._changed:
            return self._ended and not self._unanswered

    def attempt(self, opening: pb.StreamOpen) -> Iterator[pb.StreamPredictRequest]:
        """The requests of a new attempt; those of the one before end."""
        with self._changed:
            self._attempt += 1
            self._changed.notify_all()
            return self._requests(self._attempt, opening)

    def acknowledge(self, session: SessionInfo) -> None:
        """The service has opened the stream: frames may go."""
        with self._changed:
            self._acknowledged = self._attempt
            self._numbering = self._numbering or Numbering(session)
            self._changed.notify_all()

    def answered(self) -> None:
        """The reply to the first frame without one has come."""
        with self._changed:
            self._unanswered.popleft()
            self._answered += 1

    def stop(self) -> None:
        """Ends the requests of the current attempt."""
        with self._changed:
            self._attempt += 1
            self._changed.notify_all()

    def _requests(self, attempt: int, opening: pb.StreamOpen) -> Iterator[pb.StreamPredictRequest]:
        yield pb.StreamPredictRequest(open=opening)
        with self._changed:
            self._changed.wait_for(
                lambda: attempt != self._attempt or self._acknowledged == attempt
            )
            position = self._answered
        while (request := self._at(position, attempt)) is not None:
            yield request
            position += 1

    def _at(self, position: int, attempt: int) -> pb.StreamPredictRequest | None:
        """The request at a position, taken now if nobody has come so far; None at the end."""
        while True:
            with self._changed:
                while True:
                    if attempt != self._attempt or self.fault is not None:
                        return None
                    if position - self._answered < len(self._unanswered):
                        return self._unanswered[position - self._answered]
                    if self._ended:
                        return None
                    if not self._taking:
                        break
                    # An attempt that has ended since still waits for the frame; it is ours.
                    self._changed.wait()
                self._taking = True
            self._take()

    def _take(self) -> None:
        """Takes a frame, which may last; whichever attempt is the current one then sends it."""
        request = None
        fault = None
        assert self._numbering is not None  # acknowledged
        try:
            if self._iterator is None:
                self._iterator = iter(self._frames)
            request = self._numbering.request(next(self._iterator))
        except StopIteration:
            pass
        except Exception as error:  # noqa: BLE001  raised where the replies are read
            fault = error
        with self._changed:
            self._taking = False
            self.fault = fault
            if request is None:
                self._ended = True
            else:
                self._unanswered.append(request)
            self._changed.notify_all()
        if fault is not None:
            self._on_fault()
