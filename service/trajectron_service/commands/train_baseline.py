"""``trajectron train-baseline``: a baseline of the benchmark, from its recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from trajectron_service.commands.errors import UsageError
from trajectron_service.commands.options import out

if TYPE_CHECKING:
    from trajectron_model.baselines.training import Validated
    from trajectron_model.data.eth_ucy import EthUcy
    from trajectron_model.data.recording import Recording

_LICENCE = (
    "The weights are free to use under this project's licence; the recordings they were "
    "trained on belong to their makers and are not included."
)


def train_baseline(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="`kalman`, `lstm`, `social-lstm`, `social-attention` or `sgan`."
        ),
    ],
    *,
    eth_ucy: Annotated[
        Literal["all", "eth", "hotel", "univ", "zara1", "zara2"],
        typer.Option(
            help="The test set to leave out: trained on the training parts of the other "
            "recordings, selected on their validation parts; `all` leaves none out."
        ),
    ],
    folder: Annotated[
        Path, typer.Option("--out", metavar="DIR", file_okay=False, help="Gets the baseline.")
    ],
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            envvar="TRAJECTRON_DATA",
            help="The folder of the ETH/UCY recordings with their `splits.json`, or its parent.",
        ),
    ] = None,
    minutes: Annotated[
        float | None, typer.Option(min=0.01, help="CPU time at most; by default the baseline's.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of weights, batches and noise.")] = 0,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads.")] = None,
) -> None:
    """Trains a baseline until its validation error falls no more, or for so many minutes.

    Leaves the best one, by validation, in `DIR/baseline.safetensors`, and in `DIR/baseline.json`
    what it was trained on and how the training ended.

    Example: `trajectron train-baseline lstm --eth-ucy zara1 --out runs/lstm-zara1 --threads 1`
    """
    from trajectron_model.baselines import recipes, saving
    from trajectron_model.data.eth_ucy import EthUcy

    if name not in recipes.SETTINGS:
        raise UsageError(f"{name}: the baselines that learn are {', '.join(recipes.SETTINGS)}")
    settings = replace(recipes.SETTINGS[name], seed=seed, threads=threads)
    settings = replace(settings, minutes=minutes or settings.minutes)
    training, validation, task = _recordings(EthUcy(data), eth_ucy)
    try:
        path = recipes.train(
            name,
            settings,
            training,
            validation,
            folder,
            provenance={"task": task, "licence": _LICENCE},
            observe=_show,
        )
    except ValueError as error:
        raise UsageError(str(error)) from error
    facts = saving.describe(path).provenance
    figures = ", ".join(f"{k} {v:.3f}" for k, v in facts["selected"]["validation_figures"].items())
    out.print(f"{path}.json: {facts['outcome']} in {facts['cpu_minutes']} CPU minutes: {figures}")


def _recordings(benchmark: EthUcy, eth_ucy: str) -> tuple[list[Recording], list[Recording], str]:
    """What to train on, what to select on, and in words which."""
    task = "ETH/UCY pedestrians, training parts of all recordings"
    if eth_ucy == "all":
        return benchmark.training_all(), benchmark.validation_all(), task
    task = f"{task} but test set {eth_ucy}"
    return benchmark.training(eth_ucy), benchmark.validation(eth_ucy), task


def _show(validated: Validated) -> None:
    best = " (best so far)" if validated.best_step == validated.step else ""
    out.print(
        f"step {validated.step}, {validated.minutes:.1f} min: loss {validated.loss:.3f}, "
        f"validation {validated.ade_m:.3f}/{validated.fde_m:.3f} m{best}"
    )
