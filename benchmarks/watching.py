"""What live accuracy costs: two equal services over one engine, with it and without, in turns.

A simulated crowd is replayed through one session of each of several scenes, a forecast after
every frame, in rounds: one round with, one without, the same frames. What is reported are
ratios: the time that watching says it took over that of inference in the same rounds, and the
whole time of the rounds with over that of those without (median of pairs). Tracing that is
switched off can be compared in the same way: see ``benchmarks/tracing.py``.

    python -m benchmarks.watching [--rounds 6] [--frames 60] [--budget 0.03]
        [--json benchmarks/results/watching.json]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import torch

from trajectron_model import registry
from trajectron_model.simulation import Scenario, simulate
from trajectron_service.application import Application
from trajectron_service.engine import Engine
from trajectron_service.messages import (
    Agent,
    ForecastMode,
    ForecastOptions,
    Frame,
    SessionConfig,
)
from trajectron_service.metrics import Metrics
from trajectron_service.settings import Settings

AGENTS = (5, 20)
SESSIONS = 4
OUTCOMES = ("scored", "unseen", "skipped", "evicted", "failed")


@dataclass(frozen=True)
class Result:
    """One mode and size; shares are of the time of inference in the rounds with watching.

    ``budget`` is what it was told to keep to, ``extra`` the whole time with over without,
    less one; ``scored`` the share of agents' forecasts that were scored.
    """

    mode: str
    agents: int
    budget: float
    share: float
    extra: float
    scored: float


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument(
        "--budget", type=float, default=Settings.model_fields["live_accuracy_budget"].default
    )
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    engine = Engine([registry.load(registry.DEFAULT)])
    engine.warm_up()
    results = [
        asyncio.run(compare(engine, mode, agents, asked.rounds, asked.frames, asked.budget))
        for mode in (ForecastMode.FULL, ForecastMode.GMM)
        for agents in AGENTS
    ]
    print("| mode | agents | budget | time watching / inference | whole time | scored |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for one in results:
        print(
            f"| {one.mode} | {one.agents} | {one.budget:.1%} | {one.share:.2%} "
            f"| {one.extra:+.1%} | {one.scored:.1%} |"
        )
    if asked.json:
        document = {"sessions": SESSIONS, "rows": [asdict(one) for one in results]}
        asked.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


async def compare(
    engine: Engine, mode: ForecastMode, agents: int, rounds: int, frames: int, budget: float
) -> Result:
    """Rounds with watching and without, in turns."""
    options = ForecastOptions(mode, seed=1)
    scenes = [scene(agents, frames, seed) for seed in range(SESSIONS)]
    with_it = service(engine, live_accuracy_budget=budget)
    without = service(engine, live_accuracy=False)
    ratios = []
    for number in range(rounds + 1):
        pair = (with_it, without) if number % 2 else (without, with_it)
        took = {id(app): await replay(app, scenes, options) for app in pair}
        if number:  # the first one warms up
            ratios.append(took[id(with_it)] / took[id(without)])
    counts = {name: value(with_it, "accuracy_agents_total", outcome=name) for name in OUTCOMES}
    result = Result(
        mode=mode.value,
        agents=agents,
        budget=budget,
        share=value(with_it, "accuracy_seconds_total") / value(with_it, "inference_seconds_total"),
        extra=statistics.median(ratios) - 1.0,
        scored=counts["scored"] / sum(counts.values()),
    )
    for app in (with_it, without):
        await app.close()
    return result


def service(engine: Engine, **changes: Any) -> Application:
    """An application over the engine."""
    return Application(Settings(warm_up=False, **changes), engine, Metrics())


def scene(agents: int, frames: int, seed: int) -> list[Frame]:
    """A crowd's frames."""
    return [
        Frame(
            one.time_s,
            tuple(
                Agent(i, t, x, y)
                for i, t, (x, y) in zip(one.ids, one.types, one.positions.tolist(), strict=True)
            ),
        )
        for one in islice(simulate(Scenario.CROSSING, agents, seed=seed), frames)
    ]


async def replay(
    app: Application, scenes: Sequence[Sequence[Frame]], options: ForecastOptions
) -> float:
    """Every scene through a session of its own, all at once; how long it took, in seconds."""
    start = time.perf_counter()

    async def one(number: int, frames: Sequence[Frame]) -> None:
        await app.create_session(str(number), SessionConfig())
        for frame in frames:
            await app.observe(str(number), (frame,), None)
            await app.predict_session(str(number), options, None)
        await app.delete_session(str(number))

    await asyncio.gather(*(one(number, frames) for number, frames in enumerate(scenes)))
    return time.perf_counter() - start


def value(app: Application, name: str, **labels: str) -> float:
    """A sample of the application's registry."""
    return app.metrics.registry.get_sample_value(f"trajectron_{name}", labels) or 0.0


if __name__ == "__main__":
    main()
