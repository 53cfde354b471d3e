"""What the service adds to its model: streams, calls, replies, memory, start.

One service in its own process on the same cores as the clients. Every latency stands beside a
floor of the same run: the engine's own time for the same work without a service around it, and
a bare gRPC server that does nothing but wait as long.

    python -m benchmarks.service [--seconds 10] [--sessions 10000]
        [--json benchmarks/results/service.json]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import torch

from benchmarks.evaluation_load import service as running_service
from benchmarks.processes import child, resident_bytes
from benchmarks.replica import free_port
from trajectron_client import AsyncClient, AsyncHttpClient, ForecastOptions, Frame
from trajectron_model import registry
from trajectron_service import grpc_convert
from trajectron_service.commands.loading import LoadPlan, send_over_grpc
from trajectron_service.engine import Engine
from trajectron_service.messages import AgentForecast, Forecast, ForecastMode, Sampling
from trajectron_service.scenes import ForecastTask, SceneJob
from trajectron_service.timebase import Grid, Observation, Timeline, advance, head

_ECHO = """
import asyncio, sys, grpc
wait_s = float(sys.argv[2])
async def answer(requests, context):
    async for request in requests:
        await asyncio.sleep(wait_s)
        yield request
async def main():
    server = grpc.aio.server()
    handler = grpc.stream_stream_rpc_method_handler(answer)
    server.add_generic_rpc_handlers(
        (grpc.method_handlers_generic_handler("echo", {"Stream": handler}),))
    server.add_insecure_port("127.0.0.1:" + sys.argv[1])
    await server.start()
    await server.wait_for_termination()
asyncio.run(main())
"""


def main() -> None:
    """Measures, prints a table, and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each phase")
    parser.add_argument("--sessions", type=int, default=10_000, help="open at once, for memory")
    parser.add_argument("--model", default="eth_ucy", help="served: a name or a path")
    parser.add_argument("--json", type=Path, help="where the figures go")
    arguments = parser.parse_args()
    arguments.priority = "idle"
    os.environ["TRAJECTRON_STORE"] = "memory"
    os.environ["TRAJECTRON_LOG_LEVEL"] = "info"
    os.environ["TRAJECTRON_MAX_SESSIONS"] = str(arguments.sessions + 1000)
    with tempfile.TemporaryDirectory() as folder:
        began = time.monotonic()
        with running_service(arguments, Path(folder)) as (http_port, grpc_port):
            start_s = time.monotonic() - began
            figures = asyncio.run(_measure(arguments, http_port, grpc_port))
    figures["start_s"] = start_s
    figures["about"] = {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
    }
    print(table(figures))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


async def _measure(arguments: argparse.Namespace, http_port: int, grpc_port: int) -> dict[str, Any]:
    pid = child()
    seconds = arguments.seconds
    idle_mb = resident_bytes(pid) / 2**20
    async with (
        AsyncHttpClient(f"http://127.0.0.1:{http_port}", timeout_s=60.0) as http,
        AsyncClient(f"127.0.0.1:{grpc_port}", timeout_s=60.0) as client,
    ):
        stream = await _one_stream(client, arguments.model, seconds)
        predict = await _predict(http, seconds)
        reply = _large_reply()
        streams = [
            {"offered_per_s": offered, **await _many_streams(client, offered, seconds)}
            for offered in (64, 128, 192, 256, 300)
        ]
        memory = await _memory(client, pid, arguments.sessions)
    return {
        "one_stream_gmm_10_agents": stream,
        "predict_10_agents_20_samples": predict,
        "reply_200_samples_40_agents": reply,
        "streams_64_of_8_agents_gmm": streams,
        "memory": {"idle_mb": idle_mb, **memory},
    }


def _crowd(agents: int, time_s: float) -> Frame:
    """People who walk in lanes, each beside two others."""
    ids = [f"a{i}" for i in range(agents)]
    lanes = np.arange(agents)
    places = np.stack([1.2 * time_s + 0.3 * (lanes % 3), 1.1 * lanes], axis=1)
    return Frame.from_arrays(time_s, ids, places.tolist())


