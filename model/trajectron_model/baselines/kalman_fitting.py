"""The Kalman filter's noise levels, fitted to recordings by likelihood.

Shape letters: A agents, T observed steps, H horizon steps.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from trajectron_model.baselines import saving
from trajectron_model.baselines.kalman import (
    START,
    Float,
    LevelsModule,
    NoiseLevels,
    foretell,
    log_density,
    observe,
    recent_history,
)
from trajectron_model.baselines.training import CHECKPOINT_NAME, thin, training_windows
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window

_LEAST = 1e-3
_AGENTS = 400
"""Of each recording, about: recordings weigh the same, whatever their crowds."""


def mean_log_density(windows: Sequence[Window], levels: NoiseLevels) -> float:
    """Mean log density, nats, of the true position at each foretold step of each judged agent.

    Given the observed positions alone: what the forecast's Gaussians are judged by.
    """
    history, future = _tracks(windows)
    return _mean_log_density(history, future, windows[0].recording.dt_s, levels)


def fit(windows: Sequence[Window]) -> NoiseLevels:
    """The noise levels with the highest `mean_log_density`.

    Every second agent is filtered from its newest observation on, as if just come: nothing else
    tells how fast those walk of whom no velocity is known.

    Args:
        windows: all of as many steps and one dt, with whole futures.
    """
    history, future = _tracks(windows)
    history[::2, :-1] = np.nan
    dt_s = windows[0].recording.dt_s

    def loss(logarithms: Float) -> float:
        return -_mean_log_density(history, future, dt_s, _levels(logarithms))

    start: Float = np.log(np.array(START))
    found = minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-5})
    return _levels(found.x)


def train(
    name: str,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    folder: Path,
    *,
    provenance: dict[str, Any],
) -> Path:
    """Fits the levels to training data and leaves them in ``folder``.

    Args:
        name: the baseline's.
        training: what is fitted to.
        validation: what the levels are then judged on; nothing is chosen by it.
        folder: gets ``baseline.safetensors`` and ``baseline.json``.
        provenance: task, licence note...; recordings, levels and figures are added.

    Returns:
        The files' path without suffix.

    Raises:
        ValueError: no window to fit to, or to judge on.
    """
    began_s = time.process_time()
    levels = fit(_thinned(training))
    figure = mean_log_density(_thinned(validation), levels)
    facts = {
        **provenance,
        "training": {"recordings": [r.provenance for r in training]},
        "validation": {"recordings": [r.provenance for r in validation]},
        "settings": {"levels": levels._asdict()},
        "selected": {"validation_figures": {"log_density": figure}},
        "cpu_minutes": round((time.process_time() - began_s) / 60.0, 2),
        "outcome": "converged",
    }
    folder.mkdir(parents=True, exist_ok=True)
    saving.save(folder / CHECKPOINT_NAME, name, LevelsModule(levels), facts)
    return folder / CHECKPOINT_NAME


def _thinned(recordings: Sequence[Recording]) -> list[Window]:
    found = [training_windows(recording) for recording in recordings]
    windows = [window for each in found if each for window in thin(each, _AGENTS)]
    if not windows:
        raise ValueError("the recordings have no window with two agents throughout")
    return windows


def _tracks(windows: Sequence[Window]) -> tuple[Float, Float]:
    """[A, T, 2] observed and [A, H, 2] true future positions, metres."""
    history = np.concatenate([recent_history(window) for window in windows])
    return history, np.concatenate([window.future() for window in windows])


def _mean_log_density(history: Float, future: Float, dt_s: float, levels: NoiseLevels) -> float:
    ahead = foretell(observe(history, dt_s, levels), future.shape[1], dt_s, levels)
    difference = future - ahead.mean[:, :, 0]
    return float(log_density(difference, ahead.covariance[:, :, 0, 0]).mean())


def _levels(logarithms: Float) -> NoiseLevels:
    # Splines can be taken for exact; beliefs have to stay positive definite all the same.
    return NoiseLevels(*np.exp(logarithms).clip(min=_LEAST).tolist())
