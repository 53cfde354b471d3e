"""Streams over the real service: any iterable in, one reply per frame out."""

from __future__ import annotations

import asyncio
import queue
from collections.abc import AsyncIterator, Iterator

import numpy as np
import pytest
from tests.client.crowd import frame, walking
from tests.process import Served

import trajectron_client as tc


@pytest.fixture
def client(served: Served) -> Iterator[tc.Client]:
    with tc.Client(served.grpc_target, timeout_s=30.0) as client:
        yield client


def test_every_frame_has_its_reply_in_order(client: tc.Client) -> None:
    stream = client.stream(
        walking(5), mode="full", num_samples=3, seed=7, close_session_at_end=True
    )
    assert not stream.resumed
    replies = list(stream)
    assert [reply.sequence for reply in replies] == [1, 2, 3, 4, 5]
    assert {reply.result.outcome for reply in replies} == {tc.Outcome.ACCEPTED}
    for step, reply in enumerate(replies):
        assert reply.forecast is not None
        assert reply.forecast.reference_time == pytest.approx(0.4 * step)
    with pytest.raises(tc.UnknownSessionError):
        client.get_session(stream.session.id)


def test_a_stream_says_what_the_session_would_have_said(client: tc.Client) -> None:
    *_, last = client.stream(walking(4), mode="gmm", close_session_at_end=True)
    with client.session() as session:
        session.observe_all(walking(4))
        expected = session.predict(mode="gmm")
    assert last.forecast is not None
    for agent in last.forecast:
        mean = expected[agent.id].mean
        assert agent.mean is not None
        assert mean is not None
        np.testing.assert_allclose(agent.mean, mean, atol=1e-4)


def test_a_stream_goes_on_where_the_session_was(client: tc.Client) -> None:
    with client.session() as session:
        list(client.stream(walking(3), session_id=session.id, forecast_every_frame=False))
        rest = client.stream([frame(3), frame(4)], session_id=session.id, mode="gmm")
        assert rest.resumed
        assert rest.session.last_sequence == 3
        assert [reply.sequence for reply in rest] == [4, 5]
        assert session.describe().info.version == 5


def test_frames_sent_again_after_a_break_are_duplicates(client: tc.Client) -> None:
    with client.session() as session:
        list(client.stream(walking(3), session_id=session.id, mode="gmm"))
        again = [tc.StreamFrame(frame(step), sequence=step + 1) for step in range(1, 5)]
        replies = list(client.stream(again, session_id=session.id, mode="gmm"))
        assert [reply.result.outcome.value for reply in replies] == [
            "duplicate",
            "duplicate",
            "accepted",
            "accepted",
        ]
        assert session.describe().info.version == 5


def test_a_faulty_frame_is_told_in_its_reply_and_the_stream_goes_on(client: tc.Client) -> None:
    broken = tc.Frame(0.4, [tc.Agent("1", "pedestrian", float("nan"), 0.0)])
    first, second, third = client.stream(
        [frame(0), broken, frame(1)], mode="gmm", close_session_at_end=True
    )
    assert (first.result.refused, third.result.refused) == (False, False)
    assert second.result.outcome is tc.Outcome.INVALID
    assert second.result.field.endswith("agents[0].x")
    assert second.forecast is None


def test_a_frame_can_have_options_of_its_own(client: tc.Client) -> None:
    frames: list[tc.Frame | tc.StreamFrame] = [
        frame(0),
        tc.StreamFrame(frame(1), options={"mode": "full", "num_samples": 2, "agents": ["1"]}),
    ]
    first, second = client.stream(frames, forecast_every_frame=False, close_session_at_end=True)
    assert first.forecast is None
    assert second.forecast is not None
    assert [agent.id for agent in second.forecast] == ["1"]


