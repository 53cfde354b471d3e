"""Carrying out a plan: the one path behind the command line, the service and the report.

The work is cut into shards (an entry on a run of a set's windows). What a shard's agents scored
is written to the folder before the next begins, so a run that was killed goes on where it was;
where shards are cut follows from the plan alone, so the figures do not depend on it.

    FOLDER/plan.json        what is carried out there
    FOLDER/shards/*.npz     scores, by what they are of
    FOLDER/result.json      the evaluation, once it is complete
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from trajectron_model.checkpoint import write_atomically
from trajectron_model.data.windows import batches
from trajectron_model.evaluation import contenders, sets, summary
from trajectron_model.evaluation.contenders import Contender
from trajectron_model.evaluation.judging import Judgement, judge
from trajectron_model.evaluation.plan import EvaluationPlan, PlanError
from trajectron_model.evaluation.results import Evaluation, Fingerprint
from trajectron_model.evaluation.scores import AgentScores
from trajectron_model.evaluation.sets import TestSet

RESULT = "result.json"

_PLAN = "plan.json"
_SHARDS = "shards"
_TRAJECTORIES = 100_000
"""Drawn in a shard: some seconds of work, and 20 MB of doubles at 12 steps."""

_VERSION = 2
"""Of the scores: a change to what is measured makes old shards useless."""


class Cancelled(Exception):
    """The run was asked to stop; what it has done stays in its folder."""


class Progress(NamedTuple):
    """How far a run is."""

    share: float  # of the work, 0 to 1
    windows_done: int  # over all entries
    windows_total: int
    entry: str  # at work now
    set: str
    seconds_left: float | None  # None while nothing is known of the speed


@dataclass(frozen=True)
class _Shard:
    """A run of one set's windows under one entry."""

    entry: str
    contender: Contender
    test_set: TestSet
    first: int
    last: int
    file: Path

    @property
    def windows(self) -> int:
        return self.last - self.first

    @property
    def agents(self) -> int:
        return sum(len(w.judged) for w in self.test_set.windows[self.first : self.last])


