"""What each part of the model and its training gains, on sites that were trained on and not.

    python -m benchmarks.ablations --work runs/ablations [--data path/to/eth_ucy] [--seeds 0 1]
        [--variants default "no dropout"] [--json benchmarks/results/ablations.json]

Every variant differs from the default in one thing. All train on the training parts of Hotel,
Zara1, Zara2 and Zara3 and are judged on the validation parts of these (known sites) and of ETH
and the three recordings of Univ (unseen sites). No test set is touched whole, but validation
parts belong to test recordings of other folds: see docs/model.md. A finished training is kept in
``--work`` and not repeated; several processes may share the folder when their seeds differ.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from trajectron_model.checkpoint import write_atomically
from trajectron_model.data.eth_ucy import EthUcy
from trajectron_model.training.settings import Preset, TrainSettings, presets
from trajectron_model.training.trainer import Progress, train
from trajectron_model.training.validation import Validation, ValidationFigures

KNOWN = ("biwi_hotel", "crowds_zara01", "crowds_zara02", "crowds_zara03")
UNSEEN = {"ETH": ("biwi_eth",), "Univ": ("students001", "students003", "uni_examples")}
JUDGED_AGENTS = 400
"""Of each recording, in windows spread evenly."""

SHOWN = {
    "best of 20": ("min_ade_20", "min_fde_20"),
    "point forecast": ("ade_mean", "fde_mean"),
    "most probable mode": ("ade_mode", "fde_mode"),
}
Figures = dict[str, dict[str, float]]  # by group of sites, by name of the figure


@dataclass(frozen=True)
class Run:
    """One training: a variant and a seed, with its figures."""

    variant: str
    seed: int
    steps: int
    key: str
    """Of the settings and the data: another training never stands in for this one."""
    figures: Figures


def variants() -> dict[str, Preset]:
    """By name: the default, and what differs from it in one thing."""
    base = presets()["default"]
    examples, objective = base.train.examples, base.train.objective

    def drawn(**changes: Any) -> Preset:
        return replace(base, train=replace(base.train, examples=replace(examples, **changes)))

    def minimised(**changes: Any) -> Preset:
        return replace(base, train=replace(base.train, objective=replace(objective, **changes)))

    return {
        "default": base,
        "no changing pace": drawn(pace=0.0),
        "no noise on inputs": drawn(input_noise_m=0.0),
        "no stretching": drawn(scale=0.0),
        "no mirroring": drawn(mirror=False),
        "no label noise": minimised(label_noise_mps=0.0),
        "no dropout": minimised(encoding_dropout=0.0),
        "ELBO": replace(
            base, train=replace(base.train, objective=presets()["elbo"].train.objective)
        ),
        "radius 1.5 m": replace(base, model=replace(base.model, radius_m=1.5)),
        "the paper's features": replace(base, model=replace(base.model, features="world")),
    }


def settings_of(preset: Preset, seed: int, steps: int) -> TrainSettings:
    """How a variant is trained here."""
    return replace(
        preset.train, steps=steps, validate_every=steps, seed=seed, threads=1, calibrate=False
    )


def key_of(preset: Preset, seed: int, steps: int, data: EthUcy) -> str:
    """What `Run.key` says."""
    known = [data.part(one, "training").provenance for one in KNOWN]
    judged = [data.part(one, "validation").provenance for one in chain(KNOWN, *UNSEEN.values())]
    about = [preset.model.to_json(), settings_of(preset, seed, steps).to_json(), known, judged]
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]


def measure(name: str, preset: Preset, seed: int, steps: int, data: EthUcy, folder: Path) -> Run:
    """Trains one variant with one seed and judges what it ends with."""
    settings = settings_of(preset, seed, steps)
    training = [data.part(one, "training") for one in KNOWN]
    validation = [data.part(one, "validation") for one in KNOWN]
    with tqdm(total=steps, desc=f"{name}, seed {seed}", unit=" steps") as bar:

        def observe(_: Progress) -> None:
            bar.update()

        model = train(
            preset.model,
            settings,
            training,
            validation,
            folder,
            provenance={"task": f"ablation: {name}"},
            observe=observe,
            device="cpu",
        ).model
    groups = {"known": KNOWN, **UNSEEN}
    found = {}
    for group, names in groups.items():
        parts = [data.part(one, "validation") for one in names]
        figures = Validation(parts, model, JUDGED_AGENTS).figures(model, settings.objective)
        found[group] = _named(figures)
    return Run(name, seed, steps, key_of(preset, seed, steps, data), found)


def _named(figures: ValidationFigures) -> dict[str, float]:
    return {name: float(value) for name, value in figures._asdict().items()}


def runs_of(work: Path, wanted: Collection[str]) -> list[Run]:
    """All that is finished in a folder, of these keys."""
    found = [Run(**json.loads(path.read_text())) for path in sorted(work.glob("*/figures.json"))]
    return [run for run in found if run.key in wanted]


def table(runs: Sequence[Run]) -> str:
    """Means over seeds as Markdown, for every group of sites, then changes from the default.

    A change is the mean over seeds that both have, of the difference with the same seed; the
    number behind it is its standard error (none with one seed).
    """
    by_variant: dict[str, dict[int, Figures]] = {}
    for run in runs:
        by_variant.setdefault(run.variant, {})[run.seed] = run.figures
    order = [name for name in variants() if name in by_variant]
    groups = ("known", *UNSEEN)
    lines = []
    for title, (ade, fde) in SHOWN.items():
        header = [title, "seeds", *(f"{group}, ADE/FDE" for group in groups)]
        if "default" in by_variant:
            header += [f"{group}, change of ADE" for group in groups]
        lines += ["| " + " | ".join(header) + " |", "| --- " * len(header) + "|"]
        for name in order:
            of = by_variant[name]
            row = [name, str(len(of))]
            row += [f"{_mean(of, group, ade):.3f}/{_mean(of, group, fde):.3f}" for group in groups]
            if "default" in by_variant:
                row += [_change(of, by_variant["default"], group, ade) for group in groups]
            lines.append("| " + " | ".join(row) + " |")
        lines.append("")
    return "\n".join(lines)


def _mean(of: Mapping[int, Figures], group: str, name: str) -> float:
    return float(np.mean([figures[group][name] for figures in of.values()]))


def _change(of: Mapping[int, Figures], base: Mapping[int, Figures], group: str, name: str) -> str:
    seeds = sorted(of.keys() & base.keys())
    if of is base or not seeds:
        return "–"
    change = np.array([of[s][group][name] / base[s][group][name] - 1.0 for s in seeds])
    error = f" ± {100 * change.std(ddof=1) / len(seeds) ** 0.5:.1f}" if len(seeds) > 1 else ""
    return f"{100 * change.mean():+.1f}{error} %"


def main() -> None:
    """The command; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, help="default: the environment's TRAJECTRON_DATA")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--variants", nargs="+", choices=list(variants()), default=list(variants()))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    data = EthUcy(options.data)
    keys = set()
    for seed in options.seeds:
        for name in options.variants:
            preset = variants()[name]
            key = key_of(preset, seed, options.steps, data)
            keys.add(key)
            folder = options.work / key
            if not (folder / "figures.json").exists():
                run = measure(name, preset, seed, options.steps, data, folder)
                write_atomically(folder / "figures.json", json.dumps(asdict(run)).encode())
    runs = runs_of(options.work, keys)
    print(table(runs))
    if options.json:
        text = json.dumps([asdict(run) for run in runs], separators=(",", ":"))
        write_atomically(options.json, text.encode())


if __name__ == "__main__":
    main()
