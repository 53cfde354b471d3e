"""A stream of frames into one session: one reply each, in order.

Frames are read ahead into a short queue; whatever waits there is folded as one piece of work,
so that a client that does not wait for replies gets its encoder steps and forecasts batched.

- ``all``: replies wait in a short queue for their reader; when it is full no more frames are
  taken, and the transport's flow control slows the client down.
- ``latest``: every frame is observed and gets its result, but only the newest forecast waits
  for the reader: older ones are left out and marked superseded. The queue of results is long
  and bounded too.

A fault of one frame travels in its reply, and so does a forecast's that would be late: its frame
is observed all the same. A fault of the stream ends it: the session is gone,
the server drains, another stream took the session over.
"""

from __future__ import annotations

import asyncio
import dataclasses
import time
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.forecaster import FrameAnswer, FrameRequest
from trajectron_service.messages import (
    Delivery,
    Forecast,
    FrameResult,
    Outcome,
    SessionInfo,
    StreamFrame,
    StreamOptions,
    StreamReply,
)
from trajectron_service.metrics import Metrics

# Results that may wait under ``latest``, as a multiple of the window of forecasts.
_RESULTS_PER_FORECAST = 64
_ENDS_STREAM = frozenset(
    {
        ErrorKind.UNKNOWN_SESSION,
        ErrorKind.SESSION_DAMAGED,
        ErrorKind.DRAINING,
        # The frames may count or not: the client comes back and sends them again, in order.
        ErrorKind.STORE_UNAVAILABLE,
    }
)
# What time heals: frames wait for it as long as they may take.
_PASSES = frozenset({ErrorKind.OVERLOADED, ErrorKind.RATE_LIMITED})

# Folds frames into the stream's session: the answers, in order.
Fold = Callable[[Sequence[FrameRequest]], Awaitable[list[FrameAnswer]]]


@dataclass(frozen=True)
class StreamLimits:
    """How far a stream runs ahead: frames and forecasts waiting, points in one piece of work."""

    window: int
    max_batch_points: int
    frame_timeout_s: float


@dataclass(frozen=True, slots=True)
class _Received:
    request: FrameRequest
    read_at: float


@dataclass(frozen=True, slots=True)
class _End:
    """No more frames: in good order, or for a fault of the transport or its message."""

    fault: Exception | None = None


class Outbox:
    """Replies waiting for their reader: bounded, in order."""

    def __init__(self, capacity: int, latest_only: bool) -> None:
        self._capacity = capacity
        self._latest_only = latest_only
        self._replies: deque[StreamReply] = deque()
        self._changed = asyncio.Condition()
        self._ended = False
        self._fault: BaseException | None = None

    async def put(self, reply: StreamReply) -> int:
        """Adds a reply, when there is room; how many forecasts it superseded."""
        async with self._changed:
            await self._changed.wait_for(lambda: len(self._replies) < self._capacity)
            superseded = 0
            if self._latest_only and reply.forecast is not None:
                for place, waiting in enumerate(self._replies):
                    if waiting.forecast is not None:
                        self._replies[place] = dataclasses.replace(
                            waiting, forecast=None, superseded=True
                        )
                        superseded += 1
            self._replies.append(reply)
            self._changed.notify_all()
        return superseded

    async def end(self, fault: BaseException | None = None) -> None:
        """No more replies: those waiting are still given, then ``fault`` is raised, if any."""
        async with self._changed:
            self._ended, self._fault = True, fault
            self._changed.notify_all()

    async def get(self) -> StreamReply | None:
        """The next reply; None at the end of a stream without fault."""
        async with self._changed:
            await self._changed.wait_for(lambda: self._replies or self._ended)
            if self._replies:
                self._changed.notify_all()
                return self._replies.popleft()
        if self._fault is not None:
            raise self._fault
        return None


