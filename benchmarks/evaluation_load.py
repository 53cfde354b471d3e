"""What a batch evaluation beside them costs the forecasts of a service: ratios of latencies.

One service, one run: phases with an evaluation and phases without it take turns, while a client
asks `POST /predict` at a steady rate and streams frames over gRPC. A latency counts from when
the request was due, so that a service which falls behind is not spared. Evaluations are created
at the beginning of a phase (the start of their process is part of what they cost) and cancelled
at its end. What is reported are ratios, with an evaluation over without; absolute times are for
the machine at hand, and mean nothing while other work keeps it busy.

    python benchmarks/evaluation_load.py [--rounds 5] [--seconds 30] [--priority idle]
        [--json benchmarks/results/evaluation-load.json]
"""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from trajectron_client import (
    AsyncClient,
    AsyncHttpClient,
    Evaluation,
    EvaluationState,
    Frame,
    RecordingFile,
)
from trajectron_model.simulation import Scenario, simulate

DT_S = 0.4
AGENTS = 10
SAMPLES = 20
FRAME_INTERVAL_S = 0.1
PREDICT_INTERVAL_S = 0.1
START_S = 600.0
# The work of an evaluation that outlasts every phase.
CROWD, CROWD_STEPS, EVALUATION_SAMPLES = 30, 600, 200


@dataclass
class Latencies:
    """Seconds, by what was asked: ``predict``, ``stream``."""

    of: dict[str, list[float]] = field(default_factory=lambda: {"predict": [], "stream": []})


