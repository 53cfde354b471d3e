"""What tracing costs: hooks that do nothing beside the cheapest call, and on beside off, in turns.

``hooks`` times everything that a call passes when tracing is off, over the time of the cheapest
call that uses the model (one frame of one agent into a session, without any transport). ``on``
is the time of such calls with every span recorded (and thrown away) over that with tracing off.

    python -m benchmarks.tracing [--rounds 7] [--calls 300]
        [--json benchmarks/results/tracing.json]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import time
from pathlib import Path

import torch
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor, SpanExporter, SpanExportResult

from trajectron_model import registry
from trajectron_service.application import Application
from trajectron_service.engine import Engine
from trajectron_service.messages import Agent, Frame, SessionConfig
from trajectron_service.metrics import Metrics
from trajectron_service.settings import Settings
from trajectron_service.telemetry import Telemetry
from trajectron_service.tracing import OFF, Tracing

STAGES = ("decode", "store", "serialise")


class _Nowhere(SpanExporter):
    """Takes spans and forgets them."""

    def export(self, spans: object) -> SpanExportResult:
        """See the base class."""
        return SpanExportResult.SUCCESS


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--calls", type=int, default=300)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    off_s, ratio, hooks_s = asyncio.run(measure(asked.rounds, asked.calls))
    figures = {"hooks_over_call": hooks_s / off_s, "on_over_off": ratio}
    print("| what | ratio |")
    print("| --- | ---: |")
    print(f"| hooks of tracing that is off, over the cheapest call | {hooks_s / off_s:.4f} |")
    print(f"| the cheapest call, tracing on over off | {ratio:.3f} |")
    if asked.json:
        asked.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


async def measure(rounds: int, calls: int) -> tuple[float, float, float]:
    """Seconds of a call without tracing, the ratio of one with it, seconds of idle hooks."""
    provider = TracerProvider(shutdown_on_exit=False)
    provider.add_span_processor(SimpleSpanProcessor(_Nowhere()))
    engine = Engine([registry.load(registry.DEFAULT)])
    apps = {
        name: Application(Settings(warm_up=False, live_accuracy=False), engine, Metrics(tracing))
        for name, tracing in (("off", OFF), ("on", Telemetry(provider)))
    }
    took: dict[str, list[float]] = {"off": [], "on": []}
    for number in range(rounds + 1):
        order = ("off", "on") if number % 2 else ("on", "off")
        for name in order:
            seconds = await observe(apps[name], f"s{number}", calls)
            if number:  # the first round warms up
                took[name].append(seconds / calls)
    ratio = statistics.median(on / off for on, off in zip(took["on"], took["off"], strict=True))
    hooks_s = min(hooks(OFF, calls * 10) for _ in range(rounds))
    for app in apps.values():
        await app.close()
    return min(took["off"]), ratio, hooks_s


async def observe(app: Application, session: str, calls: int) -> float:
    """Frames of one agent, one call each, each in a task of its own as servers have it."""
    await app.create_session(session, SessionConfig())
    tracing = app.metrics.tracing

    async def one(step: int) -> None:
        call = tracing.call("http", "POST", {})
        frame = Frame(0.4 * step, (Agent("a", "pedestrian", 0.4 * step, 0.0),))
        await app.observe(session, (frame,), None)
        call.end("POST /v1/sessions/{session_id}:observe", "200", failed=False)

    start = time.perf_counter()
    for step in range(calls):
        await asyncio.create_task(one(step))
    return time.perf_counter() - start


def hooks(tracing: Tracing, calls: int) -> float:
    """Seconds that one call's hooks take."""
    start = time.perf_counter()
    for _ in range(calls):
        call = tracing.call("http", "POST", {})
        for stage in STAGES:
            with tracing.stage(stage):
                pass
        with tracing.batch([tracing.ticket()]):
            tracing.staged("encode", 0.0)
            tracing.staged("sample", 0.0)
        call.end("POST", "200", failed=False)
    return (time.perf_counter() - start) / calls


if __name__ == "__main__":
    main()
