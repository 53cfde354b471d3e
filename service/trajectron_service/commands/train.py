"""``trajectron train``: a model from recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer

from trajectron_service.commands.errors import UsageError
from trajectron_service.commands.options import FramesPerStep, out

if TYPE_CHECKING:
    from tqdm import tqdm

    from trajectron_model.data.recording import Recording
    from trajectron_model.training.settings import Preset
    from trajectron_model.training.trainer import Progress

Recordings = list["Recording"]

_VALIDATION_SHARE = 0.2
_LICENCE = (
    "The weights are free to use under this project's licence; the recordings they were "
    "trained on belong to their makers and are not included."
)


def train(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILE...",
            help="Recordings: CSV `time,id,type,x,y`, ETH/UCY text, or ApolloScape.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    *,
    folder: Annotated[
        Path,
        typer.Option(
            "--out", metavar="DIR", file_okay=False, help="Gets the model, its log, its progress."
        ),
    ],
    validation: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            exists=True,
            dir_okay=False,
            help="A recording to select on, repeatable. By default the last fifth of each FILE.",
        ),
    ] = None,
    eth_ucy: Annotated[
        Literal["all", "eth", "hotel", "univ", "zara1", "zara2"] | None,
        typer.Option(
            help="Instead of FILEs: the benchmark's training parts without this test set "
            "(`all`: the parts of all recordings), selected on its validation parts."
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            envvar="TRAJECTRON_DATA",
            help="For `--eth-ucy`: the folder of the recordings with their `splits.json`.",
        ),
    ] = None,
    preset: Annotated[
        str, typer.Option(help="`default`, `elbo`, `paper` or `traffic`: see the documentation.")
    ] = "default",
    steps: Annotated[int | None, typer.Option(min=1, help="Gradient steps.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of weights, examples and noise.")] = 0,
    agents: Annotated[int | None, typer.Option(min=1, help="Agents in a batch.")] = None,
    validate_every: Annotated[
        int | None, typer.Option(min=1, help="Steps between validations.")
    ] = None,
    learning_rate: Annotated[
        float | None, typer.Option(min=0.0, help="At its peak; it ends at zero.")
    ] = None,
    average_steps: Annotated[
        int | None,
        typer.Option(min=0, help="Weights are averaged over about so many steps; 0: not at all."),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|PATH",
            help="A bundled model or a checkpoint to go on from instead of random weights, "
            "trained on none but the same recordings.",
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the training that `--out` holds.")
    ] = False,
    device: Annotated[
        str | None, typer.Option(help="`cpu` or `cuda`; by default CUDA where there is one.")
    ] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads.")] = None,
    frames_per_step: FramesPerStep = 10,
) -> None:
    """Trains a model on recordings and keeps the one that is best on validation data.

    Shows the loss terms as it goes and logs them for TensorBoard in `DIR/tensorboard`.
    Serve the result with `trajectron serve --model DIR/model.json`.

    Example: `trajectron train street.csv --out runs/street --steps 500`
    """
    from tqdm import tqdm

    from trajectron_model import registry
    from trajectron_model.training.log import TensorBoardLog
    from trajectron_model.training.settings import presets
    from trajectron_model.training.trainer import train as run

    if preset not in presets():
        raise UsageError(f"--preset {preset}: the presets are {', '.join(presets())}")
    chosen = presets()[preset]
    settings = replace(chosen.train, seed=seed, threads=threads)
    settings = replace(
        settings,
        steps=steps or settings.steps,
        validate_every=validate_every or settings.validate_every,
        learning_rate=learning_rate or settings.learning_rate,
        average_steps=settings.average_steps if average_steps is None else average_steps,
        examples=replace(settings.examples, agents=agents or settings.examples.agents),
    )
    training, judged, task = _recordings(
        files or [], validation or [], eth_ucy, data, chosen, frames_per_step
    )
    facts: dict[str, Any] = {"task": task, "preset": preset, "licence": _LICENCE}
    with (
        tqdm(total=settings.steps, unit=" steps", dynamic_ncols=True) as bar,
        TensorBoardLog(folder / "tensorboard") as log,
    ):
        display = _Display(bar)

        def observe(progress: Progress) -> None:
            log.record(progress)
            display.show(progress)

        try:
            checkpoint = run(
                chosen.model,
                settings,
                training,
                judged,
                folder,
                provenance=facts,
                observe=observe,
                device=device,
                resume=resume,
                start=None if start is None else registry.load(start),
            )
        except ValueError as error:
            raise UsageError(str(error)) from error
    selected = checkpoint.provenance["selected"]
    figures = ", ".join(f"{k} {v:.3f}" for k, v in selected["validation_figures"].items())
    out.print(f"{folder / 'model.json'}: step {selected['step']}: {figures}")


def _recordings(
    files: list[Path],
    validation: list[Path],
    eth_ucy: str | None,
    data: Path | None,
    preset: Preset,
    frames_per_step: int,
) -> tuple[Recordings, Recordings, str]:
    """What to train on, what to select on, and in words which."""
    from trajectron_model.data.eth_ucy import EthUcy
    from trajectron_model.data.readers import read

    if eth_ucy is not None:
        if files or validation:
            raise UsageError("--eth-ucy brings its own recordings: leave out the files")
        benchmark = EthUcy(data)
        if eth_ucy == "all":
            task = "ETH/UCY pedestrians, training parts of all recordings"
            return benchmark.training_all(), benchmark.validation_all(), task
        task = f"ETH/UCY pedestrians, training parts of all recordings but test set {eth_ucy}"
        return benchmark.training(eth_ucy), benchmark.validation(eth_ucy), task
    if not files:
        raise UsageError("give recordings to train on, or --eth-ucy")
    dt_s = preset.model.dt_s
    whole = [read(f, dt_s=dt_s, frames_per_step=frames_per_step) for f in files]
    task = f"recordings {', '.join(r.name for r in whole)}"
    if validation:
        judged = [read(f, dt_s=dt_s, frames_per_step=frames_per_step) for f in validation]
        return whole, judged, task
    parts = [(r, round(r.num_steps * (1.0 - _VALIDATION_SHARE))) for r in whole]
    return (
        [replace(r.between(0, cut), part="training") for r, cut in parts],
        [replace(r.between(cut, r.num_steps), part="validation") for r, cut in parts],
        task,
    )


class _Display:
    """A progress bar with the loss terms, and a line for each validation."""

    def __init__(self, bar: tqdm[NoReturn]) -> None:
        self._bar = bar

    def show(self, progress: Progress) -> None:
        """One step."""
        terms, figures = progress.terms, progress.figures
        self._bar.update(progress.step - self._bar.n)
        self._bar.set_postfix(
            nll=f"{float(terms.nll):.2f}",
            reconstruction=f"{float(terms.reconstruction):.2f}",
            kl=f"{float(terms.kl):.2f}",
        )
        if figures is not None:
            self._bar.write(
                f"step {progress.step}: validation nll {figures.nll:.2f}, best of 20 "
                f"{figures.min_ade_20:.3f}/{figures.min_fde_20:.3f} m, point "
                f"{figures.ade_mean:.3f}/{figures.fde_mean:.3f} m"
                + (" (best so far)" if progress.best_step == progress.step else "")
            )
