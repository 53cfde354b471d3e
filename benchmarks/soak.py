"""A long run: sessions come and go, faults now and then; what grows, and what is lost.

The service keeps its sessions in SQLite. Rounds of streams, between them clients that vanish,
slow readers, nonsense, deadlines that nobody can meet, and sessions left to expire; one session
lives through all of it. After each round everything of the round is closed: then memory,
descriptors and threads are those at rest.

    python -m benchmarks.soak [--minutes 30] [--json benchmarks/results/soak.json]
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import httpx

from benchmarks.evaluation_load import service as running_service
from benchmarks.processes import child, resident_bytes
from trajectron_client import (
    AsyncClient,
    ForecastOptions,
    Frame,
    SessionOptions,
    TrajectronError,
)
from trajectron_service.commands.loading import LoadPlan, send_over_grpc

LIVES_THROUGH = "lives-through-it"
_REST_S = 1.5
# Memory may grow by this share after the beginning, which is a sixth of the run.
_MOST_GROWTH = 0.02
_SHORT_MINUTES = 10.0
_MOST_GROWTH_SHORT = 0.05


class Sample(NamedTuple):
    """The process at rest."""

    at_s: float
    resident_bytes: int
    descriptors: int
    threads: int


@dataclass
class Soak:
    """What has happened so far."""

    sent: int = 0
    forecasts: int = 0
    refusals: Counter[str] = field(default_factory=Counter)
    broken: Counter[str] = field(default_factory=Counter)
    lost: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    sessions: int = 0
    acknowledged: int = 0
    samples: list[Sample] = field(default_factory=list)


def main() -> None:
    """Runs, prints the verdict, writes the figures; exits 1 when it did not pass."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--round-seconds", type=float, default=8.0)
    parser.add_argument("--model", default="eth_ucy", help="served: a name or a path")
    parser.add_argument("--json", type=Path, help="where the figures go")
    arguments = parser.parse_args()
    arguments.priority = "idle"
    with (
        tempfile.TemporaryDirectory() as folder,
        running_service(arguments, Path(folder)) as (http_port, grpc_port),
    ):
        figures = asyncio.run(_run(arguments, http_port, grpc_port))
    print(json.dumps({k: v for k, v in figures.items() if k != "samples"}, indent=1))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures) + "\n", encoding="utf-8")
    sys.exit(0 if figures["passed"] else 1)


async def _run(arguments: argparse.Namespace, http_port: int, grpc_port: int) -> dict[str, Any]:
    pid, soak = child(), Soak()
    http, target = f"http://127.0.0.1:{http_port}", f"127.0.0.1:{grpc_port}"
    began = time.monotonic()
    until = began + 60.0 * arguments.minutes
    async with AsyncClient(target, timeout_s=30.0) as client:
        await client.create_session(LIVES_THROUGH)
    for number in itertools.count():
        faults = list(_FAULTS)
        fault = faults[number % len(faults)]
        async with AsyncClient(target, timeout_s=30.0) as client:
            await asyncio.gather(
                _streams(client, soak, arguments.round_seconds, number),
                _outlive(client, soak),
                _FAULTS[fault](client, http),
            )
        soak.faults[fault] += 1
        await asyncio.sleep(_REST_S)
        soak.samples.append(_sample(pid, time.monotonic() - began))
        if time.monotonic() >= until:
            break
    async with AsyncClient(target, timeout_s=30.0) as client:
        version = (await client.get_session(LIVES_THROUGH)).info.version
    return _verdict(soak, version, arguments.minutes)


def _sample(pid: int, at_s: float) -> Sample:
    process = Path(f"/proc/{pid}")
    return Sample(
        at_s,
        resident_bytes(pid),
        len(os.listdir(process / "fd")),  # noqa: PTH208 - entries of /proc may vanish
        len(os.listdir(process / "task")),  # noqa: PTH208
    )


async def _streams(client: AsyncClient, soak: Soak, seconds: float, seed: int) -> None:
    """Two loads at once: analytic forecasts, and samples."""
    for forecast in (
        ForecastOptions(mode="gmm", horizon=6),
        ForecastOptions(mode="full", num_samples=20, horizon=6),
    ):
        plan = LoadPlan(3, 4, 2.5, seconds / 2, 0.4, 5.0, forecast, seed=seed)
        report = await send_over_grpc(client, plan)
        soak.sent += report.sent
        soak.forecasts += report.forecasts
        soak.lost += report.lost
        soak.refusals.update(report.refusals)
        soak.broken.update(report.broken)
        soak.sessions += plan.sessions


