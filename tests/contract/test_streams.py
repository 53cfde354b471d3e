"""What holds of streams: order, outcomes, delivery to slow readers, resuming, hanging up."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from typing import Any

import grpc
import numpy as np
import pytest
from tests.contract.drivers import (
    GrpcDriver,
    Json,
    RefusalError,
    forecast_view,
    frame_message,
    grpc_refusal,
    options_message,
    result_view,
    status_refusal,
)
from tests.contract.scenes import DT_S, agent, frame, walking

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service.lifecycle import Service

pytestmark = pytest.mark.asyncio(loop_scope="session")


class Stream:
    """A stream from the client's side; every read has a time limit."""

    def __init__(self, call: Any) -> None:
        self.call = call

    async def send(self, sequence: int, one: Json, **options: Any) -> None:
        await self.call.write(
            pb.StreamPredictRequest(
                frame=pb.StreamFrame(
                    sequence=sequence,
                    frame=frame_message(one),
                    options=options_message(options) if options else None,
                )
            )
        )

    async def send_all(self, frames: Iterable[Json], first: int = 1) -> None:
        for sequence, one in enumerate(frames, first):
            await self.send(sequence, one)

    async def next(self) -> Any:
        """The next message, or EOF."""
        async with asyncio.timeout(30):
            message = await self.call.read()
        return message if message is grpc.aio.EOF else message.reply

    async def replies(self, number: int) -> list[pb.StreamFrameReply]:
        return [await self.next() for _ in range(number)]


@asynccontextmanager
async def opened(
    channel: grpc.aio.Channel, **fields: Any
) -> AsyncIterator[tuple[Stream, pb.StreamOpened]]:
    """A stream that the server has acknowledged; cancelled at the end if it is still open."""
    fields.setdefault("options", options_message({"num_samples": 2, "seed": 1}))
    call: Any = GrpcDriver(channel).stub.StreamPredict()
    try:
        await call.write(pb.StreamPredictRequest(open=pb.StreamOpen(**fields)))
        async with asyncio.timeout(30):
            first = await call.read()
        yield Stream(call), first.opened
    finally:
        call.cancel()


async def test_frames_go_in_and_replies_come_out_in_order(channel: grpc.aio.Channel) -> None:
    async with opened(channel, close_session_at_end=True) as (stream, ack):
        assert not ack.resumed
        assert ack.session.id
        await stream.send_all(walking(6))
        await stream.call.done_writing()
        replies = await stream.replies(6)
        assert [one.sequence for one in replies] == [1, 2, 3, 4, 5, 6]
        assert [one.result.version for one in replies] == [1, 2, 3, 4, 5, 6]
        for number, one in enumerate(replies):
            assert one.forecast.reference_time_s == pytest.approx(DT_S * number)
            assert len(one.forecast.agents) == 3
        assert await stream.next() is grpc.aio.EOF
        assert await stream.call.code() is grpc.StatusCode.OK
    with pytest.raises(RefusalError, match="UNKNOWN_SESSION"):
        await GrpcDriver(channel).get_session(ack.session.id)


async def test_a_streams_forecasts_are_those_of_single_calls(channel: grpc.aio.Channel) -> None:
    driver = GrpcDriver(channel)
    await driver.create_session("single")
    options = {"mode": "gmm", "horizon": 5}
    async with opened(channel, close_session_at_end=True, options=options_message(options)) as (
        stream,
        _,
    ):
        for sequence, one in enumerate(walking(5), 1):
            await stream.send(sequence, one)
            [streamed] = await stream.replies(1)
            await driver.observe("single", [one])
            single = await driver.predict_session("single", **options)
            for ours, theirs in zip(
                forecast_view(streamed.forecast)["agents"], single["agents"], strict=True
            ):
                np.testing.assert_allclose(ours["mean"], theirs["mean"], atol=1e-4)
    await driver.delete_session("single")


async def test_the_first_message_must_open_the_stream(channel: grpc.aio.Channel) -> None:
    call: Any = GrpcDriver(channel).stub.StreamPredict()
    await call.write(pb.StreamPredictRequest(frame=pb.StreamFrame(sequence=1)))
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        await call.read()
    refusal = grpc_refusal(caught.value)
    assert (refusal.kind, refusal.fields) == ("INVALID_ARGUMENT", ("open",))


