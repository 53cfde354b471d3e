"""The tables that an evaluation gives, and how entries, sets and metrics are called in them.

Each takes an evaluation and gives a `Table`, or None where the evaluation has nothing to show of
it. Entries in sample, fenced ones, and stratified samples are shown and never ranked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from trajectron_model.evaluation import figures
from trajectron_model.evaluation.document import Cell, Figure, Table, cell, clean
from trajectron_model.evaluation.figures import Style
from trajectron_model.evaluation.results import (
    IN_SAMPLE_MARK,
    Estimate,
    Evaluation,
    GroupScores,
    Row,
    Scores,
)

MEAN = "mean"
POOLED = "all agents"
LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Of the regions whose coverage is shown."""

_SETS = {"eth": "ETH", "hotel": "Hotel", "univ": "Univ", "zara1": "Zara1", "zara2": "Zara2"}
_ENTRIES = {
    "leave-one-out": "Trajectron",
    "constant-velocity": "constant velocity",
    "constant-velocity-noise": "constant velocity + noise",
    "kalman": "Kalman filter",
    "linear": "Linear",
    "lstm": "LSTM",
    "social-lstm": "Social LSTM",
    "social-attention": "Social Attention",
    "sgan": "Social GAN",
    "paper-leaky": "paper-leaky",
}
_FENCED = "paper-leaky"
_STRATIFIED = "@stratified"
_LONGEST_NAME = 48


class Metric(NamedTuple):
    """How a metric is shown.

    Attributes:
        name: as in `Scores.metrics`.
        title: of its column.
        places: behind the decimal point.
        factor: from the metric's unit to the one shown.
        target: the perfect value where it is neither low nor high, in the metric's unit.
        ranked: whether less (or nearer to the target) is better by itself.
    """

    name: str
    title: str
    places: int = 3
    factor: float = 1.0
    target: float | None = None
    ranked: bool = True

    def worse(self, value: float) -> float:
        """What grows as the metric gets worse."""
        return value if self.target is None else abs(value - self.target)


def title_of(entry: str) -> str:
    """How a report calls an entry; what follows an @ is a variant of it."""
    family, _, variant = entry.partition("@")
    if family not in _ENTRIES:
        return _short(entry)
    return f"{_ENTRIES[family]}, {_short(variant)}" if variant else _ENTRIES[family]


def set_title(test_set: str) -> str:
    """How a report calls a set."""
    return _SETS.get(test_set, _short(test_set))


def _short(name: str) -> str:
    """A name that fits a column, whatever its file was called."""
    name = " ".join(clean(name).split())
    return name if len(name) <= _LONGEST_NAME else name[: _LONGEST_NAME - 1] + "…"


def has_spread(row: Row) -> bool:
    """Whether an entry forecasts more than a single trajectory."""
    area = row.mean.metrics.get("area_95")
    return area is not None and area.value > 0.0


def fenced(row: Row) -> bool:
    """Whether a row has its inputs from the future: shown with a warning, never ranked."""
    return row.name.startswith(_FENCED)


def ranked(row: Row) -> bool:
    """Whether a row may be the best of a column: an honest one, of independent samples."""
    return not (row.in_sample or fenced(row) or row.name.endswith(_STRATIFIED))


def entry_styles(evaluations: Iterable[Evaluation]) -> dict[str, Style]:
    """One style for each entry, by the title that reports give it."""
    return figures.styles(
        title_of(row.name) for evaluation in evaluations for row in evaluation.rows
    )


def by_set(
    evaluation: Evaluation, metrics: Sequence[Metric], caption: str, note: str = ""
) -> Table | None:
    """Entries by sets, with the mean over sets; several metrics share a cell.

    Args:
        evaluation: any.
        metrics: shown in one cell with strokes between; those that no entry has give None.
        caption, note: of the table.
    """
    rows = [row for row in evaluation.rows if any(one.name in row.mean.metrics for one in metrics)]
    if not rows:
        return None
    columns: dict[str, Callable[[Row], Scores | None]] = {}
    for index, fingerprint in enumerate(evaluation.fingerprint.sets):
        columns[set_title(fingerprint.test_set)] = scores_on(index)
    if len(columns) > 1:
        columns[MEAN] = lambda row: row.mean
        columns[POOLED] = lambda row: row.pooled
    return _table(rows, columns, lambda _: metrics, caption, note)


def by_metric(
    evaluation: Evaluation, metrics: Sequence[Metric], caption: str, note: str = ""
) -> Table | None:
    """Entries by metrics, each the mean over sets; metrics that no entry has are left out."""
    shown = {
        one.title: one
        for one in metrics
        if any(one.name in row.mean.metrics for row in evaluation.rows)
    }
    if not shown:
        return None
    rows = [row for row in evaluation.rows if any(m.name in row.mean.metrics for m in metrics)]
    columns: dict[str, Callable[[Row], Scores | None]] = dict.fromkeys(shown, lambda row: row.mean)
    return _table(rows, columns, lambda title: [shown[title]], caption, note)


