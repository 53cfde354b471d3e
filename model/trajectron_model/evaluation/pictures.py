"""The figures that an evaluation gives, each a `Picture`; None where there is nothing to show."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from trajectron_model.evaluation import figures
from trajectron_model.evaluation.document import Picture
from trajectron_model.evaluation.exhibits import (
    LEVELS,
    MEAN,
    POOLED,
    coverage_metric,
    estimate_of,
    group_names,
    group_of,
    has_spread,
    scores_on,
    set_title,
    title_of,
)
from trajectron_model.evaluation.figures import Box, Curve, Point, Style
from trajectron_model.evaluation.results import Estimate, Evaluation, GroupScores, Row, Scores
from trajectron_model.evaluation.scores import AgentScores

AllScores = Mapping[tuple[str, str], AgentScores]
"""The agents' scores by entry and set."""

# Groups that follow one another, and their labels on an axis.
_OBSERVATIONS = {"1": "1", "2": "2", "3": "3", "at least 4": "≥4", "at least 8": "≥8"}


def points_by_set(
    evaluation: Evaluation,
    metric: str,
    style: Mapping[str, Style],
    *,
    name: str,
    label: str,
    caption: str,
    spread: bool = False,
) -> Picture | None:
    """A metric's estimates with their intervals, entries side by side on every set.

    Args:
        spread: whether entries with a single trajectory are left out.
    """
    rows = _rows(evaluation, spread)
    groups: dict[str, dict[str, Point]] = {}
    for panel, scores_of in _panels(evaluation).items():
        found = {title_of(row.name): estimate_of(scores_of(row), metric) for row in rows}
        groups[panel] = {entry: _point(one) for entry, one in found.items() if one is not None}
    if not any(groups.values()):
        return None
    return _picture(name, caption, figures.svg(figures.points(groups, style, label)))


def curves_by_step(
    evaluation: Evaluation,
    metric: str,
    style: Mapping[str, Style],
    *,
    name: str,
    label: str,
    caption: str,
    zero: bool = True,
    spread: bool = False,
) -> Picture | None:
    """A metric over the seconds ahead, with 95% bands, one panel a set.

    Args:
        zero: whether the vertical axis begins at zero.
        spread: whether entries with a single trajectory are left out.
    """
    dt_s = evaluation.fingerprint.dt_s
    panels: dict[str, dict[str, Curve]] = {}
    for panel, scores_of in _panels(evaluation).items():
        panels[panel] = {}
        for row in _rows(evaluation, spread):
            scores = scores_of(row)
            if scores is not None and metric in scores.by_step:
                panels[panel][title_of(row.name)] = _curve(scores.by_step[metric], dt_s)
    if not any(panels.values()):
        return None
    figure = figures.curves(panels, style, label=label, below="seconds ahead", zero=zero)
    return _picture(name, caption, figures.svg(figure))


def coverage_by_step(
    evaluation: Evaluation, style: Mapping[str, Style], *, name: str, caption: str
) -> Picture | None:
    """Observed coverage over the seconds ahead, mean of the sets, one panel a nominal level."""
    dt_s = evaluation.fingerprint.dt_s
    panels: dict[str, dict[str, Curve]] = {}
    references = {}
    for level in LEVELS:
        metric, title = coverage_metric(level), f"{100 * level:g}% regions"
        panels[title] = {
            title_of(row.name): _curve(row.mean.by_step[metric], dt_s, factor=100.0)
            for row in _rows(evaluation, spread=True)
            if metric in row.mean.by_step
        }
        references[title] = (100.0 * level,)
    if not any(panels.values()):
        return None
    figure = figures.curves(
        panels,
        style,
        label="observed coverage, %",
        below="seconds ahead",
        references=references,
    )
    return _picture(name, caption, figures.svg(figure))


def calibration(evaluation: Evaluation, *, name: str, caption: str) -> Picture | None:
    """Observed over nominal coverage, one panel an entry, one line a set."""
    panels: dict[str, dict[str, dict[float, Point]]] = {}
    sets = _panels(evaluation)
    for row in _rows(evaluation, spread=True):
        found = {}
        for panel, scores_of in sets.items():
            estimates = {
                level: estimate_of(scores_of(row), coverage_metric(level)) for level in LEVELS
            }
            points = {level: _point(one) for level, one in estimates.items() if one is not None}
            if points:
                found[panel] = points
        if found:
            panels[title_of(row.name)] = found
    if not panels:
        return None
    figure = figures.calibration(panels, figures.styles(sets))
    return _picture(name, caption, figures.svg(figure))