async def test_a_stream_without_any_message_is_refused_too(channel: grpc.aio.Channel) -> None:
    call: Any = GrpcDriver(channel).stub.StreamPredict()
    await call.done_writing()
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        await call.read()
    assert grpc_refusal(caught.value).fields == ("open",)


async def test_a_stream_is_opened_once(channel: grpc.aio.Channel) -> None:
    async with opened(channel, close_session_at_end=True) as (stream, _):
        await stream.call.write(pb.StreamPredictRequest(open=pb.StreamOpen()))
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await stream.next()
        assert grpc_refusal(caught.value).fields == ("frame",)


async def test_faults_of_frames_travel_in_their_replies(channel: grpc.aio.Channel) -> None:
    async with opened(channel, close_session_at_end=True) as (stream, _):
        good = walking(3)
        bad = [
            frame(DT_S, agent("0", math.nan)),
            frame(DT_S, agent("0", kind="dragon")),
            frame(0.0, agent("0", 5.0)),
            frame(-1.0, agent("0")),
            {"agents": []},
        ]
        await stream.send_all([good[0], *bad, good[1], good[2]])
        replies = [result_view(one.result) for one in await stream.replies(8)]
        assert [one["outcome"] for one in replies] == [
            "accepted", "invalid", "invalid", "conflict", "out_of_order", "invalid",
            "accepted", "accepted",
        ]  # fmt: skip
        assert replies[1]["field"] == "agents[0].x"
        assert replies[2]["field"] == "agents[0].type"
        assert replies[5]["field"] == "time"
        assert all(one["message"] for one in replies[1:6])
        assert [one["version"] for one in replies] == [1, 1, 1, 1, 1, 1, 2, 3]


async def test_a_forecast_that_fails_says_why_and_the_frame_counts(
    channel: grpc.aio.Channel,
) -> None:
    async with opened(channel, close_session_at_end=True) as (stream, _):
        first, second = walking(2)
        await stream.send(1, first, agents=["nobody"])
        await stream.send(2, second)
        failed, fine = await stream.replies(2)
        assert result_view(failed.result)["outcome"] == "accepted"
        assert status_refusal(failed.error).kind == "UNKNOWN_AGENT"
        assert not failed.HasField("forecast")
        assert fine.HasField("forecast")
        assert not fine.HasField("error")


@pytest.mark.parametrize("delivery", ["STREAM_DELIVERY_ALL", "STREAM_DELIVERY_LATEST"])
async def test_options_that_mean_nothing_are_a_fault_of_their_frame(
    channel: grpc.aio.Channel, delivery: str
) -> None:
    async with opened(channel, delivery=delivery, close_session_at_end=True) as (stream, _):
        for sequence, one in enumerate(walking(3), 1):
            options = pb.ForecastOptions(mode=99) if sequence == 2 else None  # type: ignore[arg-type]  # no such mode
            message = pb.StreamFrame(sequence=sequence, frame=frame_message(one), options=options)
            await stream.call.write(pb.StreamPredictRequest(frame=message))
        await stream.call.done_writing()
        replies = await stream.replies(3)
        assert [result_view(one.result)["outcome"] for one in replies] == ["accepted"] * 3
        refusal = status_refusal(replies[1].error)
        assert (refusal.kind, refusal.fields) == ("INVALID_ARGUMENT", ("options.mode",))
        assert "99" in refusal.message
        assert not replies[1].HasField("forecast")
        assert not replies[1].superseded
        assert replies[2].HasField("forecast")
        assert await stream.next() is grpc.aio.EOF
        assert await stream.call.code() is grpc.StatusCode.OK


async def test_frames_may_bring_options_of_their_own(channel: grpc.aio.Channel) -> None:
    async with opened(channel, forecast_every_frame=False) as (stream, ack):
        first, second = walking(2)
        await stream.send(1, first)
        await stream.send(2, second, mode="gmm", horizon=3)
        plain, asked = await stream.replies(2)
        assert not plain.HasField("forecast")
        assert not plain.superseded
        assert len(asked.forecast.time_offsets_s) == 3
    await GrpcDriver(channel).delete_session(ack.session.id)


