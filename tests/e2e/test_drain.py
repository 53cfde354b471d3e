"""The process as an operator runs it: start, work, SIGTERM with work in hand, and bad starts."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from tests.contract.drivers import (
    GrpcDriver,
    HttpDriver,
    RefusalError,
    frame_message,
    grpc_refusal,
    http_refusal,
)
from tests.contract.scenes import walking
from tests.contract.servers import save_small_model
from tests.process import environment

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service.tenancy import Scope
from trajectron_service.tokens import entry, new_token

pytestmark = [pytest.mark.asyncio(loop_scope="session"), pytest.mark.timeout(400)]

# Generous: a machine that is busy otherwise takes its time to import torch.
PATIENCE_S = 180

SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small model with random weights."""
    return save_small_model(tmp_path_factory.mktemp("e2e") / "small")


@dataclass
class Running:
    """A service in a process of its own; ``log`` grows with its lines."""

    process: Process
    log: list[str]
    http_port: int
    grpc_port: int


async def start(*arguments: str, **settings: str) -> Process:
    """``trajectron serve`` with arguments and environment."""
    variables = {f"TRAJECTRON_{name.upper()}": value for name, value in settings.items()}
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "trajectron_service",
        "serve",
        *arguments,
        env=environment() | variables,
        stdout=PIPE,
        stderr=PIPE,
    )


@asynccontextmanager
async def service(model: Path, **settings: str) -> AsyncIterator[Running]:
    """A ready service on free ports; killed at the end if it still runs."""
    process = await start(
        "--model", str(model), "--http-port", "0", "--grpc-port", "0", "--log-format", "json",
        **settings,
    )  # fmt: skip
    assert process.stderr is not None
    log: list[str] = []
    reading: asyncio.Task[None] | None = None
    try:
        async with asyncio.timeout(PATIENCE_S):
            while True:
                line = (await process.stderr.readline()).decode()
                assert line, "".join(log)
                log.append(line)
                if line.startswith("{") and json.loads(line)["event"] == "ready":
                    ready = json.loads(line)
                    break
        reading = asyncio.create_task(_keep(process.stderr, log))
        yield Running(process, log, ready["http_port"], ready["grpc_port"])
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()
        if reading is not None:
            await reading


async def _keep(stream: asyncio.StreamReader, log: list[str]) -> None:
    while line := await stream.readline():
        log.append(line.decode())


async def ended(run: Running) -> int:
    """The process's exit code; its log has no traceback."""
    async with asyncio.timeout(PATIENCE_S):
        code = await run.process.wait()
    assert "Traceback" not in "".join(run.log)
    return code


@asynccontextmanager
async def clients(run: Running) -> AsyncIterator[tuple[httpx.AsyncClient, grpc.aio.Channel]]:
    """A client of each transport."""
    async with (
        httpx.AsyncClient(base_url=f"http://127.0.0.1:{run.http_port}", timeout=PATIENCE_S) as http,
        grpc.aio.insecure_channel(f"127.0.0.1:{run.grpc_port}") as channel,
    ):
        yield http, channel


async def test_sigterm_lets_work_in_hand_finish_and_exits_0(model: Path) -> None:
    heavy = {"frames": walking(agents=5), "num_samples": 2000, "horizon": 20}
    async with service(model, drain_grace_s="50") as run, clients(run) as (http, channel):
        driver = GrpcDriver(channel)
        make_health: Any = health_pb2_grpc.HealthStub
        watch = make_health(channel).Watch(health_pb2.HealthCheckRequest())
        assert (await watch.read()).status == SERVING
        assert (await http.get("/readyz")).status_code == 200
        stream: Any = driver.stub.StreamPredict()
        await stream.write(pb.StreamPredictRequest(open=pb.StreamOpen(session_id="s")))
        assert (await stream.read()).opened.session.id == "s"

        in_hand = asyncio.create_task(http.post("/predict", json=heavy))
        await until(http, "trajectron_work_in_hand 2.0")  # the request and the stream
        # Read before the signal, answered after it: the model is at the heavy request.
        frame = pb.StreamFrame(sequence=1, frame=frame_message(walking(1)[0]))
        await stream.write(pb.StreamPredictRequest(frame=frame))
        await until(http, "trajectron_queue_length 1.0")
        run.process.send_signal(signal.SIGTERM)

        assert (await watch.read()).status == NOT_SERVING
        assert not in_hand.done()
        readiness = await http.get("/readyz")
        assert (readiness.status_code, readiness.json()["status"]) == (503, "draining")
        assert (await http.get("/healthz")).status_code == 200
        for refused in (
            HttpDriver(http).predict(walking()),
            driver.predict(walking()),
            HttpDriver(http).create_session(),
        ):
            with pytest.raises(RefusalError) as caught:
                await refused
            assert caught.value.kind == "DRAINING"
            assert caught.value.retry_after_s is not None

        assert len((await in_hand).json()["agents"]) == 5
        reply = await stream.read()
        assert reply.reply.sequence == 1
        assert reply.reply.result.outcome == pb.FRAME_OUTCOME_ACCEPTED
        with pytest.raises(grpc.aio.AioRpcError) as end:
            await stream.read()
        assert grpc_refusal(end.value).kind == "DRAINING"
        assert await ended(run) == 0


