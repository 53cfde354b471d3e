"""Calibration of the analytic modes' spread on validation data; see `dispersion.disperse`.

Coverage is what is fitted: how often the truth lies in the regions that hold 50, 80, 90 and
95% of the mixture, by the same functions that evaluation uses. Every step has a factor and a
contrast of its own. Recordings weigh the same.

Shape letters: A agents, Z latent values, H horizon steps, L levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from trajectron_model.config import Dispersion, ModelConfig
from trajectron_model.data.windows import Window
from trajectron_model.dispersion import disperse
from trajectron_model.evaluation.densities import LEVELS, highest_density_regions
from trajectron_model.predictor import PositionMixture, TrajectronPredictor
from trajectron_model.trajectron import Trajectron

_CONTRASTS = (0.0, 0.5, 1.0, 1.5, 2.0)
_HALVINGS = 7
_WIDEST = 4.0
_MIN_AGENTS = 50
_SEED = 20191027
_LEVELS = np.array(LEVELS)


@dataclass(frozen=True)
class Judged:
    """What is known of the agents of one type in one recording."""

    mixture: PositionMixture
    truth: NDArray[np.float64]  # [A, H, 2]


def calibrated(model: Trajectron, recordings: Sequence[Sequence[Window]]) -> ModelConfig:
    """The model's configuration with the dispersion that validation data ask for.

    Args:
        model: as trained; what dispersion it has is fitted anew.
        recordings: windows of each validation recording; their futures are complete.

    Returns:
        The configuration; a type with fewer than 50 judged agents keeps no dispersion.
    """
    bare = tuple(replace(kind, dispersion=()) for kind in model.config.types)
    fitted = replace(model.config, types=bare)
    before, model.config = model.config, fitted
    try:
        predictor = TrajectronPredictor(model, "in calibration")
        found = [_judge(predictor, windows) for windows in recordings if windows]
    finally:
        model.config = before
    kinds = []
    for kind in bare:
        parts = [part[kind.name] for part in found if kind.name in part]
        enough = sum(len(part.truth) for part in parts) >= _MIN_AGENTS
        kinds.append(replace(kind, dispersion=fit(parts)) if enough else kind)
    return replace(fitted, types=tuple(kinds))


def coverage(recordings: Sequence[Judged], dispersion: Sequence[Dispersion]) -> NDArray[np.float64]:
    """Share of agents in each region at each step: [L, H], recordings weighing the same."""
    random = np.random.default_rng(_SEED)
    shares = []
    for judged in recordings:
        probability = torch.from_numpy(judged.mixture.probability)
        covariance = disperse(torch.from_numpy(judged.mixture.covariance), probability, dispersion)
        mixture = replace(judged.mixture, covariance=covariance.numpy())
        regions = highest_density_regions(mixture, judged.truth, random)
        shares.append(regions.covered.mean(axis=1))  # [L, H]
    mean: NDArray[np.float64] = np.mean(shares, axis=0)
    return mean


def _judge(predictor: TrajectronPredictor, windows: Sequence[Window]) -> dict[str, Judged]:
    """The mixtures of every judged agent and its true future, by type."""
    forecasts = predictor.predict(windows, num_samples=1, seed=_SEED)
    mixtures = [forecast.mixture for forecast in forecasts if forecast.mixture is not None]
    columns = [
        np.concatenate([getattr(mixture, name) for mixture in mixtures])
        for name in ("probability", "mean", "covariance")
    ]
    truth = np.concatenate([window.future() for window in windows])
    kinds = np.array([kind for window in windows for kind in window.types])
    return {
        name: Judged(PositionMixture(*(c[kinds == name] for c in columns)), truth[kinds == name])
        for name in sorted(set(kinds.tolist()))
    }


def fit(recordings: Sequence[Judged]) -> tuple[Dispersion, ...]:
    """For each step the factor and contrast whose coverage comes nearest to all levels."""
    horizon = recordings[0].truth.shape[1]
    factors, errors = [], []
    for contrast in _CONTRASTS:
        low = np.full(horizon, -np.log(_WIDEST))
        high = -low
        for _ in range(_HALVINGS):  # the mean coverage over levels rises with the factor
            middle = 0.5 * (low + high)
            share = coverage(recordings, _steps(middle, contrast))
            over = (share - _LEVELS[:, None]).mean(axis=0) > 0.0
            low, high = np.where(over, low, middle), np.where(over, middle, high)
        middle = 0.5 * (low + high)
        share = coverage(recordings, _steps(middle, contrast))
        factors.append(np.exp(middle))
        errors.append(np.abs(share - _LEVELS[:, None]).mean(axis=0))
    best = np.argmin(errors, axis=0)  # [H]
    return tuple(
        Dispersion(round(float(factors[choice][step]), 4), _CONTRASTS[choice])
        for step, choice in enumerate(best.tolist())
    )


def _steps(log_factor: NDArray[np.float64], contrast: float) -> list[Dispersion]:
    return [Dispersion(float(np.exp(value)), contrast) for value in log_factor]
