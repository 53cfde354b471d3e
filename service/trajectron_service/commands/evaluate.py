"""``trajectron evaluate``: models and baselines on recordings, side by side."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from trajectron_service.commands.errors import UsageError
from trajectron_service.commands.options import out

if TYPE_CHECKING:
    from trajectron_model.evaluation.plan import EvaluationPlan
    from trajectron_model.evaluation.results import Evaluation

_BASELINE = "constant-velocity"


def evaluate(
    *,
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[FILE]...",
            help="Recordings to judge on instead of ETH/UCY, each a set of its own: "
            "CSV `time,id,type,x,y`, or ETH/UCY text.",
            exists=True,
            dir_okay=False,
            readable=True,
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            envvar="TRAJECTRON_DATA",
            help="The folder of the ETH/UCY recordings with their `splits.json`, or its parent.",
        ),
    ] = None,
    sets: Annotated[
        str, typer.Option(metavar="SET,...", help="Test sets: `eth,hotel,univ,zara1,zara2`.")
    ] = "eth,hotel,univ,zara1,zara2",
    model: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME|PATH",
            help="A bundled model, a checkpoint or a baseline such as `kalman`, judged on every "
            "set; may be repeated. Constant velocity is always beside.",
        ),
    ] = None,
    leave_one_out: Annotated[
        bool,
        typer.Option(
            "--leave-one-out",
            help="On each set, the bundled model that was trained without it. "
            "The default where neither `--model` nor a file is given.",
        ),
    ] = False,
    protocol: Annotated[
        Literal["sgan", "all", "streaming", "paper"],
        typer.Option(
            help="`sgan`: windows of 8 observed and 12 further steps with at least two people "
            "present throughout; `all`: one suffices; `streaming`: every frame, everyone in it; "
            "`paper`: chunks of 100 steps, as in the Trajectron's own evaluation."
        ),
    ] = "sgan",
    samples: Annotated[
        int, typer.Option(min=1, max=2000, help="Independent futures drawn for each agent.")
    ] = 100,
    kde_samples: Annotated[
        int | None,
        typer.Option(
            min=2,
            max=2000,
            help="Those in kernel density estimates: 2000 under `paper`, else `--samples`.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the samples.")] = 0,
    max_windows: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="At most N windows of each set: every k-th."),
    ] = None,
    jitter_m: Annotated[
        float,
        typer.Option(
            "--jitter",
            min=0.0,
            max=10.0,
            metavar="METRES",
            help="Standard deviation of noise on observed positions, as a tracker has it.",
        ),
    ] = 0.0,
    in_sample: Annotated[
        bool,
        typer.Option(
            "--in-sample",
            help="Judge models on recordings they were trained on as well; their rows say so.",
        ),
    ] = False,
    work: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            file_okay=False,
            help="Keep the work there: the same command goes on where it was stopped.",
        ),
    ] = None,
    json_file: Annotated[
        Path | None,
        typer.Option("--json", metavar="FILE", dir_okay=False, help="Write the result as JSON."),
    ] = None,
    csv_file: Annotated[
        Path | None,
        typer.Option(
            "--csv", metavar="FILE", dir_okay=False, help="Write every estimate as a line of CSV."
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", file_okay=False, help="Write a report there: HTML and Markdown, figures."
        ),
    ] = None,
) -> None:
    """Judges models and baselines on the same windows of ETH/UCY, or of recordings of yours.

    Shows errors of the point forecast in both forms, of the best of 1, 5, 20 and 100 samples,
    chosen per agent and jointly per scene, likelihoods, coverage and collisions; for each set
    and as their mean. JSON and CSV have confidence intervals and every horizon step too.

    Example: `trajectron evaluate --leave-one-out --model kalman --sets zara1,zara2`
    """
    from trajectron_model.evaluation import tables
    from trajectron_model.evaluation.plan import EvaluationPlan

    plan = EvaluationPlan(
        entries=_entries(list(model or ()), leave_one_out, bool(files)),
        sets=() if files else _names(sets),
        files=tuple(str(file) for file in files or ()),
        protocol=protocol,
        samples=samples,
        seed=seed,
        in_sample=in_sample,
        kde_samples=kde_samples,
        max_windows=max_windows,
        jitter_m=jitter_m,
    )
    with _folder(work) as folder:
        result = _judged(plan, folder, data)
        if report is not None:
            _write_report(plan, result, folder, data, report)
    out.print(tables.heading(result.fingerprint), markup=False, end="\n\n")
    out.print(result.to_markdown(), markup=False)
    if json_file is not None:
        json_file.write_text(json.dumps(result.to_json(), indent=1) + "\n", encoding="utf-8")
    if csv_file is not None:
        csv_file.write_text(result.to_csv(), encoding="utf-8")


def _names(sets: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in sets.split(",") if name.strip()))
    if not names:
        raise UsageError("--sets: none given")
    return names


def _entries(models: Sequence[str], leave_one_out: bool, files: bool) -> tuple[str, ...]:
    """The rows: constant velocity first, then the family of bundled models, then the others."""
    from trajectron_model import registry
    from trajectron_model.evaluation.contenders import LEAVE_ONE_OUT

    family = leave_one_out or not (models or files)
    usual = [registry.DEFAULT] if files and not models and not family else []
    entries = [_BASELINE, *([LEAVE_ONE_OUT] if family else []), *usual, *models]
    return tuple(dict.fromkeys(entries))


@contextlib.contextmanager
def _folder(work: Path | None) -> Iterator[Path]:
    """Where the work is kept: the given folder, or one that goes with the command."""
    if work is not None:
        yield work
        return
    with tempfile.TemporaryDirectory(prefix="trajectron-evaluate-") as folder:
        yield Path(folder)


def _judged(plan: EvaluationPlan, folder: Path, data: Path | None) -> Evaluation:
    """The evaluation, with a progress bar over windows on a terminal."""
    from tqdm import tqdm

    from trajectron_model.evaluation.contenders import InSampleError
    from trajectron_model.evaluation.run import Progress, run

    with tqdm(unit=" windows", disable=None, leave=False) as bar:

        def show(progress: Progress) -> None:
            bar.total = progress.windows_total
            bar.set_description(f"{progress.entry} on {progress.set}", refresh=False)
            bar.update(progress.windows_done - bar.n)

        try:
            return run(plan, folder, data=data, progress=show)
        except InSampleError as error:
            raise UsageError(f"{error} (--leave-one-out, --in-sample)") from error


def _write_report(
    plan: EvaluationPlan, result: Evaluation, folder: Path, data: Path | None, report: Path
) -> None:
    from trajectron_model.evaluation.report import write_report
    from trajectron_model.evaluation.run import load_scores

    write_report(result, load_scores(plan, folder, data=data), report)
