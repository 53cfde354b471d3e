"""The section on noise: accuracy and coverage under jitter of what is observed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from trajectron_model.evaluation import exhibits, figures
from trajectron_model.evaluation.document import Picture, Section, Table
from trajectron_model.evaluation.exhibits import Metric
from trajectron_model.evaluation.figures import Curve, Style
from trajectron_model.evaluation.results import Evaluation

_NOISE = (
    "Gaussian noise on every observed coordinate of the protocol sgan, on every k-th window (the "
    "facts above count them); the truth stays clean. The "
    "recordings are smooth splines, real trackers are not. A recording is jittered once: windows "
    "that overlap see the same noise."
)
_TEN_HERTZ = (
    "At 10 Hz a session that was told the interval keeps four interleaved chains of states, each "
    "stepped every 0.4 s, and a forecast starts from the newest frame's chain. Where the noise is "
    "independent from frame to frame, such a chain sees what is judged here: these figures are "
    "those of 10 Hz as well."
)
_SHOWN = {
    "ADE, mean over all modes, m": Metric("ade_mean", "ADE"),
    "FDE, mean over all modes, m": Metric("fde_mean", "FDE"),
    "ADE, best of 20, m": Metric("min_ade_20", "best of 20, ADE"),
    "Coverage of 80% regions, %": Metric("coverage_80", "80% coverage", 1, 100.0, 0.8),
}


def by_jitter(evaluations: Mapping[str, Evaluation]) -> dict[float, Evaluation]:
    """Those of the jitter that was tried, 0 among them, by centimetres."""
    return {
        100 * one.fingerprint.plan.jitter_m: one
        for name, one in evaluations.items()
        if name.startswith("jitter")
    }


def section(evaluations: Mapping[str, Evaluation], style: Mapping[str, Style]) -> Section:
    """The section; see the module.

    Args:
        evaluations: of the report, by name.
        style: of every entry.
    """
    jittered = by_jitter(evaluations)
    tables, panels, references = [], {}, {}
    for title, metric in _SHOWN.items():
        table = _table(jittered, metric, f"{title}: mean over sets, by jitter")
        if table is None:
            continue
        tables.append(table)
        panels[title] = _curves(jittered, metric)
        if metric.target is not None:
            references[title] = (metric.factor * metric.target,)
    if not tables:
        return Section("Noise")
    drawn = figures.curves(
        panels,
        style,
        label="",
        below="jitter, cm",
        ticks=list(jittered),
        shared=False,
        references=references,
    )
    picture = Picture(
        "noise",
        "Errors and coverage by jitter, mean over sets, with 95% bands; dashed is nominal.",
        figures.svg(drawn).encode(),
    )
    return Section("Noise", (_NOISE, _TEN_HERTZ), (picture, *tables))


def _table(jittered: Mapping[float, Evaluation], metric: Metric, caption: str) -> Table | None:
    """Entries by jitter: the columns of several evaluations side by side."""
    columns: list[tuple[str, Table]] = []
    for jitter_cm, of in jittered.items():
        one = exhibits.by_metric(of, [metric], caption)
        if one is None:
            return None
        columns.append((f"{jitter_cm:g} cm", one))
    names = [row[0] for row in columns[0][1].rows]
    if any([row[0] for row in table.rows] != names for _, table in columns):
        raise ValueError("the evaluations under jitter have different entries")
    rows = tuple(
        (name, *(table.rows[place][1] for _, table in columns)) for place, name in enumerate(names)
    )
    return Table(caption, ("", *(title for title, _ in columns)), rows, "", columns[0][1].muted)


def _curves(jittered: Mapping[float, Evaluation], metric: Metric) -> dict[str, Curve]:
    found: dict[str, list[tuple[float, float, float, float]]] = {}
    for jitter_cm, of in jittered.items():
        for row in of.rows:
            one = row.mean.metrics.get(metric.name)
            if one is not None and (metric.target is None or exhibits.has_spread(row)):
                value, low, high = (metric.factor * v for v in (one.value, one.low, one.high))
                found.setdefault(exhibits.title_of(row.name), []).append(
                    (jitter_cm, value, low, high)
                )
    return {name: Curve(*np.array(points).T) for name, points in found.items()}
