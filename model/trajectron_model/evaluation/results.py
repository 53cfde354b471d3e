"""The result of an evaluation: plain values, to and from JSON.

A metric's name says what it is and its unit follows from it; `metrics` in the documentation
(docs/evaluation.md) lists them. Figures are kept to six significant digits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from trajectron_model.evaluation.plan import EvaluationPlan

IN_SAMPLE_MARK = " (in sample)"


@dataclass(frozen=True)
class Estimate:
    """A mean over judged agents, with its 95% bootstrap interval over windows.

    Attributes:
        value: the mean.
        low, high: bounds of the interval.
        agents: how many agents it is a mean over: those for whom the metric is defined.
    """

    value: float
    low: float
    high: float
    agents: int


@dataclass(frozen=True)
class Scores:
    """The estimates of one group of agents.

    Attributes:
        metrics: by the metric's name; metrics that are defined for nobody are left out, and
            over several sets those that are for nobody of some set.
        by_step: the metrics that have a value for every horizon step, [H] each; a step at
            which nobody's truth is known, or nobody's of some set, has None.
    """

    metrics: Mapping[str, Estimate]
    by_step: Mapping[str, tuple[Estimate | None, ...]]


@dataclass(frozen=True)
class GroupScores:
    """The scores of some of a set's agents.

    Attributes:
        by: what groups them: ``type`` or ``observations``.
        group: which of them: ``pedestrian``; ``1``, ``at least 4``.
    """

    by: str
    group: str
    scores: Scores


@dataclass(frozen=True)
class SetScores:
    """One row's scores on one test set.

    Attributes:
        test_set: its name.
        model: the name of the predictor that was judged.
        model_sha256: of its file; empty for a baseline without one.
        in_sample: whether it was trained or selected on a recording of this set.
        regions_of: what the coverage metrics are of: ``mixture``, the predictor's own; ``kde``
            of its samples.
        scores: of all judged agents.
        groups: of some of them.
    """

    test_set: str
    model: str
    model_sha256: str
    in_sample: bool
    regions_of: str
    scores: Scores
    groups: tuple[GroupScores, ...]


@dataclass(frozen=True)
class Row:
    """One entry's scores.

    Attributes:
        name: of the entry.
        in_sample: whether it is in sample on any set.
        sets: on each set.
        mean: each set weighing the same.
        pooled: each judged agent of all sets weighing the same.
        groups: of some agents, each set that has any weighing the same.
    """

    name: str
    in_sample: bool
    sets: tuple[SetScores, ...]
    mean: Scores
    pooled: Scores
    groups: tuple[GroupScores, ...]


@dataclass(frozen=True)
class Comparison:
    """A two-tailed paired t-test of two entries over the means of the same windows.

    Attributes:
        first, second: the entries.
        metric: compared.
        test_set: the windows' set; empty for the windows of all sets.
        windows: how many pairs.
        difference: mean of first less second.
        t: statistic, with ``windows - 1`` degrees of freedom.
        p: probability of a larger absolute statistic if their means were equal.
    """

    first: str
    second: str
    metric: str
    test_set: str
    windows: int
    difference: float
    t: float
    p: float


@dataclass(frozen=True)
class SetFingerprint:
    """What was judged of one test set.

    Attributes:
        test_set: its name.
        recordings: its recordings' names.
        data_sha256: of their contents: names, types, times and positions.
        windows_sha256: of the windows: recording, steps, judged agents.
        windows, agents: counts of windows, and of judged agents over all windows.
        agents_in_best_of: those that best-of-N is over.
    """

    test_set: str
    recordings: tuple[str, ...]
    data_sha256: str
    windows_sha256: str
    windows: int
    agents: int
    agents_in_best_of: int


@dataclass(frozen=True)
class Fingerprint:
    """All that another evaluation must share to be comparable; models are named in the rows.

    Attributes:
        plan: protocol, samples, seed and the rest.
        dt_s: seconds between two steps.
        horizon: steps foretold.
        selection: which windows were picked: ``all``, or ``every 5th``.
        kde_samples: positions a step in kernel density estimates.
        sets: what was judged of each set.
    """

    plan: EvaluationPlan
    dt_s: float
    horizon: int
    selection: str
    kde_samples: int
    sets: tuple[SetFingerprint, ...]


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation."""

    fingerprint: Fingerprint
    rows: tuple[Row, ...]
    comparisons: tuple[Comparison, ...]

    def to_json(self) -> dict[str, Any]:
        """As plain values for ``json.dumps``; the inverse of `from_json`."""
        values = asdict(self)
        values["fingerprint"]["plan"] = self.fingerprint.plan.to_json()
        return values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Evaluation:
        """Reads `to_json`'s values.

        Raises:
            ValueError: they are no evaluation.
        """
        try:
            return cls(
                _fingerprint(values["fingerprint"]),
                tuple(_row(row) for row in values["rows"]),
                tuple(Comparison(**one) for one in values["comparisons"]),
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"not the JSON of an evaluation: {error!r}") from error

    def to_csv(self) -> str:
        """As CSV, one estimate a line; see `tables.to_csv`."""
        from trajectron_model.evaluation import tables  # noqa: PLC0415 (it needs this module)

        return tables.to_csv(self)

    def to_markdown(self) -> str:
        """As a Markdown table; see `tables.to_markdown`."""
        from trajectron_model.evaluation import tables  # noqa: PLC0415 (it needs this module)

        return tables.to_markdown(self)


def _fingerprint(values: Mapping[str, Any]) -> Fingerprint:
    sets = tuple(
        SetFingerprint(**{**one, "recordings": tuple(one["recordings"])}) for one in values["sets"]
    )
    plan = EvaluationPlan.from_json(values["plan"])
    return Fingerprint(**{**values, "plan": plan, "sets": sets})


def _row(values: Mapping[str, Any]) -> Row:
    return Row(
        name=values["name"],
        in_sample=values["in_sample"],
        sets=tuple(
            SetScores(**{**one, "scores": _scores(one["scores"]), "groups": _groups(one["groups"])})
            for one in values["sets"]
        ),
        mean=_scores(values["mean"]),
        pooled=_scores(values["pooled"]),
        groups=_groups(values["groups"]),
    )


def _scores(values: Mapping[str, Any]) -> Scores:
    return Scores(
        {name: Estimate(**one) for name, one in values["metrics"].items()},
        {
            name: tuple(None if one is None else Estimate(**one) for one in steps)
            for name, steps in values["by_step"].items()
        },
    )


def _groups(values: Sequence[Mapping[str, Any]]) -> tuple[GroupScores, ...]:
    return tuple(GroupScores(one["by"], one["group"], _scores(one["scores"])) for one in values)