async def _one_stream(client: AsyncClient, model: str, seconds: float) -> dict[str, float]:
    """A frame is sent when the one before is answered."""
    engine_s = await asyncio.to_thread(_engine_s, model)
    bare = await _bare_stream(statistics.median(engine_s), seconds / 2)
    ours = await _closed_loop(client, seconds)
    return {
        "engine_ms": 1e3 * statistics.median(engine_s),
        "stream_ms": 1e3 * statistics.median(ours),
        "stream_p99_ms": 1e3 * float(np.percentile(ours, 99)),
        "bare_grpc_ms": 1e3 * statistics.median(bare),
        "above_engine_ms": 1e3 * (statistics.median(ours) - statistics.median(engine_s)),
        "above_bare_grpc_ms": 1e3 * (statistics.median(ours) - statistics.median(bare)),
        "p99_over_median": float(np.percentile(ours, 99)) / statistics.median(ours),
    }


async def _closed_loop(client: AsyncClient, seconds: float) -> list[float]:
    turn = asyncio.Semaphore(1)
    sent: list[float] = []
    until = time.perf_counter() + seconds

    async def frames() -> AsyncIterator[Frame]:
        step = 0
        while time.perf_counter() < until:
            await turn.acquire()
            frame = _crowd(10, 0.4 * step)
            sent.append(time.perf_counter())
            yield frame
            step += 1

    latencies = []
    async with client.stream(frames(), close_session_at_end=True, mode="gmm") as replies:
        async for reply in replies:
            assert reply.forecast is not None
            latencies.append(time.perf_counter() - sent[-1])
            turn.release()
    return latencies[20:] or latencies


async def _bare_stream(wait_s: float, seconds: float) -> list[float]:
    """A stream through a server that only waits."""
    port = free_port()
    command = (sys.executable, "-c", _ECHO, str(port), str(wait_s))
    process = await asyncio.create_subprocess_exec(*command)
    try:
        async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
            await asyncio.wait_for(channel.channel_ready(), 30.0)
            call: Any = channel.stream_stream("/echo/Stream")()
            latencies = []
            until = time.perf_counter() + seconds
            while time.perf_counter() < until:
                sent = time.perf_counter()
                await call.write(bytes(1000))
                await call.read()
                latencies.append(time.perf_counter() - sent)
            call.cancel()
    finally:
        process.kill()
        await process.wait()
    return latencies


def _engine_s(model: str) -> list[float]:
    """Seconds of the engine alone for a frame of 10 agents and its `gmm` forecast."""
    torch.set_num_threads(1)
    loaded = registry.load(model)
    engine = Engine([loaded])
    facts = engine.models[loaded.name].info
    timeline = Timeline(Grid.of(facts.dt_s, None, 2.0))
    states: Any = ()
    seconds = []
    for step in range(150):
        time_s = facts.dt_s * step
        frame = _crowd(10, time_s)
        places = np.array([[agent.x, agent.y] for agent in frame.agents])
        ids = tuple(agent.id for agent in frame.agents)
        before = tuple(state.serial for state in timeline.committed)
        taken = advance(timeline, Observation(time_s, ids, ("pedestrian",) * 10, places))
        timeline = taken.timeline
        keep = tuple(state.serial for state in timeline.committed)
        task = ForecastTask(
            head(timeline), ForecastMode.GMM, 20, 12, 1, step, None, True, Sampling.IID
        )
        job = SceneJob(loaded.name, before, states, taken.steps, keep, (task,))
        begun = time.perf_counter()
        states = engine.run([job])[0].states
        seconds.append(time.perf_counter() - begun)
    return seconds[20:]


async def _predict(http: AsyncHttpClient, seconds: float) -> dict[str, float]:
    """Four callers, each asks again as soon as it is answered."""
    frames = [_crowd(10, 0.4 * step) for step in range(8)]
    latencies: list[float] = []
    until = time.perf_counter() + seconds

    async def caller() -> None:
        while time.perf_counter() < until:
            sent = time.perf_counter()
            await http.predict(frames, num_samples=20, horizon=12, seed=1)
            latencies.append(time.perf_counter() - sent)

    begun = time.perf_counter()
    await asyncio.gather(*(caller() for _ in range(4)))
    return {
        "per_s": len(latencies) / (time.perf_counter() - begun),
        "median_ms": 1e3 * statistics.median(latencies),
        "p99_ms": 1e3 * float(np.percentile(latencies, 99)),
    }


