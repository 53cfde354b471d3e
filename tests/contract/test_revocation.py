"""What becomes of open streams when their token is withdrawn, expires, or loses a scope."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
import pytest_asyncio
from tests.contract.drivers import frame_message
from tests.contract.scenes import walking
from tests.contract.servers import small_settings

from trajectron_proto.v1 import evaluation_pb2 as epb
from trajectron_proto.v1 import evaluation_pb2_grpc, trajectron_pb2_grpc
from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service.lifecycle import Service, running
from trajectron_service.tenancy import Scope
from trajectron_service.tokens import entry, new_token

pytestmark = pytest.mark.asyncio(loop_scope="module")

SCOPES = [Scope.PREDICT, Scope.SESSIONS, Scope.EVALUATE]
TOKENS = {"ann": new_token(), "bob": new_token()}
CSV = b"time,id,type,x,y\n" + b"".join(
    b"%.1f,a,pedestrian,%.1f,0\n" % (0.4 * step, 0.4 * step) for step in range(24)
)


@dataclass(frozen=True)
class Place:
    """A running service with two tenants, and the file that says so."""

    service: Service
    file: Path
    channel: grpc.aio.Channel

    def http(self, name: str) -> httpx.AsyncClient:
        return httpx.AsyncClient(
            base_url=f"http://127.0.0.1:{self.service.http_port}",
            headers={"Authorization": f"Bearer {TOKENS[name]}"},
            timeout=30.0,
        )

    def holders(self, *names: str, scopes: list[Scope] = SCOPES) -> None:
        """Has the file name these only, and the service read it as on SIGHUP."""
        self.file.write_text("\n".join(entry(TOKENS[name], name, scopes) for name in names))
        self.service.admission.reload()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def served(
    model_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> AsyncIterator[Place]:
    file = tmp_path_factory.mktemp("tokens") / "tokens.toml"
    file.write_text("")
    async with (
        running(small_settings(model_path, tokens=file, warm_up=False)) as service,
        grpc.aio.insecure_channel(f"127.0.0.1:{service.grpc_port}") as channel,
    ):
        yield Place(service, file, channel)


@pytest.fixture
def place(served: Place) -> Place:
    """Both have their tokens."""
    served.holders("ann", "bob")
    return served


class Stream:
    """A stream of somebody's, open."""

    def __init__(self, place: Place, name: str) -> None:
        self.call: Any = trajectron_pb2_grpc.TrajectronServiceStub(place.channel).StreamPredict(
            metadata=metadata(name)
        )
        self._sent = 0

    async def open(self) -> Stream:
        await self.call.write(pb.StreamPredictRequest(open=pb.StreamOpen()))
        async with asyncio.timeout(30):
            assert (await self.call.read()).opened.session.id
        return self

    async def goes_on(self) -> bool:
        """Whether one more frame is answered."""
        one = walking(self._sent + 1)[-1]
        self._sent += 1
        sent = pb.StreamFrame(sequence=self._sent, frame=frame_message(one))
        async with asyncio.timeout(30):
            try:
                await self.call.write(pb.StreamPredictRequest(frame=sent))
                answer = await self.call.read()
            except (grpc.aio.AioRpcError, asyncio.InvalidStateError):
                return False
        return answer is not grpc.aio.EOF and answer.reply.sequence == self._sent

    async def end(self) -> grpc.StatusCode:
        """How it ends by itself."""
        async with asyncio.timeout(30):
            code: grpc.StatusCode = await self.call.code()
        return code


def metadata(name: str) -> list[tuple[str, str]]:
    return [("authorization", f"Bearer {TOKENS[name]}")]


async def test_a_withdrawn_token_ends_its_streams_and_no_others(place: Place) -> None:
    ann, bob = await Stream(place, "ann").open(), await Stream(place, "bob").open()
    assert await ann.goes_on()
    place.holders("bob")
    assert await ann.end() is grpc.StatusCode.UNAUTHENTICATED
    assert "withdrawn" in await ann.call.details()
    assert await bob.goes_on()
    async with place.http("ann") as http:
        assert (await http.get("/v1/sessions")).status_code == 401
    bob.call.cancel()


async def test_a_stream_that_never_pauses_ends_too(place: Place) -> None:
    ann = await Stream(place, "ann").open()
    place.service.admission.look()
    for _ in range(3):
        assert await ann.goes_on()
    place.holders("bob")
    assert not await ann.goes_on()
    assert await ann.end() is grpc.StatusCode.UNAUTHENTICATED


async def test_a_token_without_its_scope_ends_its_streams(place: Place) -> None:
    ann = await Stream(place, "ann").open()
    place.holders("ann", scopes=[Scope.PREDICT])
    assert await ann.end() is grpc.StatusCode.PERMISSION_DENIED


async def test_an_emptied_file_ends_everything(place: Place) -> None:
    streams = [await Stream(place, name).open() for name in TOKENS]
    place.file.write_text("")
    place.service.admission.reload()
    for stream in streams:
        assert await stream.end() is grpc.StatusCode.UNAUTHENTICATED


async def test_a_file_that_cannot_be_used_ends_nothing(place: Place) -> None:
    ann = await Stream(place, "ann").open()
    place.file.write_text("[[token]")
    place.service.admission.reload()
    assert await ann.goes_on()
    ann.call.cancel()


async def test_a_token_that_expires_ends_its_streams_without_being_asked(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service looks by itself, each second."""
    place.file.write_text(
        entry(TOKENS["ann"], "ann", SCOPES)
        + "expires = 2100-01-01T00:00:00Z\n"
        + entry(TOKENS["bob"], "bob", SCOPES)
    )
    place.service.admission.reload()
    ann, bob = await Stream(place, "ann").open(), await Stream(place, "bob").open()
    monkeypatch.setattr(place.service.admission._tokens, "_clock", lambda: 4102444800.0)
    assert await ann.end() is grpc.StatusCode.UNAUTHENTICATED
    assert await bob.goes_on()
    bob.call.cancel()


@pytest.mark.usefixtures("endless_evaluations")
async def test_who_watches_an_evaluation_is_shown_out_as_well(place: Place) -> None:
    form = {"evaluation": '{"evaluation_id": "night", "models": ["linear"]}'}
    async with place.http("ann") as http:
        files = [("files", ("walk.csv", CSV))]
        answer = await http.post("/v1/evaluations", data=form, files=files)
        assert answer.status_code == 201, answer.text
        stub = evaluation_pb2_grpc.EvaluationServiceStub(place.channel)
        asked = epb.WatchEvaluationRequest(evaluation_id="night")
        watch: Any = stub.WatchEvaluation(asked, metadata=metadata("ann"))
        assert (await watch.read()).evaluation.id == "night"
        async with http.stream("GET", "/v1/evaluations/night:watch") as events:
            lines = events.aiter_lines()
            async with asyncio.timeout(30):
                while (await anext(lines)) != "event: evaluation":
                    pass
                place.holders("bob")
                while (await anext(lines)) != "event: problem":
                    pass
                problem = json.loads((await anext(lines)).removeprefix("data: "))
        assert problem["reason"] == "UNAUTHENTICATED"
    async with asyncio.timeout(30):
        with suppress(grpc.aio.AioRpcError):
            while await watch.read() is not grpc.aio.EOF:
                pass
        assert await watch.code() is grpc.StatusCode.UNAUTHENTICATED
    place.holders("ann")
    async with place.http("ann") as http:
        assert (await http.delete("/v1/evaluations/night")).status_code == 204
