"""Times forecasts beside the bare matrix products of the decoder, and beside torch alone.

The floor of ``full`` is the recurrent and head products of the shipped decoder, rows = agents x
samples, the terms of z and h_enc taken out of the loop; that of ``gmm`` the same with rows =
agents x latent values. There are two: in float32 by torch (or bfloat16, where a trial finds that
quicker; a processor without it takes minutes for them), and in 16-bit integers by the kernel's
own tiles, which is the quickest format that forecasts are made in, on one thread. Forecasts are
whole: from states to arrays, noise included. Every figure is measured in turn with its floors;
ratios are taken pair by pair.

    python -m benchmarks.decoding [--threads 2] [--repeats 9] [--check] [--json FILE]

``--check`` compares ratios with generous bounds and ends with 1 where one is beyond.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks.model import HORIZON, SAMPLES, scene
from benchmarks.runtime import about
from trajectron_model import kernels, online, registry
from trajectron_model.decoder import Decoder
from trajectron_model.forecast import ForecastRequest
from trajectron_model.kernels import decoding
from trajectron_model.trajectron import Trajectron

FULL_AGENTS = (1, 5, 20, 40, 200, 1000)
GMM_AGENTS = (1, 20, 40)
# Torch alone is slow: as many agents as its share of a run allows.
_TORCH_UP_TO = 200
# Many rows are measured few times: each run is long and so less disturbed.
_ROWS_A_REPEAT = 40_000

# What a change must not lose, on a machine that may be at other work too.
_MOST_OF_THE_FLOOR = 2.0
_LEAST_GAIN_OVER_TORCH = 1.2
_MOST_GROWTH = 1.25


@dataclass(frozen=True)
class Row:
    """Milliseconds (median and spread), and ratios pair by pair (medians)."""

    mode: str
    agents: int
    repeats: int
    ours_ms: float
    ours_low_ms: float
    ours_high_ms: float
    floor_ms: float
    integers_ms: float | None
    torch_ms: float | None
    of_floor: float
    of_integers: float | None
    torch_of_ours: float | None


def products(decoder: Decoder, rows: int, dtype: torch.dtype) -> Callable[[], None]:
    """The recurrent and head products of every step, and nothing else."""
    hidden = torch.randn(rows, decoder.recurrent.in_features).to(dtype)
    inner = hidden[:, : decoder.head.in_features].contiguous()
    recurrent = decoder.recurrent.weight.T.contiguous().to(dtype)
    head = decoder.head.weight.T.contiguous().to(dtype)
    gates = torch.empty(rows, recurrent.shape[1], dtype=dtype)
    out = torch.empty(rows, head.shape[1], dtype=dtype)

    def run() -> None:
        for _ in range(HORIZON):
            torch.mm(hidden, recurrent, out=gates)
            torch.mm(inner, head, out=out)

    return run


def seconds(call: Callable[[], object]) -> float:
    """How long one call takes."""
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun


def bfloat16_over_float32(decoder: Decoder) -> float:
    """Time of the bare products in bfloat16 over that in float32, of few rows."""
    call, other = (products(decoder, 256, t) for t in (torch.bfloat16, torch.float32))
    call(), other()
    return statistics.median(seconds(call) / seconds(other) for _ in range(3))


def measure(model: Trajectron, mode: str, agents: int, repeats: int, floor: torch.dtype) -> Row:
    """One row of the table."""
    packed, _ = scene(model, agents)
    state = online.state_of(model, packed)
    decoder = model.node_model(0).decoder
    request = ForecastRequest(mode=mode, num_samples=SAMPLES, horizon=HORIZON)  # type: ignore[arg-type]
    rows = agents * (SAMPLES if mode == "full" else model.config.latent_values)
    repeats = max(3, min(repeats, repeats * _ROWS_A_REPEAT // rows))

    def ours() -> object:
        return model.forecast([state], [request])

    def torch_alone() -> object:
        with kernels.without():
            return model.forecast([state], [request])

    with torch.inference_mode():
        integers = decoding.products(decoder, rows, HORIZON)
    calls: dict[str, Callable[[], object]] = {
        "ours": ours,
        "floor": products(decoder, rows, floor),
    }
    if integers is not None:
        calls["integers"] = integers
    if agents <= _TORCH_UP_TO:
        calls["torch"] = torch_alone
    with torch.inference_mode():
        for call in calls.values():
            call()
        times = [[1e3 * seconds(call) for call in calls.values()] for _ in range(repeats)]
    columns = dict(zip(calls, zip(*times, strict=True), strict=True))

    def middle(name: str) -> float | None:
        return statistics.median(columns[name]) if name in columns else None

    def ratio(name: str) -> float | None:
        """Of ours to another's."""
        pairs = zip(columns["ours"], columns.get(name, ()), strict=False)
        return statistics.median([a / b for a, b in pairs]) if name in columns else None

    ours_ms, floor_ms = middle("ours"), middle("floor")
    of_floor, of_torch = ratio("floor"), ratio("torch")
    assert ours_ms is not None and floor_ms is not None and of_floor is not None
    return Row(
        mode=mode,
        agents=agents,
        repeats=repeats,
        ours_ms=ours_ms,
        ours_low_ms=min(columns["ours"]),
        ours_high_ms=max(columns["ours"]),
        floor_ms=floor_ms,
        integers_ms=middle("integers"),
        torch_ms=middle("torch"),
        of_floor=of_floor,
        of_integers=ratio("integers"),
        torch_of_ours=None if of_torch is None else 1.0 / of_torch,
    )


