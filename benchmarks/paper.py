"""The paper's figures and tables, measured again, for our models and every baseline.

    python -m benchmarks.paper --data path/to/eth_ucy          (make paper; some hours)
    python -m benchmarks.paper --quick                         (a few windows and samples)
    python -m benchmarks.paper --only streaming sgan           (these alone, and no report)
    python -m benchmarks.paper --samples 200                   (2000 in the paper: the long part)

Every figure comes from the evaluation harness (`trajectron_model.evaluation.run`), the path of
the command line and of the service. Work is kept in `--work` and goes on where it stopped; what
is done already costs nothing, and processes that are told to do different things share it. The
report goes to `--out`: `report.html`, `report.md`, figures, and the estimates as JSON.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from benchmarks import paper_sections, runtime
from benchmarks.paper_sections import Results
from trajectron_model import registry
from trajectron_model.checkpoint import write_atomically
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.data.readers import read
from trajectron_model.data.recording import Recording
from trajectron_model.evaluation import contenders, run
from trajectron_model.evaluation.contenders import FAMILY, LEAVE_ONE_OUT, PAPER_LEAKY
from trajectron_model.evaluation.plan import EvaluationPlan
from trajectron_model.evaluation.results import Evaluation, Scores
from trajectron_model.trajectron import Trajectron

BASELINES = (
    "sgan",
    "social-attention",
    "social-lstm",
    "lstm",
    "linear",
    "kalman",
    "constant-velocity-noise",
    "constant-velocity",
)
JITTERS_M = (0.02, 0.05, 0.10)
SAMPLES = 2000  # as the paper drew
FEW_WINDOWS = 250  # of each set, every k-th, for noise and few observations
SCENES, REPEATS = 12, 5  # of each set, in the table of runtimes
_QUICK_SCENES, _QUICK_REPEATS = 2, 1
_MOST_SEEDS = 100
_ROOT = Path(__file__).parents[1].resolve()
_JITTERED = ("sgan", "kalman", "constant-velocity-noise", "constant-velocity")


@dataclass(frozen=True)
class Options:
    """What is asked for.

    Attributes:
        sets: test sets of ETH/UCY; or empty, with ``files``.
        files: recordings of one's own, such as simulated ones.
        model: the model judged on ``files``; on ``sets`` it is the leave-one-out family.
        entries: baselines to stand beside it.
        data: the benchmark's folder; None for the environment's.
        work: where the work is kept.
        out: where the report goes.
        samples: of each agent in the boxplots, Table 1 and kernel densities.
        quick: few windows, few samples: to see that all works, not to quote.
        seed: of everything random.
    """

    sets: tuple[str, ...]
    files: tuple[str, ...]
    model: str
    entries: tuple[str, ...]
    data: Path | None
    work: Path
    out: Path
    quick: bool
    samples: int = SAMPLES
    seed: int = 0

    @property
    def ours(self) -> str:
        """The entry of our model."""
        return self.model if self.files else LEAVE_ONE_OUT

    @property
    def z_best(self) -> str:
        """The entry of our model with samples of its most probable mode alone."""
        return f"{self.ours}@{contenders.Z_BEST}"

    @property
    def stratified(self) -> str:
        """The entry of our model with stratified samples, in a row beside."""
        return f"{self.ours}@{contenders.STRATIFIED}"

    @property
    def set_names(self) -> tuple[str, ...]:
        """The names of the sets, in order."""
        return self.sets or tuple(Path(file).stem for file in self.files)


def plans(options: Options) -> dict[str, EvaluationPlan]:
    """The evaluations behind the report, by name; entries that are missing are among them.

    ``leaky`` is left out on recordings of one's own, which it was not made for.
    """
    full = EvaluationPlan(
        entries=(options.ours, *options.entries),
        sets=options.sets,
        files=options.files,
        seed=options.seed,
        max_windows=4 if options.quick else None,
        bootstrap=100 if options.quick else 1000,
    )
    thinned = replace(full, max_windows=4 if options.quick else FEW_WINDOWS)
    many, some, few = (20, 20, 20) if options.quick else (options.samples, 100, 20)
    jittered = tuple(name for name in full.entries if name in (options.ours, *_JITTERED))
    found = {
        "table-1": replace(
            full,
            entries=(options.ours, options.z_best, *options.entries),
            protocol="paper",
            samples=many,
            kde_samples=many,
        ),
        "sgan": replace(
            full, entries=(options.ours, options.stratified, *options.entries), samples=some
        ),
        "streaming": replace(thinned, protocol="streaming", samples=few),
    }
    for jitter_m in (0.0, *JITTERS_M):
        found[jitter_name(jitter_m)] = replace(
            thinned, entries=jittered, samples=few, jitter_m=jitter_m
        )
    if options.sets:
        found["leaky"] = replace(
            full,
            entries=(options.ours, *leaky_entries(options.sets)),
            protocol="paper",
            samples=some,
            kde_samples=some,
        )
    return found


def jitter_name(jitter_m: float) -> str:
    """The name of the evaluation under this jitter."""
    return f"jitter-{100 * jitter_m:.0f}-cm"


def leaky_entries(sets: Sequence[str]) -> tuple[str, ...]:
    """The leaking model, once for every seed that was trained for all of the sets."""
    from trajectron_model.paper_leaky import saving  # noqa: PLC0415 (fenced: only where asked)

    def there(seed: int) -> bool:
        return all(saving.bundled(one, seed).with_suffix(".json").exists() for one in sets)

    # Without any the first is asked for all the same, so that the report says it is missing.
    seeds = [seed for seed in range(_MOST_SEEDS) if there(seed)] or [0]
    return tuple(f"{PAPER_LEAKY}@seed-{seed}" for seed in seeds)


def available(
    plan: EvaluationPlan,
    recordings: Mapping[str, Sequence[Recording]],
    missing: dict[str, str],
) -> EvaluationPlan:
    """The plan without the entries that stand for nothing on one of its sets.

    Args:
        plan: with all entries.
        recordings: of every set.
        missing: gets the reason of each entry that is left out.
    """
    kept = []
    for entry in plan.entries:
        if entry in missing:
            continue
        try:
            for name, of in recordings.items():
                contenders.resolve(entry, name, of)
        except ValueError as error:  # a ContenderError or a CheckpointError, by their base
            missing[entry] = str(error).replace(f"{_ROOT}{os.sep}", "")
        else:
            kept.append(entry)
    return replace(plan, entries=tuple(kept))


def measure(options: Options) -> Results:
    """Carries out all evaluations and timings, from where an earlier call stopped."""
    recordings = _recordings(options)
    missing: dict[str, str] = {}
    wanted = {name: available(one, recordings, missing) for name, one in plans(options).items()}
    wanted = {
        name: plan
        for name, plan in wanted.items()
        if name != "leaky" or plan.entries != (options.ours,)
    }
    evaluations = {name: carry_out(options, name, plan) for name, plan in wanted.items()}
    if not options.files:
        left_out = [name for name in BASELINES if name not in options.entries]
        missing |= dict.fromkeys(left_out, "left out of this run by --models")
    models = {name: _model(options, name) for name in recordings}
    table_1 = wanted["table-1"]
    return Results(
        ours=options.ours,
        evaluations=evaluations,
        scores=run.load_scores(table_1, _folder(options, "table-1", table_1), data=options.data),
        timings=_timings(options, recordings, models),
        recordings=recordings,
        models=models,
        missing=missing,
        quick=options.quick,
    )


def carry_out(options: Options, name: str, plan: EvaluationPlan) -> Evaluation:
    """Carries out one evaluation, showing its progress."""
    with _bar(name) as show:
        return run.run(plan, _folder(options, name, plan), data=options.data, progress=show)


def _folder(options: Options, name: str, plan: EvaluationPlan) -> Path:
    """Where a plan's work is kept: another plan never finds it."""
    key = hashlib.sha256(json.dumps(plan.to_json()).encode()).hexdigest()[:8]
    return options.work / f"{name}-{key}"