async def _outlive(client: AsyncClient, soak: Soak) -> None:
    """Frames of the session that lives through all; acknowledged ones are counted."""
    for _ in range(5):
        await client.observe(LIVES_THROUGH, _frame(0.4 * soak.acknowledged))
        soak.acknowledged += 1


def _frame(time_s: float) -> Frame:
    # Somebody who walks in a circle, and somebody who comes now and then.
    places = [(3.0, 0.1 * (time_s % 7.0)), (4.0, 1.0)]
    present = 2 if time_s % 6.0 < 3.0 else 1
    return Frame.from_arrays(time_s, ["ann", "bob"][:present], places[:present])


async def _vanish(client: AsyncClient, _http: str) -> None:
    """A client that is gone in the middle of its stream, and leaves its session behind."""

    async def frames() -> AsyncIterator[Frame]:
        for step in range(1000):
            yield _frame(0.4 * step)
            await asyncio.sleep(0.01)

    config = SessionOptions(idle_timeout_s=10.0)
    async with client.stream(frames(), config=config, mode="gmm", horizon=4) as replies:
        for _ in range(5):
            await anext(replies)


async def _read_slowly(client: AsyncClient, _http: str) -> None:
    frames = [_frame(0.4 * step) for step in range(40)]
    stream = client.stream(
        frames, delivery="latest", close_session_at_end=True, mode="full", num_samples=50
    )
    async with stream as replies:
        async for _ in replies:
            await asyncio.sleep(0.05)


async def _talk_nonsense(_client: AsyncClient, http: str) -> None:
    async with httpx.AsyncClient(base_url=http) as caller:
        for body in (b"{", b"[]", b'{"frames": 7}', b'{"frames": [{"time": NaN}]}', b"\xff" * 999):
            await caller.post("/predict", content=body)
        await caller.get("/v1/sessions/" + "x" * 500)
        await caller.delete("/v1/sessions/nobody")
    host, port = http.removeprefix("http://").split(":")
    _, writer = await asyncio.open_connection(host, int(port))
    writer.write(b"\x00\x01 nonsense\r\n\r\n")
    await writer.drain()
    writer.close()


async def _ask_too_late(client: AsyncClient, _http: str) -> None:
    frames = [_frame(0.4 * step) for step in range(4)]
    for _ in range(10):
        try:
            await client.predict(frames, num_samples=2000, horizon=60, timeout_s=0.002)
        except TrajectronError:
            continue


async def _abandon(client: AsyncClient, _http: str) -> None:
    """Sessions that nobody comes back to: they expire."""
    for _ in range(5):
        session = await client.create_session(idle_timeout_s=2.0)
        await client.observe(session.id, _frame(0.0))


_FAULTS: dict[str, Callable[[AsyncClient, str], Awaitable[None]]] = {
    "a client vanishes mid-stream": _vanish,
    "a slow reader": _read_slowly,
    "nonsense": _talk_nonsense,
    "deadlines that nobody can meet": _ask_too_late,
    "sessions left to expire": _abandon,
}


def _verdict(soak: Soak, version: int, minutes: float) -> dict[str, Any]:
    begin_s = 60.0 * minutes / 6.0
    settled = [sample for sample in soak.samples if sample.at_s >= begin_s] or soak.samples
    span = max(1, len(settled) // 5)
    first, last = settled[:span], settled[-span:]

    def typical(samples: list[Sample], name: str) -> float:
        return float(statistics.median(getattr(sample, name) for sample in samples))

    growth = typical(last, "resident_bytes") / typical(first, "resident_bytes") - 1.0
    descriptors = typical(last, "descriptors") - typical(first, "descriptors")
    threads = typical(last, "threads") - typical(first, "threads")
    most = _MOST_GROWTH if minutes >= _SHORT_MINUTES else _MOST_GROWTH_SHORT
    criteria = {
        "memory": growth < most,
        "descriptors": descriptors <= 0,
        "threads": threads <= 0,
        "no frame lost": soak.lost == 0 and not soak.broken and version == soak.acknowledged,
    }
    return {
        "minutes": minutes,
        "rounds": len(soak.samples),
        "sessions": soak.sessions,
        "frames": soak.sent,
        "forecasts": soak.forecasts,
        "refusals": dict(soak.refusals),
        "broken_sessions": dict(soak.broken),
        "lost": soak.lost,
        "acknowledged_by_the_session_that_lived": soak.acknowledged,
        "its_version": version,
        "faults": dict(soak.faults),
        "memory_growth": growth,
        "descriptors_more": descriptors,
        "threads_more": threads,
        "criteria": criteria,
        "passed": all(criteria.values()),
        "samples": [[round(s.at_s, 1), *s[1:]] for s in soak.samples],
    }


if __name__ == "__main__":
    main()