def by_group(
    evaluation: Evaluation, by: str, metrics: Sequence[Metric], caption: str, note: str = ""
) -> Table | None:
    """Entries by groups of agents (types, observations seen), each the mean over sets."""
    names = group_names(evaluation, by)
    if not names:
        return None
    columns = {name: _scores_of_group(by, name) for name in names}
    return _table(evaluation.rows, columns, lambda _: metrics, caption, note)


def scores_on(index: int) -> Callable[[Row], Scores | None]:
    """A row's scores on the set of this index."""
    return lambda row: row.sets[index].scores


def _scores_of_group(by: str, group: str) -> Callable[[Row], Scores | None]:
    def find(row: Row) -> Scores | None:
        return group_of(row.groups, by, group)

    return find


def group_of(groups: Sequence[GroupScores], by: str, group: str) -> Scores | None:
    """The scores of one group; None where it has no agents."""
    return next((one.scores for one in groups if (one.by, one.group) == (by, group)), None)


def group_names(evaluation: Evaluation, by: str) -> list[str]:
    """The names of groups, in the order of the first entry that has them."""
    return list(dict.fromkeys(one.group for row in evaluation.rows for one in row.groups
                              if one.by == by))  # fmt: skip


def _table(
    rows: Sequence[Row],
    columns: Mapping[str, Callable[[Row], Scores | None]],
    metrics_of: Callable[[str], Sequence[Metric]],
    caption: str,
    note: str,
) -> Table:
    muted = frozenset(index for index, row in enumerate(rows) if not ranked(row))
    compared = [row for row in rows if ranked(row)]
    cells: list[list[Cell]] = [[cell(row_title(row))] for row in rows]
    for title, scores_of in columns.items():
        metrics = metrics_of(title)
        best = {
            metric.name: _best(
                [estimate_of(scores_of(row), metric.name) for row in compared], metric
            )
            for metric in metrics
        }
        for line, row in zip(cells, rows, strict=True):
            scores = scores_of(row)
            line.append(
                tuple(
                    _figure(
                        estimate_of(scores, metric.name),
                        metric,
                        best[metric.name] if ranked(row) else None,
                    )
                    for metric in metrics
                )
            )
    return Table(
        caption,
        ("", *columns),
        tuple(tuple(line) for line in cells),
        note,
        muted,
    )


def row_title(row: Row) -> str:
    """An entry's title, with its mark where it is in sample."""
    return title_of(row.name) + IN_SAMPLE_MARK * row.in_sample


def estimate_of(scores: Scores | None, metric: str) -> Estimate | None:
    """A metric's estimate; None where it is not defined."""
    return None if scores is None else scores.metrics.get(metric)


def _best(estimates: Sequence[Estimate | None], metric: Metric) -> float | None:
    """How bad the best is, to the places shown; None where there is nothing to choose from."""
    found = [_shown(one.value, metric) for one in estimates if one is not None]
    return min(found) if metric.ranked and len(found) > 1 else None


def _shown(value: float, metric: Metric) -> float:
    """How bad a value is, as far as its figures show: ties are all best."""
    return round(metric.worse(value) * metric.factor, metric.places)


def _figure(estimate: Estimate | None, metric: Metric, best: float | None) -> Figure:
    if estimate is None:
        return Figure("–")
    value, low, high = (
        f"{bound * metric.factor:.{metric.places}f}"
        for bound in (estimate.value, estimate.low, estimate.high)
    )
    return Figure(
        value.replace("-", "\N{MINUS SIGN}"),
        f"{low} to {high}".replace("-", "\N{MINUS SIGN}"),
        best is not None and _shown(estimate.value, metric) == best,
    )


def coverage_metric(level: float) -> str:
    """The metric's name: the share of truths in the regions of this probability."""
    return f"coverage_{100 * level:g}"


def t_tests(
    evaluation: Evaluation, metric: str, title: str, *, reference: str, places: int = 3
) -> Table | None:
    """Paired t-tests of every entry against one, on each set and on the windows of all.

    Args:
        metric: compared, as in `Comparison.metric`.
        title: of the metric, with its unit.
        reference: the entry that the others are set against.
        places: of the differences.
    """
    columns = [one.test_set for one in evaluation.fingerprint.sets]
    if len(columns) > 1:
        columns.append("")
    found: dict[tuple[str, str], Cell] = {}
    for one in evaluation.comparisons:
        if one.metric != metric or reference not in (one.first, one.second):
            continue
        other, sign = (one.second, 1.0) if one.first == reference else (one.first, -1.0)
        difference = f"{sign * one.difference:+.{places}f}".replace("-", "\N{MINUS SIGN}")
        found[other, one.test_set] = (
            Figure(
                difference,
                f"p {_probability(one.p)}",
                best=one.p < 0.05 and sign * one.difference < 0.0,
            ),
        )
    others = [row for row in evaluation.rows if any(key[0] == row.name for key in found)]
    if not others:
        return None
    return Table(
        f"{title}: {title_of(reference)} less the other; negative is in its favour",
        ("", *(set_title(one) or "all windows" for one in columns)),
        tuple(
            (cell(row_title(row)), *(found.get((row.name, one), cell("–")) for one in columns))
            for row in others
        ),
        "Two-tailed, paired over windows. Marked: in its favour with p below 0.05.",
        frozenset(index for index, row in enumerate(others) if not ranked(row)),
    )


def _probability(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"= {p:.3f}"
