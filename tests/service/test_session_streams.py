"""Streams into sessions: order, delivery, resuming, faults, leaving, draining."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Iterable
from contextlib import aclosing

import pytest
from tests.service.building import (
    QUICK,
    Clock,
    application,
    config,
    frame,
    observe_all,
    predict,
    same_forecast,
    turns,
    walk,
)

from trajectron_model.trajectron import Trajectron
from trajectron_service.application import Application, Stream
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.messages import (
    Delivery,
    Forecast,
    ForecastOptions,
    Frame,
    FrameResult,
    Outcome,
    StreamFrame,
    StreamOptions,
    StreamReply,
)
from trajectron_service.streams import Outbox

EACH = StreamOptions(QUICK)
RESULTS_ONLY = StreamOptions(None)
LATEST = StreamOptions(QUICK, Delivery.LATEST)


class Sender:
    """A client's side of a stream: frames when it likes, then hang up or end."""

    def __init__(self) -> None:
        self._queue: asyncio.Queue[StreamFrame | Exception | None] = asyncio.Queue()
        self.taken = 0

    def send(self, sequence: int, one: Frame, options: ForecastOptions | None = None) -> None:
        self._queue.put_nowait(StreamFrame(sequence, one, options))

    def send_all(self, frames: Iterable[Frame], first: int = 1) -> None:
        for sequence, one in enumerate(frames, first):
            self.send(sequence, one)

    def end(self, fault: Exception | None = None) -> None:
        self._queue.put_nowait(fault)

    async def frames(self) -> AsyncIterator[StreamFrame]:
        while True:
            one = await self._queue.get()
            if one is None:
                return
            if isinstance(one, Exception):
                raise one
            self.taken += 1
            yield one


async def run(stream: Stream, frames: Iterable[Frame], first: int = 1) -> list[StreamReply]:
    """Sends all frames and ends; all replies."""
    sender = Sender()
    sender.send_all(frames, first)
    sender.end()
    return [reply async for reply in stream.replies(sender.frames())]


async def next_reply(replies: AsyncIterator[StreamReply]) -> StreamReply:
    return await asyncio.wait_for(anext(replies), 10.0)


async def until_fault(
    replies: AsyncIterator[StreamReply],
) -> tuple[list[StreamReply], ServiceError]:
    """The replies before the fault that ends the stream, and the fault."""
    got: list[StreamReply] = []
    while True:
        try:
            got.append(await next_reply(replies))
        except ServiceError as fault:
            return got, fault


async def test_every_frame_gets_its_reply_in_order_with_its_forecast(app: Application) -> None:
    frames = walk(range(20))
    stream = await app.open_stream("s", config(), EACH)
    assert not stream.resumed
    replies = await run(stream, frames)
    assert [reply.sequence for reply in replies] == list(range(1, 21))
    assert [reply.result.version for reply in replies] == list(range(1, 21))
    for count in (1, 7, 20):
        streamed = replies[count - 1].forecast
        assert streamed is not None
        assert same_forecast(streamed, await predict(app, frames[:count]), 1e-4)


async def test_a_stream_goes_on_with_a_session_and_leaves_it_open(app: Application) -> None:
    await app.create_session("s", config())
    await observe_all(app, "s", walk(range(3)))
    stream = await app.open_stream("s", config(model="ignored for a session that exists"), EACH)
    assert (stream.resumed, stream.session.version) == (True, 3)
    (reply,) = await run(stream, walk([3]), first=40)
    assert reply.result.version == 4
    (info, _) = await app.get_session("s")
    assert (info.version, info.last_sequence) == (4, 40)


async def test_a_session_of_the_streams_own_closes_with_it_when_asked(app: Application) -> None:
    options = StreamOptions(None, close_session_at_end=True)
    stream = await app.open_stream(None, config(), options)
    await run(stream, walk(range(2)))
    with pytest.raises(ServiceError) as refusal:
        await app.get_session(stream.session.id)
    assert refusal.value.kind is ErrorKind.UNKNOWN_SESSION


async def test_resuming_repeats_nothing(app: Application) -> None:
    frames = walk(range(6))
    await run(await app.open_stream("s", config(), EACH), frames[:4])
    again = await app.open_stream("s", config(), EACH)
    assert again.session.last_sequence == 4
    # The client missed the last two replies and sends those frames once more.
    replies = await run(again, frames[2:], first=3)
    assert [reply.result.outcome for reply in replies] == [
        Outcome.DUPLICATE, Outcome.DUPLICATE, Outcome.ACCEPTED, Outcome.ACCEPTED
    ]  # fmt: skip
    assert [reply.superseded for reply in replies] == [True, False, False, False]
    assert [reply.forecast is None for reply in replies] == [True, False, False, False]
    last = replies[-1].forecast
    assert last is not None
    assert same_forecast(last, await predict(app, frames), 1e-4)


