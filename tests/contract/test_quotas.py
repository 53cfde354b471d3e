"""Quotas of tenants, over both transports: what is refused, how, and that nothing has changed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
import pytest_asyncio
from tests.contract.drivers import (
    Driver,
    GrpcDriver,
    HttpDriver,
    RefusalError,
    frame_message,
    grpc_refusal,
    http_refusal,
    options_message,
    status_refusal,
)
from tests.contract.evaluation_drivers import (
    EvaluationDriver,
    GrpcEvaluationDriver,
    HttpEvaluationDriver,
)
from tests.contract.recordings import walkers
from tests.contract.scenes import walking
from tests.contract.servers import small_settings

from trajectron_client import Access, Agent, AsyncClient, Frame, RateLimitedError
from trajectron_proto.v1 import evaluation_pb2 as epb
from trajectron_proto.v1 import evaluation_pb2_grpc
from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service.lifecycle import Service, running
from trajectron_service.tenancy import Scope
from trajectron_service.tokens import entry, new_token

pytestmark = pytest.mark.asyncio(loop_scope="module")

SCOPES = [Scope.PREDICT, Scope.SESSIONS, Scope.EVALUATE]
# Two tokens of one tenant, and one of another, which has no quotas.
TOKENS = {"ann": new_token(), "anns other": new_token(), "bob": new_token()}
HOLDERS = "".join(
    entry(TOKENS[name], tenant, SCOPES)
    for name, tenant in (("ann", "ann"), ("anns other", "ann"), ("bob", "bob"))
)
# So little that nothing comes back in the time of a test.
TRICKLE = 0.001


@dataclass(frozen=True)
class Place:
    """A running service, and the file of its tokens."""

    service: Service
    file: Path

    def quotas(self, **quotas: float) -> None:
        """Sets the quotas of ann, whose buckets are full again."""
        lines = [f"{name} = {value}" for name, value in quotas.items()]
        self.file.write_text("\n".join([HOLDERS, "[tenants.ann]", *lines]))
        self.service.admission.reload()
        self.service.admission._usage._buckets.clear()

    def refusals(self, quota: str, tenant: str = "ann") -> float:
        found = self.service.metrics.registry.get_sample_value(
            "trajectron_quota_refusals_total", {"tenant": tenant, "quota": quota}
        )
        return found or 0.0


class Bearer(grpc.aio.UnaryUnaryClientInterceptor):
    """Shows a token with every call."""

    def __init__(self, name: str) -> None:
        self.name = name

    async def intercept_unary_unary(self, continuation: Any, details: Any, request: Any) -> Any:
        shown = grpc.aio.Metadata(*metadata(self.name))
        return await continuation(details._replace(metadata=shown), request)


def metadata(name: str) -> list[tuple[str, str]]:
    return [("authorization", f"Bearer {TOKENS[name]}")]


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def served(
    model_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> AsyncIterator[Place]:
    file = tmp_path_factory.mktemp("tokens") / "tokens.toml"
    file.write_text(HOLDERS)
    settings = small_settings(model_path, tokens=file, warm_up=False, request_timeout_s=20.0)
    async with running(settings) as service:
        yield Place(service, file)


@pytest_asyncio.fixture(loop_scope="module")
async def place(served: Place) -> AsyncIterator[Place]:
    """Nobody has quotas or sessions, before and after."""
    yield served
    served.quotas()
    for name in ("ann", "bob"):
        async with over(served, "http", name) as (driver, _):
            for session in (await driver.list_sessions(1000))["sessions"]:
                await driver.delete_session(session["id"])


@asynccontextmanager
async def over(
    place: Place, transport: str, name: str
) -> AsyncIterator[tuple[Driver, EvaluationDriver]]:
    """Somebody's way to call, over one transport."""
    service = place.service
    headers = {"Authorization": f"Bearer {TOKENS[name]}"}
    url = f"http://127.0.0.1:{service.http_port}"
    if transport == "http":
        async with httpx.AsyncClient(base_url=url, headers=headers, timeout=60.0) as http:
            yield HttpDriver(http), HttpEvaluationDriver(http)
        return
    target = f"127.0.0.1:{service.grpc_port}"
    async with grpc.aio.insecure_channel(target, interceptors=[Bearer(name)]) as channel:
        yield GrpcDriver(channel), GrpcEvaluationDriver(channel)


