"""The result of an evaluation: plain values, as JSON and as a Markdown table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean

from trajectron_model.data.windows import Protocol

IN_SAMPLE_MARK = " (in sample)"


@dataclass(frozen=True)
class Displacement:
    """Average and final displacement error, metres."""

    ade_m: float
    fde_m: float

    def __str__(self) -> str:
        return f"{self.ade_m:.3f}/{self.fde_m:.3f}"

    @classmethod
    def mean(cls, parts: Iterable[Displacement]) -> Displacement:
        """The mean of several, each weighing the same."""
        parts = tuple(parts)
        return cls(fmean(part.ade_m for part in parts), fmean(part.fde_m for part in parts))


@dataclass(frozen=True)
class BestOf:
    """Best-of-n of independent samples; see `metrics.best_of` and `metrics.joint_best_of`."""

    n: int
    per_agent: Displacement
    joint: Displacement


@dataclass(frozen=True)
class Scores:
    """The metrics of one row on one set, or their mean over sets.

    Attributes:
        mode_mean: of the point forecast that is the mean of the most probable mode.
        mean: of the point forecast that is the mean over all modes.
        best_of: for each N, ascending.
    """

    mode_mean: Displacement
    mean: Displacement
    best_of: tuple[BestOf, ...]

    @classmethod
    def over_sets(cls, sets: Sequence[Scores]) -> Scores:
        """The mean over sets, each weighing the same."""
        return cls(
            mode_mean=Displacement.mean(one.mode_mean for one in sets),
            mean=Displacement.mean(one.mean for one in sets),
            best_of=tuple(
                BestOf(
                    same_n[0].n,
                    Displacement.mean(one.per_agent for one in same_n),
                    Displacement.mean(one.joint for one in same_n),
                )
                for same_n in zip(*(one.best_of for one in sets), strict=True)
            ),
        )


@dataclass(frozen=True)
class SetScores:
    """One row's scores on one test set.

    Attributes:
        test_set: its name.
        model: the name of the predictor that was judged.
        model_sha256: of its file; empty for a baseline.
        in_sample: whether it was trained or selected on a recording of this set.
    """

    test_set: str
    model: str
    model_sha256: str
    in_sample: bool
    scores: Scores


@dataclass(frozen=True)
class Row:
    """One entry's scores on every set, and their mean, each set weighing the same."""

    name: str
    in_sample: bool
    sets: tuple[SetScores, ...]
    mean: Scores


@dataclass(frozen=True)
class SetFingerprint:
    """What was judged of one test set.

    Attributes:
        test_set: its name.
        recordings: its recordings' names.
        data_sha256: of their contents: names, types, times and positions.
        windows_sha256: of the windows: recording, first step, judged agents.
        windows, agents: counts of windows, and of judged agents over all windows.
    """

    test_set: str
    recordings: tuple[str, ...]
    data_sha256: str
    windows_sha256: str
    windows: int
    agents: int


@dataclass(frozen=True)
class Fingerprint:
    """All that another evaluation must share to be comparable; models are named in the rows.

    Attributes:
        protocol: how windows are cut.
        dt_s: seconds between two steps.
        samples: drawn for each agent of each window, independent of one another.
        seed: of the samples.
        selection: what was picked from windows or samples before judging: ``none``.
        sets: what was judged of each set.
    """

    protocol: Protocol
    dt_s: float
    samples: int
    seed: int
    selection: str
    sets: tuple[SetFingerprint, ...]


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation."""

    fingerprint: Fingerprint
    rows: tuple[Row, ...]

    def to_json(self) -> dict[str, object]:
        """As plain values for ``json.dumps``; errors in metres."""
        return asdict(self)

    def to_markdown(self) -> str:
        """As a Markdown table: rows of models by metric, columns of sets, ADE/FDE in metres."""
        sets = self.fingerprint.sets
        header = ["model", "ADE/FDE in metres", *(one.test_set for one in sets), "mean"]
        counts = [f"{one.windows} / {one.agents}" for one in sets]
        table = [header, ["", "windows / judged agents", *counts, ""]]
        for row in self.rows:
            columns = [_metrics(scores) for scores in (*(one.scores for one in row.sets), row.mean)]
            name = row.name + IN_SAMPLE_MARK * row.in_sample
            lines = list(zip(*columns, strict=True))
            if len({tuple(str(error) for _, error in line) for line in lines}) == 1:
                # A predictor without spread: every metric is that of its one trajectory.
                lines = [tuple(("one trajectory", error) for _, error in lines[0])]
            for line in lines:
                label = line[0][0]
                table.append([name, label, *(str(error) for _, error in line)])
                name = ""
        return _markdown(table)


def _metrics(scores: Scores) -> list[tuple[str, Displacement]]:
    """The lines of one column: what each figure is called, and the figure."""
    lines = [("most probable mode", scores.mode_mean), ("mean of all modes", scores.mean)]
    for best_of in scores.best_of:
        if best_of.n == 1:  # then the two forms are one
            lines.append(("one sample", best_of.per_agent))
            continue
        lines.append((f"best of {best_of.n}, per agent", best_of.per_agent))
        lines.append((f"best of {best_of.n}, per scene", best_of.joint))
    return lines


def _markdown(table: Sequence[Sequence[str]]) -> str:
    """Cells as a Markdown table whose columns are aligned in plain text too."""
    widths = [max(len(cell) for cell in column) for column in zip(*table, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in table
    ]
    rule = "| " + " | ".join("-" * width for width in widths) + " |"
    return "\n".join([lines[0], rule, *lines[1:]])
