"""Times a step and 200 samples x 12 steps beside the bare matrix products of their shapes.

Every figure stands beside its floor, measured in the same run, in turn: the products that
the step or the rollout cannot do without, in float32, with the terms of z and h_enc taken
out of the loop. What is reported is the median of the ratios pair by pair; absolute times
are for the machine at hand.

    python benchmarks/model.py [--threads 2] [--repeats 7] [--json benchmarks/results/model.json]
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from trajectron_model import online
from trajectron_model.config import ModelConfig
from trajectron_model.forecast import ForecastRequest
from trajectron_model.packed import PackedScene, blank_scene
from trajectron_model.state import SceneFrame, SceneState
from trajectron_model.trajectron import Trajectron

AGENTS = (1, 5, 20, 40, 200)
GROWTH = (250, 500, 1000, 2000)
SAMPLES, HORIZON = 200, 12
PER_AGENT_AREA_M2 = 6.0
MANY_SCENES, SMALL_SCENE = 100, 5


def scene(model: Trajectron, agents: int) -> tuple[PackedScene, SceneFrame]:
    """A scene after 8 frames of a crowd of constant density, and the next frame."""
    random = np.random.default_rng(agents)
    place = random.uniform(0.0, (agents * PER_AGENT_AREA_M2) ** 0.5, (agents, 2))
    velocity = random.normal(0.0, 0.8, (agents, 2))
    ids = tuple(str(i) for i in range(agents))
    types = ("pedestrian",) * agents
    frames = [SceneFrame(0.4 * t, ids, types, place + 0.4 * t * velocity) for t in range(9)]
    packed = blank_scene()
    for frame in frames[:-1]:
        (packed,) = online.step(model, [packed], [frame])
    return packed, frames[-1]


def bare_rollout(model: Trajectron, agents: int) -> Callable[[], None]:
    """The recurrent and head products of every decoder step, and nothing else."""
    decoder = model.node_model(0).decoder
    rows = agents * SAMPLES
    hidden = torch.randn(rows, decoder.recurrent.in_features)
    recurrent, head = decoder.recurrent.weight.T.contiguous(), decoder.head.weight.T.contiguous()
    gates = torch.empty(rows, recurrent.shape[1])
    out = torch.empty(rows, head.shape[1])
    inner = hidden[:, : head.shape[0]].contiguous()

    def run() -> None:
        for _ in range(HORIZON):
            torch.mm(hidden, recurrent, out=gates)
            torch.mm(inner, head, out=out)

    return run


def bare_step(model: Trajectron, agents: int) -> Callable[[], None]:
    """The input and recurrent products of the history and edge LSTMs for one frame."""
    encoder = model.node_model(0).history
    cells = [encoder.node, *encoder.edges]
    pairs = [
        (torch.randn(agents, weight.shape[1]), weight.T.contiguous())
        for cell in cells
        for weight in (cell.weight_ih, cell.weight_hh)
    ]

    def run() -> None:
        for left, right in pairs:
            torch.mm(left, right)

    return run


def in_turn(
    one: Callable[[], Any], other: Callable[[], Any], repeats: int
) -> tuple[list[float], list[float]]:
    """Seconds of each, measured alternately after a warm-up."""
    one(), other()
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats):
        for call, kept in zip((one, other), times, strict=True):
            begun = time.perf_counter()
            call()
            kept.append(time.perf_counter() - begun)
    return times


def row(ours: list[float], floor: list[float]) -> dict[str, float]:
    """Medians in milliseconds, the spread of ours, and the ratio pair by pair."""
    ratios = [a / b for a, b in zip(ours, floor, strict=True)]
    return {
        "ours_ms": 1e3 * statistics.median(ours),
        "ours_min_ms": 1e3 * min(ours),
        "ours_max_ms": 1e3 * max(ours),
        "floor_ms": 1e3 * statistics.median(floor),
        "ratio": statistics.median(ratios),
    }


def measure(repeats: int) -> dict[str, Any]:
    """All figures of one run."""
    torch.manual_seed(0)
    model = Trajectron(ModelConfig()).eval().requires_grad_(False)
    sampling, step, growth = {}, {}, {}
    for agents in AGENTS:
        packed, frame = scene(model, agents)
        request = ForecastRequest(num_samples=SAMPLES, horizon=HORIZON)

        def sample(s: PackedScene = packed, r: ForecastRequest = request) -> Any:
            return model.forecast([online.state_of(model, s)], [r])

        def advance(s: PackedScene = packed, f: SceneFrame = frame) -> Any:
            return online.step(model, [s], [f])

        state = online.state_of(model, packed)

        def by_torch(s: SceneState = state, f: SceneFrame = frame) -> Any:
            return model.step([s], [f])

        with torch.inference_mode():
            sampling[agents] = row(*in_turn(sample, bare_rollout(model, agents), repeats))
            step[agents] = row(*in_turn(advance, bare_step(model, agents), 5 * repeats))
            torch_s, _ = in_turn(by_torch, lambda: None, 5 * repeats)
            step[agents]["torch_ms"] = 1e3 * statistics.median(torch_s)
    for agents in GROWTH:
        packed, frame = scene(model, agents)

        def grow(s: PackedScene = packed, f: SceneFrame = frame) -> Any:
            return online.step(model, [s], [f])

        ours, _ = in_turn(grow, lambda: None, 3 * repeats)
        growth[agents] = {"step_ms": 1e3 * statistics.median(ours)}
    many = [scene(model, SMALL_SCENE) for _ in range(MANY_SCENES)]

    def together() -> Any:
        return online.step(model, [one for one, _ in many], [frame for _, frame in many])

    def one_by_one() -> Any:
        return [online.step(model, [one], [frame]) for one, frame in many]

    batched, single = in_turn(together, one_by_one, 5 * repeats)
    per_agent = [growth[a]["step_ms"] / a for a in GROWTH]
    return {
        "sampling_200x12": sampling,
        "encoder_step": step,
        "step_growth": growth,
        "step_of_100_scenes_of_5": {
            "together_ms": 1e3 * statistics.median(batched),
            "one_by_one_ms": 1e3 * statistics.median(single),
        },
        "step_cost_per_agent_2000_over_250": per_agent[-1] / per_agent[0],
    }


def table(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    lines = ["| what | agents | ours ms | floor ms | ratio |", "| --- | --- | --- | --- | --- |"]
    for name in ("sampling_200x12", "encoder_step"):
        for agents, f in figures[name].items():
            lines.append(
                f"| {name} | {agents} | {f['ours_ms']:.2f} ({f['ours_min_ms']:.2f} to "
                f"{f['ours_max_ms']:.2f}) | {f['floor_ms']:.3f} | {f['ratio']:.2f} |"
            )
    for agents, f in figures["step_growth"].items():
        lines.append(f"| step_growth | {agents} | {f['step_ms']:.2f} | | |")
    many = figures["step_of_100_scenes_of_5"]
    lines.append(f"| 100 scenes of 5 together | 500 | {many['together_ms']:.2f} | | |")
    lines.append(f"| 100 scenes of 5 one by one | 500 | {many['one_by_one_ms']:.2f} | | |")
    ratio = figures["step_cost_per_agent_2000_over_250"]
    lines.append(f"\nCost of a step per agent, 2000 agents against 250: {ratio:.2f}")
    return "\n".join(lines)


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    figures = measure(arguments.repeats)
    about = {
        "threads": arguments.threads,
        "repeats": arguments.repeats,
        "torch": torch.__version__,
        "processor": platform.processor() or platform.machine(),
    }
    print(table(figures))
    if arguments.json:
        arguments.json.write_text(json.dumps({"about": about, **figures}, indent=1) + "\n")


if __name__ == "__main__":
    main()