class Stream:
    """A stream of somebody's, with a forecast after every frame unless told otherwise."""

    def __init__(self, channel: grpc.aio.Channel, name: str) -> None:
        self.call: Any = GrpcDriver(channel).stub.StreamPredict(metadata=metadata(name))

    async def open(self, session_id: str = "", **options: Any) -> pb.StreamOpened:
        """Raises ``RefusalError``."""
        opening = pb.StreamOpen(session_id=session_id)
        if options:
            opening.options.CopyFrom(options_message(options))
        try:
            async with asyncio.timeout(30):
                await self.call.write(pb.StreamPredictRequest(open=opening))
                opened: pb.StreamOpened = (await self.call.read()).opened
        except grpc.aio.AioRpcError as error:
            raise grpc_refusal(error) from None
        return opened

    async def send(self, *frames: Any, first: int = 1) -> list[pb.StreamFrameReply]:
        for sequence, one in enumerate(frames, first):
            sent = pb.StreamFrame(sequence=sequence, frame=frame_message(one))
            await self.call.write(pb.StreamPredictRequest(frame=sent))
        async with asyncio.timeout(30):
            return [(await self.call.read()).reply for _ in frames]


@pytest_asyncio.fixture(loop_scope="module")
async def channel(place: Place) -> AsyncIterator[grpc.aio.Channel]:
    async with grpc.aio.insecure_channel(f"127.0.0.1:{place.service.grpc_port}") as channel:
        yield channel


def refused(error: RefusalError, kind: str, transport: str) -> None:
    """As the contract has it: a code, a time to come back, words about the tenant."""
    code = "429" if transport == "http" else "RESOURCE_EXHAUSTED"
    assert (error.kind, error.code) == (kind, code)
    assert error.retry_after_s is not None
    assert error.retry_after_s > 0.0
    assert "your tenant may" in error.message


both = pytest.mark.parametrize("transport", ["http", "grpc"])


@both
async def test_sessions_of_a_tenant_are_bounded_and_those_of_others_are_not(
    place: Place, transport: str
) -> None:
    place.quotas(sessions=2)
    async with over(place, transport, "ann") as (ann, _), over(place, "http", "bob") as (bob, _):
        for name in ("a", "b"):
            await ann.create_session(name)
        with pytest.raises(RefusalError) as told:
            await ann.create_session("c")
        refused(told.value, "TOO_MANY_SESSIONS", transport)
        assert [one["id"] for one in (await ann.list_sessions())["sessions"]] == ["a", "b"]
        for name in ("a", "b", "c"):
            await bob.create_session(name)
        await ann.delete_session("a")
        await ann.create_session("c")


@both
async def test_calls_are_counted_for_all_tokens_of_a_tenant(place: Place, transport: str) -> None:
    place.quotas(requests_per_s=TRICKLE)
    before = place.refusals("requests_per_s")
    async with (
        over(place, transport, "ann") as (ann, _),
        over(place, transport, "anns other") as (other, _),
        over(place, transport, "bob") as (bob, _),
    ):
        await ann.create_session("mine")
        with pytest.raises(RefusalError) as told:
            await other.delete_session("mine")
        refused(told.value, "RATE_LIMITED", transport)
        for _ in range(5):
            await bob.list_models()
        assert place.refusals("requests_per_s") == before + 1
        assert place.refusals("requests_per_s", "bob") == 0.0
        place.quotas()
        assert (await ann.get_session("mine"))["id"] == "mine"


@both
async def test_frames_beyond_the_rate_are_refused_and_leave_the_session_alone(
    place: Place, transport: str
) -> None:
    place.quotas(frames_per_s=TRICKLE)
    frames = walking(4)
    async with over(place, transport, "ann") as (ann, _):
        await ann.create_session("s")
        with pytest.raises(RefusalError, match="UNKNOWN_SESSION"):
            await ann.observe("nobody's", frames[:1])  # refused: what it took is given back
        await ann.observe("s", frames[:1])
        for asked in (ann.observe("s", frames[1:2]), ann.observe("s", frames[1:]),
                      ann.predict(frames)):  # fmt: skip
            with pytest.raises(RefusalError) as told:
                await asked
            refused(told.value, "RATE_LIMITED", transport)
            assert "frames a second" in told.value.message
        assert (await ann.get_session("s"))["version"] == 1
        place.quotas()
        assert [one["version"] for one in await ann.observe("s", frames[1:])] == [2, 3, 4]


