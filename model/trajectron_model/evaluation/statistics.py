"""From agents' scores to estimates: means, bootstrap intervals over windows, paired t-tests.

Agents of one window see the same scene, so windows are what is resampled and paired, with all
of their agents. Windows overlap (stride 1 under ``sgan``), so neighbouring ones are not
independent either: intervals and p-values are optimistic, and equally so for all entries.

Shape letters: A agents, W windows, B resamplings, C columns (a metric, or one of its steps).
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from trajectron_model.evaluation.metrics import mean_over_known
from trajectron_model.evaluation.results import Estimate, Scores
from trajectron_model.evaluation.scores import AgentScores, Float

_INTERVAL = (2.5, 97.5)


@dataclass(frozen=True)
class Column:
    """What a column of a `Sample` is: a metric over all steps, or at one of them."""

    metric: str
    step: int | None


@dataclass(frozen=True, eq=False)
class Values:
    """The scores of a set's agents as a table.

    Attributes:
        columns: what its columns are.
        table: [A, C] NaN where a metric is not defined.
        window: [A] rising index of each agent's window.
        windows: W, in the set.
    """

    columns: tuple[Column, ...]
    table: Float
    window: NDArray[np.int64]
    windows: int

    @classmethod
    def of(cls, scores: AgentScores, windows: int) -> Values:
        """All metrics: their means over steps, and each step.

        Args:
            scores: of the set's agents.
            windows: W, in the set.
        """
        columns: list[Column] = []
        parts: list[Float] = []
        for metric, values in sorted(scores.columns.items()):
            columns.append(Column(metric, None))
            if values.ndim == 1:
                parts.append(values[:, None])
                continue
            columns += [Column(metric, step) for step in range(values.shape[1])]
            parts += [mean_over_known(values)[:, None], values]
        return cls(tuple(columns), np.concatenate(parts, axis=1), scores.window, windows)

    def only(self, agents: NDArray[np.bool_], steps_of: Collection[str]) -> Values:
        """Some agents [A]; horizon steps of these metrics only."""
        kept = [n for n, c in enumerate(self.columns) if c.step is None or c.metric in steps_of]
        columns = tuple(self.columns[n] for n in kept)
        return Values(columns, self.table[agents][:, kept], self.window[agents], self.windows)


@dataclass(frozen=True, eq=False)
class Sample:
    """The mean of every column over a group of agents, and its resamplings.

    Attributes:
        columns: what they are.
        total, count: [1 + B, C] sums over agents and how many there are; row 0 of the agents
            as they are, the others of resampled windows.
    """

    columns: tuple[Column, ...]
    total: Float
    count: Float

    @classmethod
    def of(cls, values: Values, resamplings: Float) -> Sample:
        """The sample of a table.

        Args:
            values: of at least one agent.
            resamplings: [B, W] how often each window is drawn; see `resample`.
        """
        known = ~np.isnan(values.table)
        weights = np.concatenate([np.ones((1, values.windows)), resamplings])  # [1 + B, W]
        # Agents stand window by window, so every window that has any is a run of rows.
        window, first = np.unique(values.window, return_index=True)
        weights = weights[:, window]
        total = np.add.reduceat(np.where(known, values.table, 0.0), first)  # [W', C]
        count = np.add.reduceat(known.astype(np.float64), first)
        return cls(values.columns, weights @ total, weights @ count)

    def scores(self) -> Scores:
        """Its means with their intervals."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return _scores(self.columns, self.total / self.count, self.count[0])


