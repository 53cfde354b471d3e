"""From the forecast of a window to what each of its judged agents scored.

Shape letters: S samples, A judged agents, H horizon steps, Z modes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trajectron_model.data.windows import Window
from trajectron_model.evaluation import densities, metrics
from trajectron_model.evaluation.scores import AgentScores, Float
from trajectron_model.predictor import DensityPredictor, Predictor, WindowForecast

BEST_OF = (1, 5, 20, 100)
"""The N of best-of-N; those that there are no samples for are left out."""

BEST_AT_EACH_STEP = 20
"""The N of best-of-N with the best chosen at every horizon step for itself."""

PAIRED_SAMPLES = 100
"""At most so many samples go into metrics of pairs (energy, collisions) and into the kernel
estimates whose regions are measured: their cost grows with the square."""

ERROR_SLICES = 20
"""What is kept of the distribution of each agent's sample errors: the means of so many slices."""


@dataclass(frozen=True)
class Judgement:
    """How forecasts are judged.

    Attributes:
        samples: drawn for each agent that count in best-of-N and metrics of pairs.
        kde_samples: those in kernel density estimates; fewer than two for none.
        seed: of the samples and of draws from forecast densities.
        independent: whether samples are. Where they are not, as with stratified ones, some of
            them are not what asking for fewer gives: best of all that were drawn is the only
            best-of-N there is.
    """

    samples: int
    kde_samples: int
    seed: int
    independent: bool = True

    @property
    def drawn(self) -> int:
        """How many futures are drawn for each agent."""
        return max(self.samples, self.kde_samples)

    @property
    def best_of(self) -> tuple[int, ...]:
        """The N that there are samples for."""
        return tuple(n for n in BEST_OF if self.holds(n))

    def holds(self, n: int) -> bool:
        """Whether the samples give a best of ``n``."""
        return n <= self.samples if self.independent else n == self.samples == self.drawn


def judge(
    predictor: Predictor, windows: Sequence[Window], how: Judgement, *, first: int = 0
) -> AgentScores:
    """What every judged agent of some windows scored; all forecasts are held at once.

    Args:
        predictor: makes the forecasts.
        windows: at least one.
        how: see the class.
        first: index of the first window among those of its set.
    """
    forecasts = predictor.predict(windows, num_samples=how.drawn, seed=how.seed)
    for window, forecast in zip(windows, forecasts, strict=True):
        _check(predictor, window, forecast, how)
    exact: Sequence[Float | None] = [None] * len(windows)
    if isinstance(predictor, DensityPredictor):
        exact = predictor.log_prob(windows)
    return AgentScores.concatenate(
        [
            _scores(index, window, forecast, log_prob, how)
            for index, (window, forecast, log_prob) in enumerate(
                zip(windows, forecasts, exact, strict=True), start=first
            )
        ]
    )


def _scores(
    index: int, window: Window, forecast: WindowForecast, log_prob: Float | None, how: Judgement
) -> AgentScores:
    truth = window.future()
    distance = metrics.displacement(forecast.samples, truth)  # [S, A, H]
    columns = _point_columns(forecast, truth)
    columns |= _sample_columns(distance[: how.samples], window.in_best_of, how)
    columns |= _density_columns(window, forecast, truth, how)
    paired = forecast.samples[: min(how.samples, PAIRED_SAMPLES)]
    if how.independent:
        columns["energy"] = metrics.energy_score(paired, truth)
    columns["collision"] = metrics.collision_share(paired, window.history()[:, -1])
    if log_prob is not None:
        columns["nll_exact"] = -log_prob
    return AgentScores(
        window=np.full(len(truth), index),
        agent=np.array(window.ids, dtype=np.str_),
        type=np.array(window.types, dtype=np.str_),
        observations=window.observations(),
        columns=columns,
        sample_errors=_sample_errors(distance),
    )


def _check(predictor: Predictor, window: Window, forecast: WindowForecast, how: Judgement) -> None:
    """Raises ValueError for a forecast that would be averaged without a word."""
    shape = (how.drawn, len(window.judged), window.horizon, 2)
    if forecast.samples.shape != shape:
        raise ValueError(f"{predictor.name} gave samples of shape {forecast.samples.shape}")
    positions = (forecast.samples, forecast.mode_mean, forecast.mean)
    if not all(np.isfinite(one).all() for one in positions):
        raise ValueError(
            f"{predictor.name} forecast positions that are not finite from step {window.now} of "
            f"{window.recording.name}"
        )