async def test_a_fault_of_a_frame_travels_in_its_reply(app: Application) -> None:
    good = walk(range(3))
    bad = [frame(0.5, ann=(math.nan, 0.0)), frame(0.2), frame(0.4, ann=(0.0, 0.0))]
    stream = await app.open_stream("s", config(), EACH)
    replies = await run(stream, [*good[:2], *bad, good[2]])
    assert [reply.result.outcome for reply in replies] == [
        Outcome.ACCEPTED,
        Outcome.ACCEPTED,
        Outcome.INVALID,
        Outcome.OUT_OF_ORDER,
        Outcome.CONFLICT,
        Outcome.ACCEPTED,
    ]
    assert replies[2].result.field == "agents[0].x"
    assert [reply.forecast is None for reply in replies] == [False, False, True, True, True, False]
    assert replies[-1].result.version == 3


async def test_a_forecast_that_cannot_be_made_is_an_error_in_the_reply(app: Application) -> None:
    sender = Sender()
    one, two = walk(range(2))
    sender.send(1, one, ForecastOptions(agents=("zoe",)))
    sender.send(2, two, ForecastOptions(num_samples=9999))
    sender.end()
    stream = await app.open_stream("s", config(), RESULTS_ONLY)
    first, second = [reply async for reply in stream.replies(sender.frames())]
    assert (first.result.outcome, second.result.outcome) == (Outcome.ACCEPTED, Outcome.ACCEPTED)
    assert first.error is not None
    assert second.error is not None
    assert first.error.kind is ErrorKind.UNKNOWN_AGENT
    assert second.error.kind is ErrorKind.INVALID_ARGUMENT


async def test_options_of_a_frame_override_the_streams(app: Application) -> None:
    sender = Sender()
    one, two = walk(range(2))
    sender.send(1, one)
    sender.send(2, two, QUICK)
    sender.end()
    stream = await app.open_stream("s", config(), RESULTS_ONLY)
    first, second = [reply async for reply in stream.replies(sender.frames())]
    assert first.forecast is None
    assert second.forecast is not None


async def test_bad_options_are_refused_when_the_stream_opens(app: Application) -> None:
    with pytest.raises(ServiceError) as refusal:
        await app.open_stream("s", config(), StreamOptions(ForecastOptions(horizon=99)))
    assert refusal.value.kind is ErrorKind.INVALID_ARGUMENT
    assert (await app.list_sessions(None, ""))[0] == ()


async def test_under_latest_a_slow_reader_gets_every_result_and_the_newest_forecast(
    app: Application,
) -> None:
    frames, sender = walk(range(60)), Sender()
    sender.send_all(frames)
    stream = await app.open_stream("s", config(), LATEST)
    async with aclosing(stream.replies(sender.frames())) as replies:
        first = await next_reply(replies)
        sender.end()
        _, worker = stream._tasks
        await asyncio.wait({worker}, timeout=20.0)  # while the reader sleeps
        rest = [reply async for reply in replies]
    got = [first, *rest]
    assert [reply.result.outcome for reply in got] == [Outcome.ACCEPTED] * 60
    waiting = [reply for reply in rest if reply.forecast is not None]
    assert len(waiting) <= 2  # one may have been about to be handed over
    newest = got[-1].forecast
    assert newest is not None
    assert same_forecast(newest, await predict(app, frames), 1e-4)
    assert all(reply.superseded for reply in rest if reply.forecast is None)


async def test_under_all_a_slow_reader_slows_the_stream_and_misses_nothing(
    network: Trajectron,
) -> None:
    app = application(network, stream_window=4)
    sender = Sender()
    sender.send_all(walk(range(60)))
    stream = await app.open_stream("s", config(), EACH)
    async with aclosing(stream.replies(sender.frames())) as replies:
        await next_reply(replies)
        for _ in range(50):
            await asyncio.sleep(0.001)
        # The window of replies, of frames, those being answered, and one in hand at each end.
        assert sender.taken <= 3 * 4 + 3
        sender.end()
        rest = [reply async for reply in replies]
    assert len(rest) == 59
    assert all(reply.forecast is not None for reply in rest)
    await app.close()


async def test_a_client_that_leaves_cancels_its_work_and_the_session_goes_on(
    app: Application,
) -> None:
    sender = Sender()
    sender.send_all(walk(range(40)))
    stream = await app.open_stream("s", config(), EACH)
    async with aclosing(stream.replies(sender.frames())) as replies:
        await next_reply(replies)
    assert all(task.done() for task in stream._tasks)
    version = (await app.get_session("s"))[0].version
    assert version >= 1
    await turns(20)
    assert (await app.get_session("s"))[0].version == version
    (result,) = await app.observe("s", tuple(walk([99])), None)
    assert result.version == version + 1
    assert app._metrics.registry.get_sample_value("trajectron_streams") == 0.0


async def test_a_new_stream_takes_the_session_over(app: Application) -> None:
    sender = Sender()
    sender.send_all(walk(range(2)))
    old = await app.open_stream("s", config(), EACH)
    async with aclosing(old.replies(sender.frames())) as replies:
        await next_reply(replies)
        await next_reply(replies)
        new = await app.open_stream("s", config(), EACH)
        assert (new.resumed, new.session.last_sequence) == (True, 2)
        with pytest.raises(ServiceError) as ended:
            await next_reply(replies)
        assert ended.value.kind is ErrorKind.CANCELLED
    (reply,) = await run(new, walk([2]), first=3)
    assert reply.result.version == 3


