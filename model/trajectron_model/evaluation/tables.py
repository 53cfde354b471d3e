"""An evaluation as tables: Markdown to be read, CSV to be worked with."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence

from trajectron_model.evaluation.results import (
    IN_SAMPLE_MARK,
    Estimate,
    Evaluation,
    Fingerprint,
    Row,
    Scores,
)

_BEST_OF = (5, 20, 100)
_LEVELS = (50, 80, 90, 95)

_LEAKING = "paper-leaky"
_LEAKING_MARK = " (inputs contain the future)"

_Line = tuple[str, Callable[[Scores], str]]


def heading(fingerprint: Fingerprint) -> str:
    """What was done, in one line."""
    plan = fingerprint.plan
    parts = [
        f"Protocol {plan.protocol}: {fingerprint.horizon} steps of {fingerprint.dt_s:g} s foretold",
        f"{plan.samples} samples, independent unless a row says stratified, seed {plan.seed}",
        f"{fingerprint.kde_samples} in kernel density estimates",
    ]
    if fingerprint.selection != "all":
        parts.append(f"windows: {fingerprint.selection}")
    if plan.jitter_m:
        parts.append(f"observed positions jittered by {100 * plan.jitter_m:g} cm")
    return "; ".join([*parts, "the mean weighs the sets alike."])


def to_markdown(evaluation: Evaluation) -> str:
    """Rows of models by metric, columns of sets."""
    sets = evaluation.fingerprint.sets
    header = ["model", "metric", *(one.test_set for one in sets), "mean"]
    counts = [_counts(one.windows, one.agents, one.agents_in_best_of) for one in sets]
    table = [header, ["", "windows / judged agents", *counts, ""]]
    for row in evaluation.rows:
        name = row.name + IN_SAMPLE_MARK * row.in_sample
        name += _LEAKING_MARK * row.name.startswith(_LEAKING)
        for label, cells in _lines(row):
            table.append([name, label, *cells])
            name = ""
    return _markdown(table)


def to_csv(evaluation: Evaluation) -> str:
    """One estimate a line: entry, set, group, metric, step, value, interval, agents.

    The set is ``mean`` for the mean of sets and ``pooled`` for all agents alike; a step counts
    from 1 and is empty for the figure over all steps; a group is ``observations=1`` or empty.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["entry", "set", "group", "metric", "step", "value", "low", "high", "agents"])
    for row in evaluation.rows:
        for name, group, scores in _parts(row):
            for metric, step, estimate in _estimates(scores):
                figures = (estimate.value, estimate.low, estimate.high, estimate.agents)
                writer.writerow([row.name, name, group, metric, step, *figures])
    return stream.getvalue()


def _parts(row: Row) -> Iterator[tuple[str, str, Scores]]:
    """Every set's scores and its groups', then those over sets."""
    for one in row.sets:
        yield one.test_set, "", one.scores
        for part in one.groups:
            yield one.test_set, f"{part.by}={part.group}", part.scores
    yield "mean", "", row.mean
    for part in row.groups:
        yield "mean", f"{part.by}={part.group}", part.scores
    yield "pooled", "", row.pooled


def _estimates(scores: Scores) -> Iterator[tuple[str, str, Estimate]]:
    for metric, estimate in scores.metrics.items():
        yield metric, "", estimate
    for metric, steps in scores.by_step.items():
        for step, each in enumerate(steps, start=1):
            if each is not None:
                yield metric, f"{step}", each


def _counts(windows: int, agents: int, in_best_of: int) -> str:
    counts = f"{windows} / {agents}"
    return counts if in_best_of == agents else f"{counts} (best of N: {in_best_of})"


def _lines(row: Row) -> list[tuple[str, list[str]]]:
    """A row's lines: what the figures are called, and the figures of each set and their mean."""
    columns = [*(one.scores for one in row.sets), row.mean]

    def lines(figures: Sequence[_Line]) -> list[tuple[str, list[str]]]:
        shown = [(label, [show(scores) for scores in columns]) for label, show in figures]
        return [(label, cells) for label, cells in shown if any(cells)]

    errors, best = lines(_ERRORS), lines(_BEST)
    if all(cells == errors[0][1] for _, cells in errors):
        # A predictor without spread: every error is that of its one trajectory.
        errors = [("ADE/FDE, one trajectory", errors[0][1])]
        if all(cells == best[0][1] for _, cells in best):
            # Under ``paper`` best-of-N is over fewer agents, so it is another figure.
            same = not best or best[0][1] == errors[0][1]
            best = [] if same else [("ADE/FDE, best of any N", best[0][1])]
    return [*errors, *best, *lines(_OTHERS)]


def _pair(ade: str, fde: str) -> Callable[[Scores], str]:
    def show(scores: Scores) -> str:
        if ade not in scores.metrics or fde not in scores.metrics:
            return ""
        return f"{scores.metrics[ade].value:.3f}/{scores.metrics[fde].value:.3f}"

    return show


def _several(metrics: Sequence[str], form: str, factor: float = 1.0) -> Callable[[Scores], str]:
    def show(scores: Scores) -> str:
        if any(metric not in scores.metrics for metric in metrics):
            return ""
        return "/".join(format(factor * scores.metrics[m].value, form) for m in metrics)

    return show


_ERRORS: list[_Line] = [
    ("ADE/FDE, most probable mode", _pair("ade_mode", "fde_mode")),
    ("ADE/FDE, mean of all modes", _pair("ade_mean", "fde_mean")),
    ("ADE/FDE, one sample", _pair("ade_sample", "fde_sample")),
]
_BEST: list[_Line] = [
    (f"ADE/FDE, best of {n}, per {form}", _pair(f"{name}_ade_{n}", f"{name}_fde_{n}"))
    for n in _BEST_OF
    for form, name in (("agent", "min"), ("scene", "joint"))
]
_OTHERS: list[_Line] = [
    ("missed by 2 m, one / best of 20, %", _several(("miss_1", "miss_20"), ".1f", 100.0)),
    ("brier-minFDE of 5 modes", _several(("brier_fde",), ".3f")),
    ("energy score, m", _several(("energy",), ".3f")),
    ("NLL of the trajectory, exact", _several(("nll_exact",), ".2f")),
    ("NLL a step, mixture", _several(("nll_mixture",), ".2f")),
    ("NLL a step, KDE", _several(("nll_kde",), ".2f")),
    (
        "covered by 50/80/90/95% regions, %",
        _several([f"coverage_{level}" for level in _LEVELS], ".0f", 100.0),
    ),
    ("area of the 80% region, m²", _several(("area_80",), ".2f")),
    ("colliding pairs of samples, %", _several(("collision",), ".2f", 100.0)),
]


def _markdown(table: Sequence[Sequence[str]]) -> str:
    """Cells as a Markdown table whose columns are aligned in plain text too."""
    widths = [max(len(cell) for cell in column) for column in zip(*table, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in table
    ]
    rule = "| " + " | ".join("-" * width for width in widths) + " |"
    return "\n".join([lines[0], rule, *lines[1:]])