def pooled(samples: Sequence[Sample]) -> Scores:
    """The scores of all agents of several sets, each agent weighing the same."""
    columns = _common(samples)
    picked = [_pick(sample, columns) for sample in samples]
    total = np.sum([sample.total for sample in picked], axis=0)
    count = np.sum([sample.count for sample in picked], axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return _scores(columns, total / count, _agents(picked))


def mean_of_sets(samples: Sequence[Sample]) -> Scores:
    """The mean of several sets' means, each set weighing the same."""
    columns = _common(samples)
    picked = [_pick(sample, columns) for sample in samples]
    with np.errstate(invalid="ignore", divide="ignore"):
        each = np.stack([sample.total / sample.count for sample in picked])  # [sets, 1 + B, C]
    # A resampling that has nobody of a set's group says nothing of that set.
    means = mean_over_known(each, axis=0)
    return _scores(columns, means, _agents(picked))


def resample(windows: int, times: int, seed: int, name: str) -> Float:
    """How often each window is drawn in each of ``times`` draws with replacement: [B, W].

    The same for every entry, so that what entries share cancels between them.

    Args:
        windows: W.
        times: B.
        seed: of the draws, together with ``name``.
        name: of the set.
    """
    key = hashlib.sha256(f"{seed}/{name}/bootstrap".encode()).digest()
    random = np.random.default_rng(int.from_bytes(key[:16], "big"))
    drawn: NDArray[np.int64] = random.multinomial(windows, np.full(windows, 1 / windows), times)
    return drawn.astype(np.float64)


def window_means(scores: AgentScores, metric: str, windows: int) -> Float:
    """[W] the mean of a metric over each window's agents; NaN where it is defined for nobody."""
    column = scores.columns[metric]
    values = mean_over_known(column) if column.ndim == 2 else column
    known = ~np.isnan(values)
    total = np.bincount(scores.window, np.where(known, values, 0.0), windows)
    count = np.bincount(scores.window, known, windows)
    means: Float = np.divide(total, count, out=np.full(windows, np.nan), where=count > 0)
    return means


@dataclass(frozen=True)
class PairedTest:
    """See `results.Comparison`."""

    pairs: int
    difference: float
    t: float
    p: float


def paired_t_test(first: Float, second: Float) -> PairedTest | None:
    """A two-tailed paired t-test; pairs with NaN are left out.

    Args:
        first, second: [W] means of the same windows under two entries.

    Returns:
        None where fewer than two pairs are left or all differences are equal, so that there is
        no spread to measure against.
    """
    difference = first - second
    difference = difference[~np.isnan(difference)]
    if len(difference) < 2 or np.ptp(difference) == 0.0:
        return None
    test = stats.ttest_1samp(difference, 0.0)
    return PairedTest(
        len(difference),
        _rounded(difference.mean()),
        _rounded(float(test.statistic)),
        _rounded(float(test.pvalue)),
    )


def _common(samples: Sequence[Sample]) -> tuple[Column, ...]:
    """The columns that all samples have."""
    return tuple(c for c in samples[0].columns if all(c in one.columns for one in samples))


def _agents(samples: Sequence[Sample]) -> Float:
    """[C] how many agents a column is defined for; 0 where it is for nobody in some sample."""
    each = np.stack([sample.count[0] for sample in samples])  # [sets, C]
    return np.where(each.all(axis=0), each.sum(axis=0), 0.0)


def _pick(sample: Sample, columns: Sequence[Column]) -> Sample:
    place = {column: index for index, column in enumerate(sample.columns)}
    index = [place[column] for column in columns]
    return Sample(tuple(columns), sample.total[:, index], sample.count[:, index])


def _scores(columns: Sequence[Column], means: Float, count: Float) -> Scores:
    """Estimates from means [1 + B, C] and counts of agents [C], 0 for no estimate."""
    defined = np.flatnonzero(count)
    resampled = means[1:, defined]
    # A resampling can miss everyone whom a metric is defined for: it says nothing then.
    percentile = np.nanpercentile if np.isnan(resampled).any() else np.percentile
    low, high = percentile(resampled, _INTERVAL, axis=0)
    found = {
        columns[index]: Estimate(
            _rounded(means[0, index]), _rounded(low[n]), _rounded(high[n]), int(count[index])
        )
        for n, index in enumerate(defined.tolist())
    }
    metrics = {c.metric: estimate for c, estimate in found.items() if c.step is None}
    steps: dict[str, list[Estimate | None]] = {}
    for column in columns:
        if column.step is not None and column.metric in metrics:
            steps.setdefault(column.metric, []).append(found.get(column))
    return Scores(metrics, {name: tuple(each) for name, each in steps.items() if any(each)})


def _rounded(value: float) -> float:
    """Six significant digits: what is beyond them is noise, and makes files long."""
    return float(f"{value:.6g}")