@contextmanager
def _bar(name: str) -> Iterator[Callable[[run.Progress], None]]:
    with tqdm(desc=name, unit=" windows", disable=None) as bar:

        def show(progress: run.Progress) -> None:
            bar.total = progress.windows_total
            bar.n = progress.windows_done
            bar.set_postfix_str(f"{progress.entry} on {progress.set}", refresh=True)

        yield show


def _recordings(options: Options) -> dict[str, Sequence[Recording]]:
    if options.files:
        return {Path(file).stem: [read(file)] for file in options.files}
    data = EthUcy(options.data)
    return {name: data.test(name) for name in options.sets}


def _model(options: Options, test_set: str) -> Trajectron:
    return registry.load(_name(options, test_set)).model


def _sha256(options: Options, test_set: str) -> str:
    return registry.load(_name(options, test_set)).sha256


def _name(options: Options, test_set: str) -> str:
    return options.model if options.files else FAMILY.format(test_set=test_set)


def _timings(
    options: Options,
    recordings: dict[str, Sequence[Recording]],
    models: dict[str, Trajectron],
) -> list[runtime.SetTimings]:
    """The timings of each set, kept in the work folder; on one thread."""
    scenes, repeats = _runtime_size(options.quick)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    wanted = [name for name in runtime.BASELINES if name in options.entries]
    found = []
    try:
        for name, of in tqdm(recordings.items(), desc="runtime", unit=" sets", disable=None):
            about = [name, scenes, repeats, wanted, torch.__version__, runtime.processor()]
            about += [runtime.VERSION, _sha256(options, name), *(r.source_sha256 for r in of)]
            key = hashlib.sha256(json.dumps(about).encode()).hexdigest()[:8]
            file = options.work / f"runtime-{name}-{key}.json"
            if file.exists():
                content = json.loads(file.read_text(encoding="utf-8"))
                found.append(runtime.SetTimings.from_json(content))
                continue
            timings = runtime.measure_set(
                name, of, models[name], scene_count=scenes, repeats=repeats, wanted=wanted
            )
            write_atomically(file, json.dumps(asdict(timings)).encode())
            found.append(timings)
    finally:
        torch.set_num_threads(threads)
    return found