def run(
    plan: EvaluationPlan,
    folder: Path,
    *,
    data: Path | None = None,
    progress: Callable[[Progress], object] = lambda _: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Evaluation:
    """Carries out a plan, from where an earlier run of the same plan in the folder stopped.

    Args:
        plan: what to evaluate.
        folder: where the work is kept; made where there is none.
        data: the ETH/UCY folder; None for the environment's ``TRAJECTRON_DATA``.
        progress: called before the first shard and after every one.
        cancelled: asked between shards.

    Raises:
        PlanError: a plan that cannot be carried out, or a folder with another plan's work.
        ContenderError, CheckpointError: an entry that stands for nothing.
        InSampleError: a model would be judged in sample and the plan does not ask for it.
        DataError: a recording that is missing or damaged.
        Cancelled: ``cancelled`` turned true.
    """
    _claim(plan, folder)
    test_sets = sets.load(plan, data)
    shards = _shards(plan, folder, test_sets)
    clock = _Clock(shards)
    progress(clock.progress(shards[0]))
    for shard in shards:
        if cancelled():
            raise Cancelled("the evaluation was cancelled")
        if not shard.file.exists():
            begin = time.monotonic()
            scores = judge(
                shard.contender.predictor,
                shard.test_set.windows[shard.first : shard.last],
                _judgement(plan, shard.contender),
                first=shard.first,
            )
            write_atomically(shard.file, scores.to_bytes())
            clock.worked(shard, time.monotonic() - begin)
        clock.done(shard)
        progress(clock.progress(shard))
    evaluation = _evaluation(plan, test_sets, shards)
    content = json.dumps(evaluation.to_json(), allow_nan=False) + "\n"
    write_atomically(folder / RESULT, content.encode())
    return evaluation


def load(folder: Path) -> Evaluation:
    """The evaluation that a run left in its folder.

    Raises:
        ValueError: the run there is not complete, or what it left is damaged.
    """
    file = folder / RESULT
    if not file.is_file():
        raise ValueError(f"{folder} has no {RESULT}: no evaluation was completed there")
    return Evaluation.from_json(json.loads(file.read_text(encoding="utf-8")))


def load_scores(
    plan: EvaluationPlan, folder: Path, *, data: Path | None = None
) -> dict[tuple[str, str], AgentScores]:
    """What each judged agent scored, by (entry, set), after a complete run.

    Raises:
        ValueError: a shard is missing: the run there is not complete.
    """
    shards = _shards(plan, folder, sets.load(plan, data))
    missing = [shard for shard in shards if not shard.file.exists()]
    if missing:
        raise ValueError(f"{folder}: {len(missing)} of {len(shards)} shards are missing")
    return _gather(shards)


def _claim(plan: EvaluationPlan, folder: Path) -> None:
    """Makes the folder the plan's own."""
    (folder / _SHARDS).mkdir(parents=True, exist_ok=True)
    file = folder / _PLAN
    if file.exists():
        found = EvaluationPlan.from_json(json.loads(file.read_text(encoding="utf-8")))
        if found != plan:
            raise PlanError(f"{folder} holds the work of another plan; choose another folder")
        return
    write_atomically(file, (json.dumps(plan.to_json(), indent=1) + "\n").encode())


def _judgement(plan: EvaluationPlan, contender: Contender) -> Judgement:
    return Judgement(plan.samples, plan.samples_in_kde, plan.seed, contender.independent)


def _shards(plan: EvaluationPlan, folder: Path, test_sets: Sequence[TestSet]) -> list[_Shard]:
    """The work, set by set, so that the speed of every entry is known early."""
    shards = []
    most = max(1, _TRAJECTORIES // plan.samples_drawn)
    for test_set in test_sets:
        data = sets.fingerprint(test_set)
        for entry in plan.entries:
            contender = contenders.resolve(entry, test_set.name, test_set.recordings)
            if not plan.in_sample:
                contender.refuse_in_sample(test_set.name, test_set.recordings)
            # What is in a shard's name is all that its scores depend on.
            how = _judgement(plan, contender)
            of = (_VERSION, contender.predictor.name, contender.sha256, how, data)
            key = hashlib.sha256(repr((of, plan.jitter_m, _TRAJECTORIES)).encode()).hexdigest()
            first = 0
            for batch in batches(test_set.windows, most):
                last = first + len(batch)
                file = folder / _SHARDS / f"{key[:16]}-{first:06d}.npz"
                shards.append(_Shard(entry, contender, test_set, first, last, file))
                first = last
    return shards


def _gather(shards: Sequence[_Shard]) -> dict[tuple[str, str], AgentScores]:
    found: dict[tuple[str, str], list[AgentScores]] = {}
    for shard in shards:
        scores = AgentScores.load(shard.file)
        found.setdefault((shard.entry, shard.test_set.name), []).append(scores)
    return {of: AgentScores.concatenate(parts) for of, parts in found.items()}


def _evaluation(
    plan: EvaluationPlan, test_sets: Sequence[TestSet], shards: Sequence[_Shard]
) -> Evaluation:
    window = test_sets[0].windows[0]
    fingerprint = Fingerprint(
        plan,
        window.recording.dt_s,
        window.horizon,
        _selection(test_sets),
        plan.samples_in_kde,
        tuple(sets.fingerprint(test_set) for test_set in test_sets),
    )
    judged = {(s.entry, s.test_set.name): s.contender for s in shards}
    return summary.evaluation(fingerprint, test_sets, judged, _gather(shards))


def _selection(test_sets: Sequence[TestSet]) -> str:
    """Which windows were picked: ``all``, ``every 2nd``, ``every 2nd of eth, ...``."""
    if all(one.every_nth == 1 for one in test_sets):
        return "all"
    named = [(_ordinal(one.every_nth), one.name) for one in test_sets]
    if len({which for which, _ in named}) == 1:
        return f"every {named[0][0]}"
    return ", ".join(
        f"every {which} of {name}".replace("every 1st", "all") for which, name in named
    )


def _ordinal(number: int) -> str:
    suffix = {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{'th' if number % 100 in (11, 12, 13) else suffix}"


class _Clock:
    """Counts the work done, and foretells the rest from the speed of each entry."""

    def __init__(self, shards: Sequence[_Shard]) -> None:
        self._windows = sum(shard.windows for shard in shards)
        self._agents = sum(shard.agents for shard in shards)
        self._left: dict[str, int] = {}
        for shard in shards:
            self._left[shard.entry] = self._left.get(shard.entry, 0) + shard.agents
        self._windows_done = 0
        self._seconds: dict[str, float] = {}
        self._worked: dict[str, int] = {}

    def worked(self, shard: _Shard, seconds: float) -> None:
        """Notes how long a shard took."""
        self._seconds[shard.entry] = self._seconds.get(shard.entry, 0.0) + seconds
        self._worked[shard.entry] = self._worked.get(shard.entry, 0) + shard.agents

    def done(self, shard: _Shard) -> None:
        """Notes that a shard's scores are there."""
        self._windows_done += shard.windows
        self._left[shard.entry] -= shard.agents

    def progress(self, shard: _Shard) -> Progress:
        """How far the run is."""
        return Progress(
            1.0 - sum(self._left.values()) / self._agents,
            self._windows_done,
            self._windows,
            shard.entry,
            shard.test_set.name,
            self._seconds_left(),
        )

    def _seconds_left(self) -> float | None:
        """An entry that has not begun is taken to be as fast as the others are on average."""
        if not self._worked:
            return None
        usual = sum(self._seconds.values()) / sum(self._worked.values())
        left = 0.0
        for entry, agents in self._left.items():
            known = entry in self._worked
            pace = self._seconds[entry] / self._worked[entry] if known else usual
            left += agents * pace
        return left