async def test_a_stream_is_resumed_after_the_last_sequence(channel: grpc.aio.Channel) -> None:
    frames = walking(6)
    async with opened(channel, session_id="resumed") as (stream, ack):
        assert (ack.session.id, ack.resumed) == ("resumed", False)
        await stream.send_all(frames[:3])
        await stream.replies(3)
    async with opened(channel, session_id="resumed", close_session_at_end=True) as (stream, ack):
        assert ack.resumed
        assert ack.session.last_sequence == 3
        assert ack.session.version == 3
        # The client is not sure what arrived, so it sends the last frame again.
        await stream.send_all(frames[2:], first=3)
        await stream.call.done_writing()
        replies = await stream.replies(4)
        outcomes = [result_view(one.result)["outcome"] for one in replies]
        assert outcomes == ["duplicate", "accepted", "accepted", "accepted"]
        assert replies[-1].result.version == 6
        assert await stream.next() is grpc.aio.EOF


async def test_a_slow_reader_of_latest_gets_every_result_and_the_newest_forecast(
    channel: grpc.aio.Channel,
) -> None:
    frames = [
        frame(DT_S * k, *(agent(str(n), 0.5 * k, float(n)) for n in range(10))) for k in range(300)
    ]
    options = options_message({"num_samples": 100, "horizon": 12, "seed": 1})
    async with opened(
        channel,
        delivery="STREAM_DELIVERY_LATEST",
        options=options,
        close_session_at_end=True,
    ) as (stream, _):
        await stream.send_all(frames)
        await stream.call.done_writing()
        replies = await stream.replies(300)
        assert [one.sequence for one in replies] == list(range(1, 301))
        assert {result_view(one.result)["outcome"] for one in replies} == {"accepted"}
        for one in replies:
            assert one.HasField("forecast") != one.superseded
        assert replies[-1].HasField("forecast")
        assert any(one.superseded for one in replies)
        assert await stream.next() is grpc.aio.EOF


async def test_a_slow_reader_of_all_gets_every_forecast(channel: grpc.aio.Channel) -> None:
    async with opened(channel, close_session_at_end=True) as (stream, _):
        sending = asyncio.create_task(stream.send_all(walking(100)))
        await asyncio.sleep(0.3)
        replies = await stream.replies(100)
        await sending
        assert [one.sequence for one in replies] == list(range(1, 101))
        assert all(one.HasField("forecast") for one in replies)


async def test_hanging_up_frees_the_stream_and_keeps_the_session(
    channel: grpc.aio.Channel, service: Service
) -> None:
    await streams_open(service, 0)
    async with opened(channel, session_id="hung-up") as (stream, _):
        await stream.send_all(walking(2))
        await stream.replies(2)
        await streams_open(service, 1)
        stream.call.cancel()
        await streams_open(service, 0)
    state = await GrpcDriver(channel).get_session("hung-up")
    assert state["version"] == 2
    async with opened(channel, session_id="hung-up", close_session_at_end=True) as (stream, ack):
        assert ack.resumed
        await stream.send(3, walking(3)[2])
        [reply] = await stream.replies(1)
        assert reply.result.version == 3
        await stream.call.done_writing()
        assert await stream.next() is grpc.aio.EOF


async def test_a_deleted_session_ends_its_stream(channel: grpc.aio.Channel) -> None:
    async with opened(channel, session_id="deleted") as (stream, _):
        await stream.send(1, walking(1)[0])
        await stream.replies(1)
        await GrpcDriver(channel).delete_session("deleted")
        await stream.send(2, walking(2)[1])
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await stream.next()
        assert grpc_refusal(caught.value).kind == "UNKNOWN_SESSION"


async def streams_open(service: Service, number: int) -> None:
    """Returns once the server holds as many streams as that."""
    async with asyncio.timeout(10):
        gauge = service.metrics.registry.get_sample_value
        while gauge("trajectron_streams") != number:  # noqa: ASYNC110  a gauge has no event
            await asyncio.sleep(0.02)