def table(rows: list[Row]) -> str:
    """The figures as Markdown."""
    titles = "forecast agents ours_ms bare_ms integers_ms torch_ms of_bare of_integers torch/ours"
    lines = [f"| {titles.replace(' ', ' | ')} |", "| --- " * 9 + "|"]
    for row in rows:
        optional = [row.integers_ms, row.torch_ms, row.of_integers, row.torch_of_ours]
        integers_ms, torch_ms, of_integers, gain = (
            "-" if figure is None else f"{figure:.2f}" for figure in optional
        )
        lines.append(
            f"| {row.mode} | {row.agents} | {row.ours_ms:.2f} ({row.ours_low_ms:.2f} to "
            f"{row.ours_high_ms:.2f}) | {row.floor_ms:.2f} | {integers_ms} | {torch_ms} "
            f"| {row.of_floor:.2f} | {of_integers} | {gain} |"
        )
    lines.append(f"\nCost per agent, 1000 agents against 40: {growth(rows):.2f}")
    return "\n".join(lines)


def growth(rows: list[Row]) -> float:
    """Cost per agent at 1000 agents over that at 40, by what is least disturbed."""
    least = {row.agents: row.ours_low_ms / row.agents for row in rows if row.mode == "full"}
    return least[1000] / least[40]


def faults(rows: list[Row]) -> list[str]:
    """What is worse than a change may make it; ratios only, and generous ones."""
    found = []
    for row in rows:
        if row.mode == "full" and row.agents >= 20 and row.of_floor > _MOST_OF_THE_FLOOR:
            found.append(f"{row.agents} agents: {row.of_floor:.2f} times the bare products")
        if row.torch_of_ours is not None and row.torch_of_ours < _LEAST_GAIN_OVER_TORCH:
            found.append(f"{row.mode}, {row.agents} agents: {row.torch_of_ours:.2f} of torch only")
    if growth(rows) > _MOST_GROWTH:
        found.append(f"an agent among 1000 costs {growth(rows):.2f} of one among 40")
    return found


def main() -> int:
    """Measures, prints, writes, and checks if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--check", action="store_true", help="end with 1 where a ratio is bad")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    model = registry.load(registry.DEFAULT).model.eval().requires_grad_(False)
    bfloat16 = bfloat16_over_float32(model.node_model(0).decoder)
    floor = torch.bfloat16 if bfloat16 < 1.0 else torch.float32
    asked = [("full", agents, arguments.repeats) for agents in FULL_AGENTS]
    asked += [("gmm", agents, 3 * arguments.repeats) for agents in GMM_AGENTS]
    rows = [measure(model, *one, floor) for one in asked]
    sys.stdout.write(f"kernels: {kernels.in_use()}, threads: {arguments.threads}\n{table(rows)}\n")
    if arguments.json:
        figures = {
            "about": about(arguments.threads, arguments.repeats),
            "kernels": kernels.in_use(),
            "floor": str(floor),
            "bfloat16_over_float32": bfloat16,
            "growth_1000_over_40": growth(rows),
            "rows": [asdict(row) for row in rows],
        }
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    found = faults(rows) if arguments.check else []
    sys.stdout.writelines(f"worse than allowed: {fault}\n" for fault in found)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