class Stream:
    """One client's stream into a session.

    Attributes:
        session: as it stood when the stream opened.
        resumed: whether it existed before.
    """

    def __init__(
        self,
        session: SessionInfo,
        resumed: bool,
        options: StreamOptions,
        *,
        fold: Fold,
        on_end: Callable[[], Awaitable[None]],
        busy: Callable[[], AbstractContextManager[None]],
        on_close: Callable[[], None],
        limits: StreamLimits,
        metrics: Metrics,
    ) -> None:
        self.session = session
        self.resumed = resumed
        self._options = options
        self._fold = fold
        self._on_end = on_end
        self._busy = busy
        self._on_close = on_close
        self._limits = limits
        self._metrics = metrics
        latest = options.delivery is Delivery.LATEST
        capacity = limits.window * (_RESULTS_PER_FORECAST if latest else 1)
        self._outbox = Outbox(capacity, latest)
        self._inbox: asyncio.Queue[_Received | _End] = asyncio.Queue(limits.window)
        self._version = session.version
        self._points = 1
        self._drain = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []

    async def replies(
        self, frames: AsyncIterator[StreamFrame]
    ) -> AsyncGenerator[StreamReply, None]:
        """One reply to each frame, in order. Close the iterator (``aclosing``) to cancel the work.

        Raises:
            ServiceError: a fault of the stream.
        """
        reader = asyncio.create_task(self._read(frames), name="stream-reader")
        worker = asyncio.create_task(self._work(), name="stream-worker")
        self._tasks = [reader, worker]
        self._metrics.streams.inc()
        try:
            with self._busy():
                while (reply := await self._outbox.get()) is not None:
                    yield reply
                if self._drain.is_set():
                    raise ServiceError(
                        ErrorKind.DRAINING,
                        "the service is stopping; go on after the last sequence acknowledged",
                        retry_after_s=1.0,
                    )
                if self._options.close_session_at_end:
                    await self._on_end()
        finally:
            self._metrics.streams.dec()
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    def close(self) -> None:
        """Says that nobody uses the stream any more, whether its replies were ever read or not."""
        self._on_close()

    def drain(self) -> None:
        """Takes no more frames; those read are still answered, then the stream ends."""
        self._drain.set()

    async def take_over(self) -> None:
        """Ends the stream now: another one has the session."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._outbox.end(
            ServiceError(ErrorKind.CANCELLED, "another stream has taken this session over")
        )

    async def _read(self, frames: AsyncIterator[StreamFrame]) -> None:
        """Moves frames into the inbox until they end, fail, or the service drains."""
        draining = asyncio.create_task(self._drain.wait())
        following: asyncio.Future[StreamFrame] | None = None
        fault: Exception | None = None
        try:
            while not self._drain.is_set():
                following = asyncio.ensure_future(anext(frames))
                await asyncio.wait({following, draining}, return_when=asyncio.FIRST_COMPLETED)
                if not following.done():
                    break
                frame = following.result()
                now = time.monotonic()
                await self._inbox.put(_Received(self._request(frame, now), now))
        except StopAsyncIteration:
            pass
        except Exception as error:  # noqa: BLE001 - whatever the transport raises ends the stream
            fault = error
        finally:
            draining.cancel()
            if following is not None:
                following.cancel()
        await self._inbox.put(_End(fault))

    def _request(self, frame: StreamFrame, read_at: float) -> FrameRequest:
        """The frame with what is asked of it: its own options before the stream's."""
        options = frame.options
        if options is None and frame.fault is None:
            options = self._options.forecast
        timeout_s = self._limits.frame_timeout_s
        if options is not None and options.deadline_s is not None:
            timeout_s = min(timeout_s, options.deadline_s)
        return FrameRequest(
            frame.frame, options, frame.sequence, frame.fault, deadline=read_at + timeout_s
        )

    async def _work(self) -> None:
        """Answers what is in the inbox, until the reader says that there is no more."""
        try:
            end: _End | None = None
            while end is None:
                received, end = await self._next()
                for reply in await self._answer(received):
                    superseded = await self._outbox.put(reply)
                    self._metrics.superseded.inc(superseded + reply.superseded)
                for one in received:
                    elapsed_s = time.monotonic() - one.read_at
                    self._metrics.stream_message_seconds.observe(elapsed_s)
        except Exception as error:  # noqa: BLE001 - a fault of the stream: raised to its reader
            await self._outbox.end(error)
        else:
            await self._outbox.end(end.fault)

    async def _next(self) -> tuple[list[_Received], _End | None]:
        """What waits, at least one unless the stream ends; how it ends, if that is next."""
        most = max(1, min(self._limits.window, self._limits.max_batch_points // self._points))
        received: list[_Received] = []
        one = await self._inbox.get()
        while isinstance(one, _Received):
            received.append(one)
            if len(received) >= most or self._inbox.empty():
                return received, None
            one = self._inbox.get_nowait()
        return received, one

    async def _answer(self, received: Sequence[_Received]) -> list[StreamReply]:
        """The replies to frames read together; under ``latest`` only the last is forecast."""
        if not received:
            return []
        requests = [one.request for one in received]
        dropped = [False] * len(requests)
        if self._options.delivery is Delivery.LATEST:
            for place, request in enumerate(requests[:-1]):
                dropped[place] = request.options is not None
                requests[place] = dataclasses.replace(request, options=None)
        patience = received[0].read_at + self._limits.frame_timeout_s
        try:
            answers = await self._fold_patiently(requests, patience)
        except ServiceError as error:
            if error.kind in _ENDS_STREAM:
                raise
            if len(received) > 1 and error.kind is ErrorKind.INTERNAL:
                # One at a time, so that only the frame at fault fails.
                return [reply for one in received for reply in await self._answer([one])]
            return [self._failure(request, error) for request in requests]
        pairs = zip(requests, answers, dropped, strict=True)
        return [self._reply(request, answer, gone) for request, answer, gone in pairs]

    async def _fold_patiently(
        self, requests: Sequence[FrameRequest], patience: float
    ) -> list[FrameAnswer]:
        """Folds; a full queue or a used-up rate makes the stream wait: its client slows down.

        Only forecasts have a deadline: what has been read is observed, however late.
        """
        while True:
            try:
                return await self._fold(requests)
            except ServiceError as error:
                pause_s = error.retry_after_s or 0.1
                late = time.monotonic() + pause_s >= patience
                if error.kind not in _PASSES or late:
                    raise
                await asyncio.sleep(pause_s)

    def _reply(self, request: FrameRequest, answer: FrameAnswer, dropped: bool) -> StreamReply:
        self._version = answer.result.version
        forecast = answer.forecast
        if forecast is not None:
            self._points = max(1, _points(forecast))
        stale = answer.stale and request.options is not None
        superseded = stale or (dropped and not answer.result.refused)
        assert request.sequence is not None  # every frame of a stream has one
        return StreamReply(request.sequence, answer.result, forecast, superseded, answer.error)

    def _failure(self, request: FrameRequest, error: ServiceError) -> StreamReply:
        """The reply to a frame that was not observed, for no fault of its own or an unknown one."""
        assert request.sequence is not None  # every frame of a stream has one
        result = FrameResult(Outcome.INVALID, self._version, message=error.message)
        return StreamReply(request.sequence, result, error=error)


def _points(forecast: Forecast) -> int:
    """The positions in a forecast: agents x (samples or modes) x steps."""
    if not forecast.agents:
        return 0
    first = forecast.agents[0]
    drawn = first.mode_probabilities if first.samples is None else first.samples
    return len(forecast.agents) * len(drawn) * len(forecast.time_offsets_s)