@both
async def test_points_beyond_the_rate_are_refused(place: Place, transport: str) -> None:
    place.quotas(points_per_s=TRICKLE)
    asked = {"num_samples": 2, "horizon": 3, "seed": 1}
    async with over(place, transport, "ann") as (ann, _):
        await ann.create_session("s")
        await ann.observe("s", walking(2))
        with pytest.raises(RefusalError, match="INVALID_ARGUMENT"):
            await ann.predict_session("s", num_samples=10**6)
        await ann.predict_session("s", **asked)
        for again in (ann.predict_session("s", **asked), ann.predict(walking(2), **asked)):
            with pytest.raises(RefusalError) as told:
                await again
            refused(told.value, "RATE_LIMITED", transport)
            assert "agents x samples x steps" in told.value.message
        assert (await ann.get_session("s"))["version"] == 2


@both
@pytest.mark.usefixtures("endless_evaluations")
async def test_watching_counts_as_a_stream(place: Place, transport: str) -> None:
    place.quotas(streams=1)
    async with over(place, transport, "ann") as (_, ann):
        asked: Any = {"models": ["constant-velocity"]}
        await ann.create({"square.csv": walkers()}, evaluation_id="a", **asked)
        async with watching(place, transport, "ann") as events:
            assert await anext(events)
            with pytest.raises(RefusalError) as told:
                async with watching(place, transport, "anns other") as others:
                    await anext(others)
        refused(told.value, "TOO_MANY_STREAMS", transport)
        async with asyncio.timeout(30):
            while place.service.admission._usage._streams["ann"]:  # noqa: ASYNC110  the server's time
                await asyncio.sleep(0.01)
        async with watching(place, transport, "anns other") as events:
            assert await anext(events)
        await ann.delete("a")


@asynccontextmanager
async def watching(place: Place, transport: str, name: str) -> AsyncIterator[AsyncIterator[Any]]:
    """What comes while evaluation ``a`` is watched; raises ``RefusalError``."""
    service = place.service
    if transport == "http":
        headers = {"Authorization": f"Bearer {TOKENS[name]}"}
        url = f"http://127.0.0.1:{service.http_port}/v1/evaluations/a:watch"
        async with (
            httpx.AsyncClient(headers=headers, timeout=30.0) as http,
            http.stream("GET", url) as answer,
        ):
            if answer.is_error:
                await answer.aread()
                raise http_refusal(answer)
            yield answer.aiter_lines()
        return
    async with grpc.aio.insecure_channel(f"127.0.0.1:{service.grpc_port}") as channel:
        asked = epb.WatchEvaluationRequest(evaluation_id="a")
        stub: Any = evaluation_pb2_grpc.EvaluationServiceStub(channel)
        call = stub.WatchEvaluation(asked, metadata=metadata(name), timeout=30)
        try:
            yield aiter(call)
        except grpc.aio.AioRpcError as error:
            raise grpc_refusal(error) from None
        finally:
            call.cancel()


@both
@pytest.mark.usefixtures("endless_evaluations")
async def test_evaluations_of_a_tenant_are_bounded(place: Place, transport: str) -> None:
    files = {"square.csv": walkers()}
    asked: Any = {"models": ["constant-velocity"]}
    place.quotas(evaluations=2, evaluations_active=1)
    async with over(place, transport, "ann") as (_, ann), over(place, "grpc", "bob") as (_, bob):
        await ann.create(files, evaluation_id="a", **asked)
        with pytest.raises(RefusalError) as told:
            await ann.create(files, evaluation_id="b", **asked)
        refused(told.value, "TOO_MANY_EVALUATIONS", transport)
        assert "queued or running" in told.value.message
        await ann.cancel("a")
        await ann.create(files, evaluation_id="b", **asked)
        await ann.cancel("b")
        with pytest.raises(RefusalError) as told:
            await ann.create(files, evaluation_id="c", **asked)
        refused(told.value, "TOO_MANY_EVALUATIONS", transport)
        assert "kept" in told.value.message
        assert [one["id"] for one in (await ann.list_page())["evaluations"]] == ["b", "a"]
        for name in ("a", "b", "c"):
            await bob.create(files, evaluation_id=name, **asked)
            await bob.delete(name)
        for name in ("a", "b"):
            await ann.delete(name)