def _large_reply() -> dict[str, float]:
    """Turning a forecast of 200 samples of 40 agents into a message's bytes, in this process."""
    random = np.random.default_rng(0)
    agents = tuple(
        AgentForecast(
            id=f"a{i}",
            type="pedestrian",
            x=0.0,
            y=0.0,
            last_observed_time=0.0,
            observations=8,
            heading_known=True,
            mode_probabilities=np.full(25, 0.04, dtype=np.float32),
            mean=None,
            covariance=None,
            samples=random.normal(size=(200, 12, 2)).astype(np.float32),
            sample_modes=random.integers(0, 25, 200),
        )
        for i in range(40)
    )
    forecast = Forecast(
        model="eth_ucy",
        model_hash="0" * 64,
        mode=ForecastMode.FULL,
        seed=1,
        reference_time=0.0,
        time_offsets_s=tuple(0.4 * (h + 1) for h in range(12)),
        agents=agents,
        sampling=Sampling.IID,
    )

    def serialise() -> bytes:
        return grpc_convert.forecast_message(forecast).SerializeToString()

    return {"ms": 1e3 * _median_s(serialise, 100), "bytes": len(serialise())}


def _median_s(call: Callable[[], Any], times: int) -> float:
    seconds = []
    for _ in range(times):
        begun = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begun)
    return statistics.median(seconds)


async def _many_streams(client: AsyncClient, offered: float, seconds: float) -> dict[str, Any]:
    plan = LoadPlan(
        sessions=64,
        agents=8,
        rate_hz=offered / 64,
        seconds=seconds,
        ramp_s=64 / offered,
        deadline_s=0.1,
        forecast=ForecastOptions(mode="gmm"),
    )
    return (await send_over_grpc(client, plan)).to_json()


async def _memory(client: AsyncClient, pid: int, sessions: int) -> dict[str, float]:
    """Bytes that sessions of one agent and of five add, all open, each answering."""
    before = resident_bytes(pid)
    gate = asyncio.Semaphore(32)

    async def open_one(number: int, agents: int) -> None:
        async with gate:
            name = f"m{agents}-{number}"
            await client.create_session(name)
            for step in range(2):
                await client.observe(name, _crowd(agents, 0.4 * step))

    async def ask(number: int) -> None:
        async with gate:
            await client.predict_session(f"m1-{number}", mode="full", num_samples=1, horizon=1)

    await asyncio.gather(*(open_one(number, 1) for number in range(sessions)))
    ones = resident_bytes(pid)
    await asyncio.gather(*(ask(number) for number in range(sessions)))
    answered = resident_bytes(pid)
    crowds = max(1, sessions // 20)
    await asyncio.gather(*(open_one(number, 40) for number in range(crowds)))
    crowded = resident_bytes(pid)
    per_session = (ones - before) / sessions
    return {
        "sessions": sessions,
        "resident_mb": answered / 2**20,
        "bytes_per_session_of_one_agent": per_session,
        "bytes_per_agent": ((crowded - answered) / crowds - per_session) / 39,
    }


def table(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    one = figures["one_stream_gmm_10_agents"]
    predict = figures["predict_10_agents_20_samples"]
    memory = figures["memory"]
    alone = f"engine alone {one['engine_ms']:.1f}, bare gRPC that waits {one['bare_grpc_ms']:.1f}"
    rows = {
        "one stream, `gmm`, 10 agents": f"{one['stream_ms']:.1f} ms; {alone}; p99 "
        f"{one['p99_over_median']:.2f} times the median",
        "`POST /predict`, 10 agents, 20 samples": f"{predict['per_s']:.0f} a second, p99 "
        f"{predict['p99_ms']:.0f} ms",
        "200 samples of 40 agents as a message": (
            f"{figures['reply_200_samples_40_agents']['ms']:.2f} ms"
        ),
    }
    for row in figures["streams_64_of_8_agents_gmm"]:
        p99 = row["latency_ms"].get("p99", float("nan"))
        rows[f"64 streams of 8 agents, {row['offered_per_s']} frames a second offered"] = (
            f"{row['forecasts_per_s']:.0f} answered, p99 {p99:.0f} ms, {row['lost']} lost"
        )
    rows |= {
        "resident, one model, idle": f"{memory['idle_mb']:.0f} MB",
        f"resident, {memory['sessions']} sessions open, each answered": (
            f"{memory['resident_mb']:.0f} MB"
        ),
        "a session of one agent": f"{memory['bytes_per_session_of_one_agent'] / 1e3:.1f} kB",
        "an agent more": f"{memory['bytes_per_agent'] / 1e3:.1f} kB",
        "from start to ready": f"{figures['start_s']:.1f} s",
    }
    lines = [f"| {what} | {measured} |" for what, measured in rows.items()]
    return "\n".join(["| what | measured |", "| --- | --- |", *lines])


if __name__ == "__main__":
    main()
