"""Times the online step beside torch's and beside bare products, and weighs what a scene takes.

Each figure stands beside its rivals of the same run, in turn: `Trajectron.step`, which the
kernel replaces; the products of the encoders' cells, by torch; for many scenes, a call for each.
Edges have no call of their own: a step of a model whose encoders have one unit is what they and
the features cost at most.

    python -m benchmarks.step [--threads 2] [--repeats 25] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks.model import MANY_SCENES, SMALL_SCENE, bare_step, scene
from benchmarks.runtime import processor
from trajectron_model import kernels, online, registry
from trajectron_model.config import ModelConfig
from trajectron_model.packed import Layout
from trajectron_model.trajectron import Trajectron

AGENTS = (1, 10, 40, 200, 1000, 2000)
CROWDS = (250, 500, 1000, 2000)

Call = Callable[[], object]


@dataclass(frozen=True)
class Row:
    """Milliseconds, the medians of a run and its spread; how often the rival takes, pair by pair.

    Attributes:
        what: is timed, in words.
        agents: in all scenes together.
        edges: directed, in all scenes together.
        times: of the rival named over ours.
    """

    what: str
    agents: int
    edges: int
    ours_ms: float
    ours_low_ms: float
    ours_high_ms: float
    times: dict[str, float]


def measure(what: str, size: tuple[int, int], ours: Call, rivals: dict[str, Call], n: int) -> Row:
    """One row: ours and its rivals in turn, after a warm-up."""
    calls = [ours, *rivals.values()]
    for call in calls:
        call()
    taken: list[list[float]] = [[] for _ in calls]
    for _ in range(n):
        for call, kept in zip(calls, taken, strict=True):
            begun = time.perf_counter()
            call()
            kept.append(1e3 * (time.perf_counter() - begun))
    mine = taken[0]
    times = {
        name: statistics.median(theirs / own for own, theirs in zip(mine, other, strict=True))
        for name, other in zip(rivals, taken[1:], strict=True)
    }
    return Row(what, *size, statistics.median(mine), min(mine), max(mine), times)


def one_scene(model: Trajectron, agents: int, repeats: int) -> Row:
    """A frame into one scene."""
    packed, frame = scene(model, agents)
    state = online.state_of(model, packed)
    rivals: dict[str, Call] = {
        "torch": lambda: model.step([state], [frame]),
        "bare products": bare_step(model, agents),
    }
    size = (agents, packed.edge_count)
    return measure("step", size, lambda: online.step(model, [packed], [frame]), rivals, repeats)


def many_scenes(model: Trajectron, repeats: int) -> Row:
    """A frame into each of many small scenes."""
    packed, frame = scene(model, SMALL_SCENE)
    scenes, frames = [packed] * MANY_SCENES, [frame] * MANY_SCENES
    states = [online.state_of(model, packed)] * MANY_SCENES
    rivals: dict[str, Call] = {
        "torch": lambda: model.step(states, frames),
        "one call a scene": lambda: [online.step(model, [packed], [frame]) for _ in scenes],
    }
    size = (MANY_SCENES * SMALL_SCENE, MANY_SCENES * packed.edge_count)
    what = f"step of {MANY_SCENES} scenes"
    return measure(what, size, lambda: online.step(model, scenes, frames), rivals, repeats)


def edges_alone(agents: int, repeats: int) -> Row:
    """A step with next to no encoders: edges, ages, features."""
    model = Trajectron(ModelConfig(history_size=1, edge_size=1)).eval().requires_grad_(False)
    packed, frame = scene(model, agents)
    size = (agents, packed.edge_count)
    return measure("edges", size, lambda: online.step(model, [packed], [frame]), {}, repeats)


def bytes_of(model: Trajectron, agents: int) -> int:
    """What is stored of a scene."""
    packed, _ = scene(model, agents)
    return len(packed.to_bytes(Layout.of(model.config)))


def per_agent(rows: Sequence[Row], what: str, many: int, few: int) -> float:
    """Cost of an agent among ``many`` over one among ``few``, by medians."""
    cost = {row.agents: row.ours_ms / row.agents for row in rows if row.what == what}
    return cost[many] / cost[few]


def table(rows: Sequence[Row]) -> str:
    """The figures as Markdown."""
    lines = ["| what | agents | edges | ours ms | rivals over ours |", "| --- " * 5 + "|"]
    for row in rows:
        rivals = ", ".join(f"{name} {ratio:.2f}" for name, ratio in row.times.items())
        spread = f"{row.ours_ms:.3f} ({row.ours_low_ms:.3f} to {row.ours_high_ms:.3f})"
        lines.append(f"| {row.what} | {row.agents} | {row.edges} | {spread} | {rivals or '-'} |")
    return "\n".join(lines)


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=25)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    model = registry.load(registry.DEFAULT).model.eval().requires_grad_(False)
    with torch.inference_mode():
        rows = [one_scene(model, agents, arguments.repeats) for agents in AGENTS]
        rows.append(many_scenes(model, arguments.repeats))
        rows += [edges_alone(agents, arguments.repeats) for agents in CROWDS]
    growth = {
        f"{what}, {many} over {few}": per_agent(rows, what, many, few)
        for what, many, few in (
            ("step", AGENTS[-2], AGENTS[2]),
            ("edges", CROWDS[-1], CROWDS[0]),
        )
    }
    weights = {str(agents): bytes_of(model, agents) for agents in AGENTS}
    sys.stdout.write(f"kernels: {kernels.in_use()}, threads: {arguments.threads}\n{table(rows)}\n")
    sys.stdout.writelines(f"cost an agent, {name}: {ratio:.2f}\n" for name, ratio in growth.items())
    sys.stdout.writelines(f"{n} agents take {size} bytes\n" for n, size in weights.items())
    if arguments.json:
        figures = {
            "threads": arguments.threads,
            "repeats": arguments.repeats,
            "torch": torch.__version__,
            "processor": processor(),
            "kernels": kernels.in_use(),
            "rows": [asdict(row) for row in rows],
            "cost_of_an_agent": growth,
            "bytes_of_a_scene": weights,
        }
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