async def test_streams_of_a_tenant_are_bounded(place: Place, channel: grpc.aio.Channel) -> None:
    place.quotas(streams=1)
    first = Stream(channel, "ann")
    session_id = (await first.open()).session.id
    for name in ("ann", "anns other"):
        with pytest.raises(RefusalError) as told:
            await Stream(channel, name).open("another")
        refused(told.value, "TOO_MANY_STREAMS", "grpc")
    async with over(place, "grpc", "ann") as (ann, _):
        sessions = (await ann.list_sessions())["sessions"]
    assert [one["id"] for one in sessions] == [session_id]  # nothing was opened
    assert (await Stream(channel, "bob").open("another")).session.id == "another"
    # Who comes back after a break takes over, and is not one more.
    again = Stream(channel, "anns other")
    assert (await again.open(session_id)).resumed
    assert await first.call.code() is grpc.StatusCode.CANCELLED
    again.call.cancel()
    async with asyncio.timeout(30):
        while True:  # the server sees the end in its own time
            try:
                await Stream(channel, "ann").open("another")
            except RefusalError:
                await asyncio.sleep(0.02)
            else:
                break


async def test_frames_of_a_stream_wait_for_their_turn(
    place: Place, channel: grpc.aio.Channel
) -> None:
    place.quotas(frames_per_s=2)
    stream = Stream(channel, "ann")
    await stream.open()
    before = place.refusals("frames_per_s")
    frames = walking(5)
    replies = await stream.send(*frames[:4])
    replies += await stream.send(frames[4], first=5)
    assert [reply.result.version for reply in replies] == [1, 2, 3, 4, 5]
    assert not any(reply.HasField("error") for reply in replies)
    assert place.refusals("frames_per_s") > before  # some had to wait
    stream.call.cancel()


async def test_frames_of_a_stream_that_would_wait_too_long_are_refused_in_their_replies(
    place: Place, channel: grpc.aio.Channel
) -> None:
    place.quotas(frames_per_s=TRICKLE)
    stream, frames = Stream(channel, "ann"), walking(3)
    await stream.open()
    first, second = await stream.send(*frames[:1]) + await stream.send(frames[1], first=2)
    assert first.result.version == second.result.version == 1
    told = status_refusal(second.error)
    assert (told.kind, told.message) == (
        "RATE_LIMITED", "your tenant may ask for 0.001 frames a second",
    )  # fmt: skip
    place.quotas()
    (third,) = await stream.send(frames[2], first=3)
    assert (third.result.version, third.HasField("error")) == (2, False)
    stream.call.cancel()


async def test_a_forecast_of_a_stream_beyond_the_rate_is_refused_in_its_reply(
    place: Place, channel: grpc.aio.Channel
) -> None:
    place.quotas(points_per_s=TRICKLE)
    stream = Stream(channel, "ann")
    await stream.open(num_samples=2, horizon=3)
    first, *others = await stream.send(*walking(3))
    assert len(first.forecast.agents) == 3
    for number, reply in enumerate(others, 2):
        assert (reply.result.version, reply.HasField("forecast")) == (number, False)
        told = status_refusal(reply.error)
        assert told.kind == "RATE_LIMITED"
        assert told.retry_after_s is not None
        assert told.retry_after_s > 0.0
    stream.call.cancel()


async def test_the_client_goes_on_after_a_refused_forecast(place: Place) -> None:
    place.quotas(points_per_s=TRICKLE)
    access = Access(token=TOKENS["ann"])
    async with AsyncClient(f"127.0.0.1:{place.service.grpc_port}", access=access) as client:
        frames = [
            Frame(one["time"], [Agent(a["id"], a["type"], a["x"], a["y"]) for a in one["agents"]])
            for one in walking(3)
        ]
        replies = [reply async for reply in client.stream(frames, num_samples=2)]
    assert [reply.error is None for reply in replies] == [True, False, False]
    assert isinstance(replies[-1].error, RateLimitedError)
    assert replies[-1].error.retry_after_s
    assert replies[-1].result.version == 3