def curves_by_observations(
    evaluation: Evaluation,
    metric: str,
    style: Mapping[str, Style],
    *,
    name: str,
    label: str,
    caption: str,
) -> Picture | None:
    """A metric over the number of observations seen, one panel a set."""
    names = [one for one in group_names(evaluation, "observations") if one in _OBSERVATIONS]
    panels: dict[str, dict[str, Curve]] = {}
    for panel, groups_of in _group_panels(evaluation).items():
        panels[panel] = {}
        for row in evaluation.rows:
            groups = groups_of(row)
            found = [estimate_of(group_of(groups, "observations", one), metric) for one in names]
            if any(one is not None for one in found):
                panels[panel][title_of(row.name)] = _estimates_curve(range(len(names)), found)
    if not any(panels.values()):
        return None
    figure = figures.curves(
        panels,
        style,
        label=label,
        below="steps seen",
        ticks=list(range(len(names))),
        tick_labels=[_OBSERVATIONS[one] for one in names],
    )
    return _picture(name, caption, figures.svg(figure))


def boxplots(
    evaluation: Evaluation,
    scores: AllScores,
    column: str,
    style: Mapping[str, Style],
    *,
    name: str,
    label: str,
    caption: str,
) -> Picture | None:
    """The distribution of an error over judged agents and their samples, as the paper draws it.

    Entries that forecast a single trajectory are lines at their mean, the others boxes. In the
    last panel every agent of all sets weighs the same.

    Args:
        column: a key of `AgentScores.sample_errors`.
    """
    boxes: dict[str, dict[str, Box]] = {}
    lines: dict[str, dict[str, float]] = {}
    sets = [one.test_set for one in evaluation.fingerprint.sets]
    panels = {set_title(one): [one] for one in sets}
    if len(sets) > 1:
        panels[POOLED] = sets
    for panel, members in panels.items():
        boxes[panel], lines[panel] = {}, {}
        for row in evaluation.rows:
            found = [scores.get((row.name, one)) for one in members]
            errors = [one.sample_errors[column] for one in found
                      if one is not None and column in one.sample_errors]  # fmt: skip
            if len(errors) < len(members):
                continue
            values = np.concatenate(errors).astype(np.float64)  # [A, Q]
            values = values[~np.isnan(values).any(axis=1)]
            if not len(values):
                continue
            if np.ptp(values, axis=1).max() == 0.0:
                lines[panel][title_of(row.name)] = float(values.mean())
            else:
                boxes[panel][title_of(row.name)] = _box(values)
    if not any(boxes.values()) and not any(lines.values()):
        return None
    return _picture(name, caption, figures.svg(figures.boxplots(boxes, lines, style, label)))


def _box(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Box:
    low, first, median, third, high = np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95]).tolist()
    return Box(low, first, median, third, high, float(values.mean()))


def _rows(evaluation: Evaluation, spread: bool) -> list[Row]:
    return [row for row in evaluation.rows if has_spread(row) or not spread]


def _panels(evaluation: Evaluation) -> dict[str, Callable[[Row], Scores | None]]:
    """Each set's scores of a row, and their mean where there are several."""
    panels = {
        set_title(one.test_set): scores_on(index)
        for index, one in enumerate(evaluation.fingerprint.sets)
    }
    if len(panels) > 1:
        panels[MEAN] = lambda row: row.mean
    return panels


def _group_panels(
    evaluation: Evaluation,
) -> dict[str, Callable[[Row], Sequence[GroupScores]]]:
    def on(index: int) -> Callable[[Row], Sequence[GroupScores]]:
        return lambda row: row.sets[index].groups

    panels = {
        set_title(one.test_set): on(index) for index, one in enumerate(evaluation.fingerprint.sets)
    }
    if len(panels) > 1:
        panels[MEAN] = lambda row: row.groups
    return panels


def _point(estimate: Estimate) -> Point:
    return Point(estimate.value, estimate.low, estimate.high)


def _curve(steps: Sequence[Estimate | None], dt_s: float, factor: float = 1.0) -> Curve:
    return _estimates_curve([(step + 1) * dt_s for step in range(len(steps))], steps, factor)


def _estimates_curve(
    x: Sequence[float], estimates: Sequence[Estimate | None], factor: float = 1.0
) -> Curve:
    missing = (np.nan, np.nan, np.nan)
    found = np.array(
        [missing if one is None else (one.value, one.low, one.high) for one in estimates]
    )
    return Curve(np.asarray(x, dtype=np.float64), *(factor * found.T))


def _picture(name: str, caption: str, svg: str) -> Picture:
    return Picture(name, caption, svg.encode())