async def until(http: httpx.AsyncClient, sample: str) -> None:
    """Returns once the metrics have this line."""
    async with asyncio.timeout(PATIENCE_S):
        while sample not in (await http.get("/metrics")).text.splitlines():  # noqa: ASYNC110
            await asyncio.sleep(0.01)


async def test_sighup_withdraws_the_tokens_that_are_not_in_the_file_any_more(
    model: Path, tmp_path: Path
) -> None:
    file, token = tmp_path / "tokens.toml", new_token()
    file.write_text(entry(token, "fleet", [Scope.SESSIONS]))
    async with (
        service(model, tokens=str(file), warm_up="0") as run,
        clients(run) as (http, channel),
    ):
        call: Any = GrpcDriver(channel).stub.StreamPredict(
            metadata=[("authorization", f"Bearer {token}")]
        )
        await call.write(pb.StreamPredictRequest(open=pb.StreamOpen()))
        assert (await call.read()).opened.session.id
        file.write_text("")
        run.process.send_signal(signal.SIGHUP)
        async with asyncio.timeout(PATIENCE_S):
            assert await call.code() is grpc.StatusCode.UNAUTHENTICATED
        answer = await http.get("/v1/sessions", headers={"Authorization": f"Bearer {token}"})
        assert answer.status_code == 401
        run.process.send_signal(signal.SIGTERM)
        assert await ended(run) == 0
        assert "nobody may call" in "".join(run.log)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_an_idle_service_stops_at_once_and_exits_0(
    model: Path, number: signal.Signals
) -> None:
    async with service(model, drain_grace_s="1000") as run, clients(run) as (http, channel):
        # Connections that are merely open, and a watch that never ends, keep nothing up.
        assert (await http.get("/healthz")).status_code == 200
        make_health: Any = health_pb2_grpc.HealthStub
        watch = make_health(channel).Watch(health_pb2.HealthCheckRequest())
        assert (await watch.read()).status == SERVING
        run.process.send_signal(number)
        assert await ended(run) == 0


async def test_work_that_outlasts_the_grace_is_cut_off(model: Path) -> None:
    heavy = {"frames": walking(agents=20), "num_samples": 2000, "horizon": 60}
    async with service(model, drain_grace_s="0.2") as run, clients(run) as (http, _):
        in_hand = asyncio.create_task(http.post("/predict", json=heavy))
        await until(http, "trajectron_work_in_hand 1.0")
        run.process.send_signal(signal.SIGTERM)
        refusal = http_refusal(await in_hand)
        assert (refusal.kind, refusal.code) == ("DRAINING", "503")
        # The request alone would take the model far longer than this.
        assert await ended(run) == 0
        assert any("cut off" in line for line in run.log)


@pytest.mark.parametrize("option", ["--http-port", "--grpc-port"])
async def test_a_port_that_is_taken_is_said_in_one_line(model: Path, option: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        ports = {"--http-port": "0", "--grpc-port": "0", option: str(taken.getsockname()[1])}
        flags = [word for pair in ports.items() for word in pair]
        process = await start("--model", str(model), *flags)
        line = await last_words(process)
    assert option.removeprefix("--").replace("-", "_") in line
    assert str(ports[option]) in line


async def test_a_damaged_model_is_said_in_one_line(model: Path, tmp_path: Path) -> None:
    for suffix in (".json", ".safetensors"):
        (tmp_path / f"bad{suffix}").write_bytes(model.with_name(model.name + suffix).read_bytes())
    weights = tmp_path / "bad.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    line = await last_words(await start("--model", str(tmp_path / "bad"), "--http-port", "0"))
    assert "bad.safetensors" in line


async def test_a_missing_model_is_said_in_one_line() -> None:
    line = await last_words(await start("--model", "no-such-model", "--http-port", "0"))
    assert "no-such-model" in line


async def last_words(process: Process) -> str:
    """The one line of a process that could not start."""
    async with asyncio.timeout(PATIENCE_S):
        out, err = await process.communicate()
    assert process.returncode not in (0, None)
    assert not out
    lines = err.decode().splitlines()
    assert len(lines) == 1, lines
    return lines[0]
