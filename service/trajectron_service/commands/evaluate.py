"""``trajectron evaluate``: models and constant velocity on ETH/UCY, side by side."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from trajectron_service.commands.errors import UsageError
from trajectron_service.commands.options import out

if TYPE_CHECKING:
    from trajectron_model.data.eth_ucy import EthUcy
    from trajectron_model.evaluate import Contender, Entry, EvaluationSet
    from trajectron_model.results import Evaluation

LEAVE_ONE_OUT = "eth_ucy-without-{test_set}"


def evaluate(
    *,
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
        typer.Option(metavar="NAME|PATH", help="A model, judged on every set; may be repeated."),
    ] = None,
    leave_one_out: Annotated[
        bool,
        typer.Option(
            "--leave-one-out",
            help="On each set, the bundled model that was trained without it. "
            "The default where no `--model` is given.",
        ),
    ] = False,
    protocol: Annotated[
        Literal["sgan", "all"],
        typer.Option(
            help="`sgan`: windows of 8 observed and 12 further steps with at least two people "
            "present throughout; `all`: one suffices."
        ),
    ] = "sgan",
    samples: Annotated[
        int, typer.Option(min=1, max=2000, help="Independent futures drawn for each agent.")
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of the samples.")] = 0,
    json_file: Annotated[
        Path | None,
        typer.Option(
            "--json", metavar="FILE", dir_okay=False, help="Write the result there as JSON too."
        ),
    ] = None,
    in_sample: Annotated[
        bool,
        typer.Option(
            "--in-sample",
            help="Judge models on recordings they were trained on as well; their rows say so.",
        ),
    ] = False,
) -> None:
    """Judges models on the ETH/UCY benchmark, constant velocity beside them.

    Shows ADE/FDE in metres: of the point forecast in both forms, and of the best of 1, 5, 20
    and 100 samples, chosen per agent and jointly per scene; for each set and as their mean.

    Example: `trajectron evaluate --leave-one-out --sets zara1,zara2 --json results.json`
    """
    from trajectron_model.data.eth_ucy import EthUcy

    recordings = EthUcy(data)
    test_sets = _evaluation_sets(recordings, sets)
    names = [test_set.name for test_set in test_sets]
    models = list(dict.fromkeys(model or ()))
    entries = _entries(names, models, leave_one_out or not models)
    result = _judged(entries, test_sets, protocol, samples, seed, in_sample)
    out.print(_heading(result), end="\n\n")
    out.print(result.to_markdown(), markup=False)
    if json_file is not None:
        json_file.write_text(json.dumps(result.to_json(), indent=2) + "\n", encoding="utf-8")


def _evaluation_sets(recordings: EthUcy, sets: str) -> list[EvaluationSet]:
    from trajectron_model.evaluate import EvaluationSet

    names = list(dict.fromkeys(name.strip() for name in sets.split(",") if name.strip()))
    unknown = [name for name in names if name not in recordings.test_sets]
    if unknown or not names:
        known = ", ".join(recordings.test_sets)
        wrong = f"unknown: {', '.join(unknown)}" if unknown else "none given"
        raise UsageError(f"--sets: {wrong}; the test sets are {known}")
    return [EvaluationSet(name, tuple(recordings.test(name))) for name in names]


def _entries(names: Sequence[str], models: Sequence[str], leave_one_out: bool) -> list[Entry]:
    """The rows: constant velocity first, then the family of bundled models, then the others."""
    from trajectron_model.baselines.constant_velocity import ConstantVelocity
    from trajectron_model.evaluate import Contender, Entry

    baseline = ConstantVelocity()
    entries = [Entry(baseline.name, {name: Contender(baseline) for name in names})]
    if leave_one_out:
        family = {name: _contender(LEAVE_ONE_OUT.format(test_set=name)) for name in names}
        entries.append(Entry("eth_ucy, leave-one-out", family))
    for model in models:
        contender = _contender(model)
        entries.append(Entry(model, dict.fromkeys(names, contender)))
    return entries


def _contender(model: str) -> Contender:
    from trajectron_model import registry
    from trajectron_model.evaluate import Contender
    from trajectron_model.predictor import TrajectronPredictor

    checkpoint = registry.load(model)
    predictor = TrajectronPredictor(checkpoint.model, checkpoint.name)
    return Contender.of_model(predictor, checkpoint.sha256, checkpoint.provenance)


def _judged(
    entries: Sequence[Entry],
    test_sets: Sequence[EvaluationSet],
    protocol: str,
    samples: int,
    seed: int,
    in_sample: bool,
) -> Evaluation:
    """The evaluation, with a progress bar over windows on a terminal."""
    from tqdm import tqdm

    from trajectron_model.data.windows import PROTOCOLS
    from trajectron_model.evaluate import InSampleError
    from trajectron_model.evaluate import evaluate as judge

    of = PROTOCOLS[protocol]
    windows = sum(len(of.windows(test_set.recordings)) for test_set in test_sets)
    with tqdm(total=windows * len(entries), unit=" windows", disable=None, leave=False) as bar:
        try:
            return judge(
                entries,
                test_sets,
                protocol=of,
                samples=samples,
                seed=seed,
                in_sample=in_sample,
                progress=bar.update,
            )
        except InSampleError as error:
            raise UsageError(f"{error} (--leave-one-out, --in-sample)") from error


def _heading(result: Evaluation) -> str:
    """The protocol in one line."""
    of, fingerprint = result.fingerprint.protocol, result.fingerprint
    return (
        f"Protocol {of.name}: {of.observed} steps of {fingerprint.dt_s:g} s observed, "
        f"{of.horizon} foretold; {fingerprint.samples} independent samples, "
        f"seed {fingerprint.seed}; the mean weighs the sets alike."
    )