def _sample_errors(distance: Float) -> dict[str, Float]:
    """See `AgentScores.sample_errors`: of all judged agents and of every sample drawn."""
    return {
        "ade": metrics.sorted_slices(metrics.average_displacement(distance), ERROR_SLICES),
        "fde": metrics.sorted_slices(metrics.final_displacement(distance), ERROR_SLICES),
    }


def _point_columns(forecast: WindowForecast, truth: Float) -> dict[str, Float]:
    columns = {}
    for form, point in (("mode", forecast.mode_mean), ("mean", forecast.mean)):
        distance = metrics.displacement(point, truth)  # [A, H]
        columns[f"ade_{form}"] = metrics.average_displacement(distance)
        columns[f"fde_{form}"] = metrics.final_displacement(distance)
        columns[f"distance_{form}"] = distance
    return columns


def _sample_columns(
    distance: Float,
    counts: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] | None,
    how: Judgement,
) -> dict[str, Float]:
    """Errors of a sample on average, and best-of-N; the latter NaN for agents left out of it.

    Args:
        distance: [S, A, H] of the samples from the truth.
        counts: [A] who counts in best-of-N; None for all.
        how: see `Judgement`.
    """
    total = distance.shape[1]
    errors = {
        "ade": metrics.average_displacement(distance),
        "fde": metrics.final_displacement(distance),
    }  # [S, A]
    means = {f"{name}_sample": error.mean(axis=0) for name, error in errors.items()}
    agents = np.arange(total) if counts is None else np.flatnonzero(counts)
    errors = {name: error[:, agents] for name, error in errors.items()}  # [S, A']
    distance = distance[:, agents]
    columns = {}
    for n in how.best_of:
        for name, error in errors.items():
            columns[f"min_{name}_{n}"] = metrics.best_of(error, n)
            columns[f"joint_{name}_{n}"] = metrics.joint_best_of(error, n)
        columns[f"miss_{n}"] = metrics.miss_rate(errors["fde"], n)
    if how.holds(BEST_AT_EACH_STEP):
        flat = distance.reshape(len(distance), -1)  # [S, A' H]
        best = metrics.best_of(flat, BEST_AT_EACH_STEP)
        columns[f"min_distance_{BEST_AT_EACH_STEP}"] = best.reshape(distance.shape[1:])
    return means | {name: _spread(column, agents, total) for name, column in columns.items()}


def _spread(
    column: Float, agents: np.ndarray[tuple[int, ...], np.dtype[np.int64]], total: int
) -> Float:
    """[A', ...] values of some agents as [A, ...] of all, NaN for the others."""
    if len(agents) == total:
        return column
    every = np.full((total, *column.shape[1:]), np.nan)
    every[agents] = column
    return every


def _density_columns(
    window: Window, forecast: WindowForecast, truth: Float, how: Judgement
) -> dict[str, Float]:
    """Per step: densities at the truth, and highest-density regions against it."""
    columns: dict[str, Float] = {}
    mixture = forecast.mixture
    random = _generator(window, how.seed)
    if how.kde_samples > 1:
        kde = densities.kde_log_density(forecast.samples[: how.kde_samples], truth)
        columns["nll_kde"] = -kde
    if mixture is not None:
        columns["nll_mixture"] = -densities.mixture_log_density(mixture, truth)
        distance = metrics.displacement(mixture.mean.transpose(1, 0, 2, 3), truth)  # [Z, A, H]
        columns["brier_fde"] = metrics.brier_final_displacement(mixture.probability, distance)
        regions = densities.highest_density_regions(mixture, truth, random)
    elif how.drawn > 1:
        regions = densities.kde_regions(forecast.samples[:PAIRED_SAMPLES], truth, random)
    else:
        return columns
    for level, covered, area in zip(densities.LEVELS, *regions, strict=True):
        columns[f"coverage_{100 * level:g}"] = covered
        columns[f"area_{100 * level:g}"] = area
    return columns


def _generator(window: Window, seed: int) -> np.random.Generator:
    """Draws that depend on the window alone, not on those beside it."""
    key = f"{seed}/{window.recording.name}/{window.first}/{window.now}/regions".encode()
    return np.random.default_rng(int.from_bytes(hashlib.sha256(key).digest()[:16], "big"))
