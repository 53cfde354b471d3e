"""Figures on validation data, by the same predictor and metrics that evaluation uses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from trajectron_model.config import ModelConfig
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, sgan_windows
from trajectron_model.evaluation import metrics
from trajectron_model.predictor import TrajectronPredictor
from trajectron_model.training.examples import Examples, ExampleSettings
from trajectron_model.training.objective import LossTerms, ObjectiveSettings, loss_terms
from trajectron_model.trajectron import Trajectron

_SAMPLES = 20
_SEED = 20191027
_LOSS_BATCHES = 4
_CALIBRATION_AGENTS = 200


class ValidationFigures(NamedTuple):
    """Means over judged agents, then over recordings; metres.

    ``nll`` is in nats a future, of densities over velocity in m/s, on a few batches.
    """

    nll: float
    min_ade_20: float
    min_fde_20: float
    ade_mode: float  # of the most probable mode's mean
    fde_mode: float
    ade_mean: float  # of the mean over all modes
    fde_mean: float
    prior_entropy: float
    information: float

    @property
    def score(self) -> float:
        """What training selects by, lower is better: the best sample and the point forecast."""
        return self.min_ade_20 + 0.5 * self.min_fde_20 + 0.5 * (self.ade_mean + 0.5 * self.fde_mean)


class Validation:
    """A fixed selection of windows, so that figures can be compared over a training.

    Recordings weigh the same whatever their crowds, as sets do in the benchmark's means.

    Args:
        recordings: validation parts.
        model: gives the numbers of steps.
        max_agents: each recording's windows are thinned evenly to about so many judged agents.

    Raises:
        ValueError: no recording has an agent that can be judged.
    """

    def __init__(
        self, recordings: Sequence[Recording], model: Trajectron, max_agents: int = 150
    ) -> None:
        config = model.config
        found = [_windows(recording, config) for recording in recordings]
        self.windows = [_thin(windows, max_agents) for windows in found if windows]
        self.calibration_windows = [_thin(w, _CALIBRATION_AGENTS) for w in found if w]
        if not self.windows:
            raise ValueError(
                "the validation data has no agent that is seen for "
                f"{config.observed_steps + config.horizon} steps on end"
            )
        settings = ExampleSettings(
            short_history=0.0,
            long_history=0.0,
            mirror=False,
            scale=0.0,
            input_noise_m=0.0,
            pace=0.0,
        )
        self._examples = Examples(recordings, config, settings, _SEED)

    def figures(self, model: Trajectron, objective: ObjectiveSettings) -> ValidationFigures:
        """The figures of a model as it stands."""
        model.eval()
        predictor = TrajectronPredictor(model, "in training")
        means = np.mean([_errors_of(predictor, windows) for windows in self.windows], axis=0)
        terms = self._losses(model, replace(objective, label_noise_mps=0.0))
        model.train()
        nll, entropy, information = (
            float(np.mean([float(getattr(t, name)) for t in terms]))
            for name in ("nll", "prior_entropy", "information")
        )
        return ValidationFigures._make([nll, *means.tolist(), entropy, information])

    def _losses(self, model: Trajectron, objective: ObjectiveSettings) -> list[LossTerms]:
        with torch.no_grad():
            return [
                loss_terms(
                    model,
                    self._examples.batch(number),
                    objective,
                    beta=1.0,
                    random=np.random.default_rng([_SEED, number]),
                )
                for number in range(_LOSS_BATCHES)
            ]


def _windows(recording: Recording, config: ModelConfig) -> list[Window]:
    """Every window of a recording that judges agents that can move, and only those."""
    moves = {t.name for t in config.types if not t.stationary}
    windows = sgan_windows(
        recording, observed=config.observed_steps, horizon=config.horizon, min_agents=1
    )
    kept = [
        replace(window, judged=window.judged[[kind in moves for kind in window.types]])
        for window in windows
    ]
    return [window for window in kept if len(window.judged)]


def _errors_of(predictor: TrajectronPredictor, windows: Sequence[Window]) -> np.ndarray:
    """[6] the displacement errors of ``ValidationFigures``, in order, means over agents."""
    forecasts = predictor.predict(windows, num_samples=_SAMPLES, seed=_SEED)
    rows = []
    for window, forecast in zip(windows, forecasts, strict=True):
        truth = window.future()
        errors = (
            *_best(forecast.samples, truth),
            *_errors(forecast.mode_mean, truth),
            *_errors(forecast.mean, truth),
        )
        rows.append(np.stack(errors, axis=-1))
    mean: np.ndarray = np.concatenate(rows).mean(axis=0)
    return mean


def _best(samples: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    distance = metrics.displacement(samples, truth)
    return (
        metrics.best_of(metrics.average_displacement(distance), _SAMPLES),
        metrics.best_of(metrics.final_displacement(distance), _SAMPLES),
    )


def _errors(forecast: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    distance = metrics.displacement(forecast, truth)
    return metrics.average_displacement(distance), metrics.final_displacement(distance)


def _thin(windows: list[Window], max_agents: int) -> list[Window]:
    """Evenly spaced windows with about ``max_agents`` judged agents in all."""
    total = sum(len(window.judged) for window in windows)
    if total <= max_agents:
        return windows
    count = max(1, round(len(windows) * max_agents / total))
    chosen = np.linspace(0, len(windows) - 1, count).round().astype(int)
    return [windows[i] for i in chosen]