def main() -> None:
    """Measures, prints a table, and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=5, help="pairs of phases")
    parser.add_argument("--seconds", type=float, default=30.0, help="of a phase")
    parser.add_argument("--priority", choices=["idle", "low", "normal"], default="idle")
    parser.add_argument("--model", default="eth_ucy", help="served and judged: a name or a path")
    parser.add_argument("--json", type=Path, help="where the figures go")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, service(arguments, Path(folder)) as ports:
        figures = asyncio.run(measure(arguments, *ports))
    print(table(figures))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


@contextmanager
def service(arguments: argparse.Namespace, folder: Path) -> Iterator[tuple[int, int]]:
    """A service in a process of its own; gives its HTTP and gRPC ports."""
    log = folder / "serve.log"
    command = ["serve", "--model", arguments.model, "--http-port", "0", "--grpc-port", "0"]
    settings = {
        "TRAJECTRON_STATE_DIR": str(folder / "state"),
        "TRAJECTRON_EVALUATION_PRIORITY": arguments.priority,
    }
    with log.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "trajectron_service", *command, "--log-format", "json"],
            env=os.environ | settings,
            stderr=file,
        )
    try:
        yield wait_until_ready(process, log)
    finally:
        process.terminate()
        process.wait()


def wait_until_ready(process: subprocess.Popen[bytes], log: Path) -> tuple[int, int]:
    """The ports in the line that says that the service is ready."""
    deadline = time.monotonic() + START_S
    while process.poll() is None and time.monotonic() < deadline:
        for line in log.read_text().splitlines():
            fields = json.loads(line) if line.startswith("{") else {}
            if fields.get("event") == "ready":
                return fields["http_port"], fields["grpc_port"]
        time.sleep(0.1)
    raise SystemExit(f"the service did not become ready:\n{log.read_text()}")


async def measure(arguments: argparse.Namespace, http_port: int, grpc_port: int) -> dict[str, Any]:
    """All phases, the two kinds in turn."""
    without, beside = Latencies(), Latencies()
    judged = 0
    async with (
        AsyncHttpClient(f"http://127.0.0.1:{http_port}", timeout_s=60.0) as http,
        AsyncClient(f"127.0.0.1:{grpc_port}", timeout_s=60.0) as grpc,
    ):
        model = (await http.list_models())[0].name
        await load(http, grpc, min(5.0, arguments.seconds), Latencies())  # warms up
        for turn in range(arguments.rounds):
            print(f"round {turn + 1} of {arguments.rounds}", file=sys.stderr)
            # Whatever drifts (clocks, caches) is met by both kinds first as often.
            for judging in (False, True) if turn % 2 == 0 else (True, False):
                if not judging:
                    await load(http, grpc, arguments.seconds, without)
                    continue
                evaluation = await http.create_evaluation(
                    [model], files=[crowd()], num_samples=EVALUATION_SAMPLES, in_sample=True
                )
                await load(http, grpc, arguments.seconds, beside)
                judged += still_running(await http.cancel_evaluation(evaluation.id))
                await http.delete_evaluation(evaluation.id)
    if not judged:
        raise SystemExit("no evaluation came to its first windows: take longer phases")
    return {
        "machine": {"cpus": os.cpu_count(), "python": platform.python_version()},
        "priority": arguments.priority,
        "rounds": arguments.rounds,
        "seconds": arguments.seconds,
        "agents": AGENTS,
        "samples": SAMPLES,
        "windows_judged": judged,
        "latency": {name: compared(without.of[name], beside.of[name]) for name in without.of},
    }


def still_running(evaluation: Evaluation) -> int:
    """The windows that an evaluation has judged; it must have lasted for all of its phase."""
    if evaluation.state is not EvaluationState.CANCELLED:
        raise SystemExit(f"the evaluation {evaluation.state} too early: {evaluation.error}")
    return evaluation.progress.windows_done


async def load(http: AsyncHttpClient, grpc: AsyncClient, seconds: float, into: Latencies) -> None:
    """Both kinds of clients at once, for so long."""
    await asyncio.gather(
        predict(http, seconds, into.of["predict"]), stream(grpc, seconds, into.of["stream"])
    )


async def predict(client: AsyncHttpClient, seconds: float, latencies: list[float]) -> None:
    """Stateless forecasts of 8 frames, one after the other as they fall due."""
    history = frames(8, DT_S)
    start = time.perf_counter()
    for number in range(int(seconds / PREDICT_INTERVAL_S)):
        due = start + number * PREDICT_INTERVAL_S
        await asyncio.sleep(max(0.0, due - time.perf_counter()))
        await client.predict(history, num_samples=SAMPLES, seed=number)
        latencies.append(time.perf_counter() - due)


async def stream(client: AsyncClient, seconds: float, latencies: list[float]) -> None:
    """A scene at ten frames a second, each with its forecast."""
    sent: list[float] = []

    async def coming() -> AsyncIterator[Frame]:
        start = time.perf_counter()
        for number, frame in enumerate(frames(int(seconds / FRAME_INTERVAL_S), FRAME_INTERVAL_S)):
            due = start + number * FRAME_INTERVAL_S
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            sent.append(due)
            yield frame

    replies = client.stream(
        coming(),
        config={"frame_interval_s": FRAME_INTERVAL_S},
        close_session_at_end=True,
        num_samples=SAMPLES,
        seed=1,
    )
    async with replies:
        number = 0
        async for reply in replies:
            assert reply.forecast is not None, reply.error
            latencies.append(time.perf_counter() - sent[number])
            number += 1


def frames(count: int, interval_s: float) -> list[Frame]:
    """People who walk straight on, side by side."""
    ids = [str(number) for number in range(AGENTS)]
    first = np.stack([np.zeros(AGENTS), np.arange(AGENTS) * 1.2], axis=1)  # [A, 2]
    return [
        Frame.from_arrays(interval_s * n, ids, first + np.array([1.2 * interval_s * n, 0.0]))
        for n in range(count)
    ]


def crowd() -> RecordingFile:
    """A simulated recording that takes an evaluation longer than any phase."""
    text = io.StringIO()
    text.write("time,id,type,x,y\n")
    walk = simulate(Scenario("crossing"), CROWD, seed=1, dt_s=DT_S)
    for step, frame in enumerate(islice(walk, CROWD_STEPS)):
        for name, kind, (x, y) in zip(frame.ids, frame.types, frame.positions, strict=True):
            text.write(f"{DT_S * step:.1f},{name},{kind},{x:.4f},{y:.4f}\n")
    return RecordingFile("crowd.csv", text.getvalue().encode())


def compared(without: Sequence[float], beside: Sequence[float]) -> dict[str, Any]:
    """Medians and tails, milliseconds, and their ratios."""
    found: dict[str, Any] = {"requests": [len(without), len(beside)]}
    for name, share in (("p50", 50), ("p99", 99)):
        alone, together = percentile(without, share), percentile(beside, share)
        found[name] = {
            "without_ms": round(1e3 * alone, 2),
            "beside_ms": round(1e3 * together, 2),
            "ratio": round(together / alone, 3),
        }
    return found


def percentile(values: Sequence[float], share: int) -> float:
    """The value that this percentage stays below."""
    return statistics.quantiles(values, n=100, method="inclusive")[share - 1]


def table(figures: dict[str, Any]) -> str:
    """The ratios as Markdown."""
    lines = [
        f"{figures['windows_judged']} windows judged, at priority {figures['priority']}.",
        "",
        "| | requests | p50 without, ms | beside | ratio | p99 without, ms | beside | ratio |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, of in figures["latency"].items():
        cells = [name, str(sum(of["requests"]))]
        for tail in ("p50", "p99"):
            cells += [str(of[tail][key]) for key in ("without_ms", "beside_ms", "ratio")]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