def test_frames_may_come_one_by_one_from_a_queue(client: tc.Client) -> None:
    frames: queue.Queue[tc.Frame | None] = queue.Queue()
    stream = client.stream(iter(frames.get, None), mode="gmm", close_session_at_end=True)
    for step in range(3):
        frames.put(frame(step))
        reply = next(stream)  # answered before the next frame exists
        assert reply.forecast is not None
    frames.put(None)
    assert list(stream) == []


def test_an_error_of_the_frames_is_raised_to_the_reader(client: tc.Client) -> None:
    def sensor() -> Iterator[tc.Frame]:
        yield frame(0)
        raise OSError("the sensor is unplugged")

    with pytest.raises(OSError, match="unplugged"):
        list(client.stream(sensor(), mode="gmm"))


def test_a_refused_stream_raises_when_it_is_opened(client: tc.Client) -> None:
    with pytest.raises(tc.UnknownModelError):
        client.stream(walking(2), config={"model": "no-such-model"})


def test_leaving_the_block_ends_the_stream_and_not_the_session(client: tc.Client) -> None:
    frames: queue.Queue[tc.Frame | None] = queue.Queue()
    with client.session() as session:
        with client.stream(iter(frames.get, None), session_id=session.id, mode="gmm") as stream:
            frames.put(frame(0))
            assert next(stream).result.version == 1
        assert list(stream) == []
        frames.put(None)  # lets gRPC's thread go
        assert session.observe(frame(1)).version == 2


def test_an_asyncio_client_made_outside_of_a_loop_says_so() -> None:
    with pytest.raises(RuntimeError, match="no running event loop"):
        tc.AsyncClient("127.0.0.1:1")


@pytest.mark.asyncio(loop_scope="session")
async def test_the_asyncio_stream_takes_an_async_iterator(served: Served) -> None:
    frames: asyncio.Queue[tc.Frame | None] = asyncio.Queue()

    async def live() -> AsyncIterator[tc.Frame]:
        while (value := await frames.get()) is not None:
            yield value

    async with tc.AsyncClient(served.grpc_target) as client:
        stream = client.stream(live(), mode="gmm", close_session_at_end=True)
        with pytest.raises(RuntimeError, match="not open"):
            _ = stream.session
        async with stream:
            assert stream.session.version == 0
            assert not stream.resumed
            for step in range(3):
                await frames.put(frame(step))
                reply = await anext(stream)
                assert reply.sequence == step + 1
                assert reply.forecast is not None
            await frames.put(None)
            assert [reply async for reply in stream] == []


@pytest.mark.asyncio(loop_scope="session")
async def test_the_asyncio_stream_takes_a_list_and_opens_by_iterating(served: Served) -> None:
    async with tc.AsyncClient(served.grpc_target) as client:
        stream = client.stream(walking(3), mode="gmm", close_session_at_end=True)
        assert [reply.sequence async for reply in stream] == [1, 2, 3]


@pytest.mark.asyncio(loop_scope="session")
async def test_faults_of_the_asyncio_stream_are_raised(served: Served) -> None:
    async def sensor() -> AsyncIterator[tc.Frame]:
        yield frame(0)
        raise OSError("the sensor is unplugged")

    async with tc.AsyncClient(served.grpc_target) as client:
        with pytest.raises(OSError, match="unplugged"):
            _ = [reply async for reply in client.stream(sensor(), mode="gmm")]
        with pytest.raises(tc.UnknownModelError):
            async with client.stream(walking(2), config={"model": "no-such-model"}):
                pass


@pytest.mark.asyncio(loop_scope="session")
async def test_closing_the_asyncio_stream_ends_it(served: Served) -> None:
    never = asyncio.Event()

    async def waiting() -> AsyncIterator[tc.Frame]:
        yield frame(0)
        await never.wait()

    async with tc.AsyncClient(served.grpc_target) as client:
        async with client.stream(waiting(), mode="gmm") as stream:
            assert (await anext(stream)).sequence == 1
        assert [reply async for reply in stream] == []
        await client.delete_session(stream.session.id)