async def test_a_stream_ends_when_its_session_is_gone(app: Application) -> None:
    sender = Sender()
    one, two = walk(range(2))
    stream = await app.open_stream("s", config(), EACH)
    async with aclosing(stream.replies(sender.frames())) as replies:
        sender.send(1, one)
        await next_reply(replies)
        await app.delete_session("s")
        sender.send(2, two)
        with pytest.raises(ServiceError) as ended:
            await next_reply(replies)
    assert ended.value.kind is ErrorKind.UNKNOWN_SESSION


async def test_a_fault_of_the_transport_ends_the_stream_after_what_came_before(
    app: Application,
) -> None:
    sender = Sender()
    sender.send_all(walk(range(3)))
    sender.end(ServiceError(ErrorKind.MALFORMED, "this message is none"))
    stream = await app.open_stream("s", config(), EACH)
    replies = stream.replies(sender.frames())
    got, fault = await until_fault(replies)
    assert [reply.sequence for reply in got] == [1, 2, 3]
    assert fault.kind is ErrorKind.MALFORMED


async def test_draining_answers_what_was_read_and_ends_the_stream(app: Application) -> None:
    sender = Sender()
    sender.send_all(walk(range(3)))
    stream = await app.open_stream("s", config(), EACH)
    replies = stream.replies(sender.frames())
    first = await next_reply(replies)
    app.begin_drain()
    rest, fault = await until_fault(replies)
    assert [reply.sequence for reply in (first, *rest)] == list(range(1, sender.taken + 1))
    assert fault.kind is ErrorKind.DRAINING
    await asyncio.wait_for(app.drained(), 5.0)


async def test_frames_of_many_streams_are_batched(app: Application) -> None:
    streams = [await app.open_stream(f"s{k}", config(), EACH) for k in range(6)]
    replies = await asyncio.gather(*(run(stream, walk(range(10))) for stream in streams))
    assert all(len(of_one) == 10 for of_one in replies)
    value = app._metrics.registry.get_sample_value
    batches, jobs = value("trajectron_batch_jobs_count"), value("trajectron_batch_jobs_sum")
    assert batches is not None
    assert jobs is not None
    # 60 frames one by one would be 60 batches.
    assert jobs <= 60
    assert batches <= 20
    assert value("trajectron_stream_message_duration_seconds_count") == 60.0


async def test_a_full_queue_makes_a_stream_wait_and_loses_nothing(network: Trajectron) -> None:
    app = application(network, queue_size=1)
    streams = [await app.open_stream(f"s{k}", config(), EACH) for k in range(4)]
    replies = await asyncio.gather(*(run(stream, walk(range(3))) for stream in streams))
    outcomes = {reply.result.outcome for of_one in replies for reply in of_one}
    assert outcomes == {Outcome.ACCEPTED}
    await app.close()


def reply(sequence: int, forecast: Forecast | None = None) -> StreamReply:
    return StreamReply(sequence, FrameResult(Outcome.ACCEPTED, sequence), forecast)


async def test_an_outbox_waits_for_its_reader_when_full(app: Application) -> None:
    box = Outbox(capacity=2, latest_only=False)
    forecast = await predict(app, walk(range(2)))
    for k in (1, 2):
        assert await box.put(reply(k, forecast)) == 0
    third = asyncio.create_task(box.put(reply(3, forecast)))
    await turns()
    assert not third.done()
    assert (await box.get()) == reply(1, forecast)
    await third
    await box.end()
    assert [await box.get(), await box.get(), await box.get()] == [
        reply(2, forecast), reply(3, forecast), None
    ]  # fmt: skip


async def test_an_outbox_for_the_latest_holds_one_forecast(app: Application) -> None:
    box = Outbox(capacity=9, latest_only=True)
    forecast = await predict(app, walk(range(2)))
    superseded = [await box.put(reply(1, forecast)), await box.put(reply(2))]
    superseded += [await box.put(reply(3, forecast)), await box.put(reply(4, forecast))]
    assert superseded == [0, 0, 1, 1]
    got = [await box.get() for _ in range(4)]
    assert [one and (one.sequence, one.superseded) for one in got] == [
        (1, True), (2, False), (3, True), (4, False)
    ]  # fmt: skip


async def test_a_stream_that_is_silent_keeps_its_session_open(network: Trajectron) -> None:
    clock = Clock()
    app = application(network, clock=clock, idle_timeout_s=60.0)
    sender = Sender()
    stream = await app.open_stream("quiet", config(), RESULTS_ONLY)
    async with aclosing(stream.replies(sender.frames())) as replies:
        sender.send(1, walk([0])[0])
        await next_reply(replies)
        for _ in range(10):
            clock.now += 30.0
            await app.keep_house()
        sender.send(2, walk([1])[0])
        assert (await next_reply(replies)).result.version == 2
    clock.now += 60.0
    await app.keep_house()
    with pytest.raises(ServiceError, match="for want of use"):
        await app.get_session("quiet")
    await app.close()