def _runtime_size(quick: bool) -> tuple[int, int]:
    return (_QUICK_SCENES, _QUICK_REPEATS) if quick else (SCENES, REPEATS)


def write(results: Results, out: Path) -> None:
    """Writes the report, and the estimates as JSON beside it."""
    paper_sections.document(results).write(out)
    estimates = {name: _estimates(one) for name, one in results.evaluations.items()}
    timings = {
        "about": runtime.about(threads=1, repeats=_runtime_size(results.quick)[1]),
        "sets": [asdict(one) for one in results.timings],
    }
    for name, content in {"estimates": estimates, "runtime": timings}.items():
        text = json.dumps(content, allow_nan=False) + "\n"
        write_atomically(out / f"{name}.json", text.encode())


def _estimates(of: Evaluation) -> dict[str, Any]:
    """What is committed of an evaluation: its fingerprint, and each estimate as [value, low, high].

    Steps of the horizon and groups of agents are in the figures, and whole in the work folder.
    """

    def short(scores: Scores) -> dict[str, list[float]]:
        return {
            name: [float(f"{bound:.4g}") for bound in (one.value, one.low, one.high)]
            for name, one in scores.metrics.items()
        }

    return {
        "fingerprint": asdict(of.fingerprint),
        "rows": {
            row.name: {
                **{one.test_set: short(one.scores) for one in row.sets},
                "mean": short(row.mean),
                "models": {one.test_set: one.model_sha256 for one in row.sets},
            }
            for row in of.rows
        },
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures what is asked for, and writes the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, help="default: TRAJECTRON_DATA")
    parser.add_argument("--sets", default=",".join(TEST_SETS))
    parser.add_argument("--recording", action="append", default=[], help="instead of --sets")
    parser.add_argument("--model", default=registry.DEFAULT, help="judged on --recording")
    parser.add_argument("--models", default=",".join(BASELINES), help="that stand beside ours")
    parser.add_argument("--quick", action="store_true", help="few windows and samples")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="evaluations, without a report")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="in the paper's figures")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path(".paper"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/paper"))
    found = parser.parse_args(arguments)
    options = Options(
        sets=() if found.recording else tuple(found.sets.split(",")),
        files=tuple(found.recording),
        model=found.model,
        entries=tuple(name for name in found.models.split(",") if name),
        data=found.data,
        work=found.work,
        out=found.out,
        quick=found.quick,
        samples=found.samples,
        seed=found.seed,
    )
    options.work.mkdir(parents=True, exist_ok=True)
    if found.only is not None:
        known = plans(options)
        if unknown := [name for name in found.only if name not in known]:
            parser.error(f"no evaluation {unknown[0]!r}: there are {', '.join(known)}")
        for name in found.only:
            carry_out(options, name, available(known[name], _recordings(options), {}))
        return
    results = measure(options)
    write(results, options.out)
    for entry, why in results.missing.items():
        print(f"missing: {entry}: {why}")
    print(options.out / "report.html")


if __name__ == "__main__":
    os.nice(10)
    main()
