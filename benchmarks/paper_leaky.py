"""Trains and judges `paper-leaky`: the paper's model under the paper's conditions.

THESE FIGURES CONTAIN THE FUTURE: see docs/paper-leaky.md before comparing them with anything.
A network that OUT already holds is not trained again; every seed's figures are reported.

    python benchmarks/paper_leaky.py --data path/to/eth_ucy --out runs/paper-leaky \
        [--sets eth hotel univ zara1 zara2] [--seeds 0 1 2] [--steps 800] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.paper_leaky import WARNING, saving
from trajectron_model.paper_leaky.chunks import cut
from trajectron_model.paper_leaky.forecasting import joint_best_of
from trajectron_model.paper_leaky.inputs import prepare
from trajectron_model.paper_leaky.training import LeakySettings, Progress, train

BEST_OF = 100
SAMPLING_SEED = 0
PAPER = {
    "full": {
        "eth": (0.37, 0.72),
        "hotel": (0.20, 0.35),
        "univ": (0.48, 0.99),
        "zara1": (0.32, 0.62),
        "zara2": (0.34, 0.66),
    },
    "z_best": {
        "eth": (0.40, 0.78),
        "hotel": (0.19, 0.34),
        "univ": (0.47, 0.98),
        "zara1": (0.32, 0.64),
        "zara2": (0.33, 0.65),
    },
}
"""The paper's Table 1: ADE and FDE in metres."""


@dataclass(frozen=True)
class Figures:
    """One network on its test set: best of 100, joint, ADE and FDE in metres."""

    test_set: str
    seed: int
    step: int  # chosen on validation data
    full: tuple[float, float]
    z_best: tuple[float, float]


def main() -> None:
    """Trains what is missing, judges all, prints the table beside the paper's."""
    arguments = _arguments()
    torch.set_num_threads(arguments.threads)
    benchmark = EthUcy(arguments.data)
    found = []
    for seed in arguments.seeds:
        for name in arguments.sets:
            path = arguments.out / f"without-{name}-seed-{seed}"
            if not path.with_name(path.name + ".json").exists():
                settings = LeakySettings(steps=arguments.steps, seed=seed)
                _train(benchmark, name, path, settings)
            found.append(judge(benchmark, name, path, seed))
            print(line(found[-1]), flush=True)
    print(table(found))
    if arguments.json:
        content = {
            "warning": WARNING,
            "metric": f"best of {BEST_OF}, joint, [ADE, FDE] m",
            "figures": [asdict(one) for one in found],
        }
        arguments.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def judge(benchmark: EthUcy, name: str, path: Path, seed: int) -> Figures:
    """Both rows of the paper's table for one network, on all windows of its test set."""
    network, description = saving.load(path)
    inputs = prepare(cut(benchmark.test(name), seed))
    full, z_best = (
        joint_best_of(network, inputs, samples=BEST_OF, seed=SAMPLING_SEED, z_best=z_best)
        for z_best in (False, True)
    )
    return Figures(name, seed, description.provenance["selected"]["step"], full, z_best)


def line(figures: Figures) -> str:
    """One network's figures, beside the paper's."""
    rows = (
        f"{row} {ours[0]:.3f}/{ours[1]:.3f} (paper {paper[0]:.2f}/{paper[1]:.2f})"
        for row, ours in (("full", figures.full), ("z_best", figures.z_best))
        for paper in [PAPER[row][figures.test_set]]
    )
    return f"{figures.test_set} seed {figures.seed} step {figures.step}: {', '.join(rows)}"


def table(found: list[Figures]) -> str:
    """The mean over seeds for each set, and over the sets, as Markdown."""
    sets = list(dict.fromkeys(one.test_set for one in found))
    lines = ["| | " + " | ".join([*sets, "mean"]) + " |", "| --- " * (len(sets) + 2) + "|"]
    for row in ("full", "z_best"):
        ours = [_mean([getattr(one, row) for one in found if one.test_set == s]) for s in sets]
        paper = [PAPER[row][name] for name in sets]
        for label, cells in ((f"{row}, ours", ours), (f"{row}, paper", paper)):
            text = [f"{a:.3f}/{f:.3f}" for a, f in (*cells, _mean(cells))]
            lines.append(f"| {label} | " + " | ".join(text) + " |")
    return "\n".join(lines)


def _mean(errors: list[tuple[float, float]]) -> tuple[float, float]:
    return statistics.fmean(e[0] for e in errors), statistics.fmean(e[1] for e in errors)


def _train(benchmark: EthUcy, name: str, path: Path, settings: LeakySettings) -> None:
    with tqdm(total=settings.steps, unit=" steps", dynamic_ncols=True, mininterval=10) as bar:

        def observe(progress: Progress) -> None:
            bar.update()
            if progress.validation is not None:
                ade, fde = progress.validation
                bar.write(
                    f"{name} seed {settings.seed} step {progress.step}: log p "
                    f"{float(progress.terms.log_prob):.2f}, validation best of "
                    f"{settings.validation_samples} {ade:.3f}/{fde:.3f} m"
                )

        train(benchmark.training(name), benchmark.validation(name), path, settings, observe=observe)


def _arguments() -> Any:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, default=None, help="default: TRAJECTRON_DATA")
    parser.add_argument("--out", type=Path, required=True, help="gets the networks")
    parser.add_argument("--sets", nargs="+", choices=TEST_SETS, default=list(TEST_SETS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=LeakySettings().steps)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, default=None)
    return parser.parse_args()


if __name__ == "__main__":
    main()
