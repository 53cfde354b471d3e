"""The contract that every predictor meets, and the Trajectron behind it.

Shape letters: A judged agents of one window, S samples, H horizon steps, Z modes (the
Trajectron's latent values).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trajectron_model.data.windows import Window, batches
from trajectron_model.forecast import ForecastRequest, SceneForecast
from trajectron_model.state import SceneFrame, SceneState
from trajectron_model.trajectron import Trajectron

_MAX_TRAJECTORIES = 25_000
"""Sampled at once: 128 hidden values of each are about a dozen megabytes."""


@dataclass(frozen=True)
class PositionMixture:
    """A Gaussian mixture over position for each judged agent and step, in the world.

    Attributes:
        probability: [A, Z] of the modes, summing to one.
        mean: [A, Z, H, 2] metres.
        covariance: [A, Z, H, 3] square metres: xx, xy, yy.
    """

    probability: NDArray[np.float64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]


@dataclass(frozen=True)
class WindowForecast:
    """A forecast of one window's judged agents, in the window's order, world positions.

    Attributes:
        samples: [S, A, H, 2] metres; independent of one another.
        mode_mean: [A, H, 2] metres, the mean of the most probable mode.
        mean: [A, H, 2] metres, the mean over all modes.
        mixture: the analytic distribution of positions; None for a predictor that only
            samples.
    """

    samples: NDArray[np.floating]
    mode_mean: NDArray[np.float64]
    mean: NDArray[np.float64]
    mixture: PositionMixture | None = None


class Predictor(Protocol):
    """Whatever foretells windows: the model, and every baseline beside it."""

    @property
    def name(self) -> str:
        """How tables call it."""

    def predict(
        self, windows: Sequence[Window], *, num_samples: int, seed: int
    ) -> list[WindowForecast]:
        """A forecast of each window from its observed steps alone.

        The same arguments give the same forecasts, whichever windows stand beside.
        """


@runtime_checkable
class DensityPredictor(Predictor, Protocol):
    """A predictor whose likelihood of a whole trajectory is exact."""

    def log_prob(self, windows: Sequence[Window]) -> list[NDArray[np.float64]]:
        """[A] for each window: log density of the judged agents' true futures, nats.

        Over positions in metres, all steps together; NaN where a future is not complete.
        """


class TrajectronPredictor:
    """The Trajectron, run on windows as the service runs it on frames.

    The observed frames of each window are folded into a state from the empty scene, context
    agents included; only the judged agents are forecast. Many windows are stacked in a batch.
    Samples are keyed by the window's newest step, as a session's are by its version, so that
    windows of one agent do not share their noise.

    Args:
        model: as loaded from a checkpoint.
        name: how tables call it.
    """

    def __init__(self, model: Trajectron, name: str) -> None:
        self._model = model
        self._name = name

    @property
    def name(self) -> str:
        """How tables call it."""
        return self._name

    def predict(
        self, windows: Sequence[Window], *, num_samples: int, seed: int
    ) -> list[WindowForecast]:
        """See `Predictor`.

        Raises:
            ValueError: a recording of another dt or with an agent type that the model lacks.
        """
        max_agents = max(1, _MAX_TRAJECTORIES // num_samples)
        return [
            forecast
            for batch in batches(windows, max_agents)
            for forecast in self._predict_batch(batch, num_samples, seed)
        ]

    def _predict_batch(
        self, windows: Sequence[Window], num_samples: int, seed: int
    ) -> list[WindowForecast]:
        dt_s = self._model.config.dt_s
        for window in windows:
            if abs(window.recording.dt_s - dt_s) > 1e-6:
                raise ValueError(
                    f"{window.recording.name} has steps of {window.recording.dt_s} s; "
                    f"{self.name} works at {dt_s} s"
                )
        states = self._observe([window.frames() for window in windows])
        requests = [
            ForecastRequest(
                mode="full",
                num_samples=num_samples,
                horizon=window.horizon,
                seed=seed,
                step=window.now,
                agents=window.ids,
                include_modes=True,
            )
            for window in windows
        ]
        return [_in_world(forecast) for forecast in self._model.forecast(states, requests)]

    def _observe(self, frames: Sequence[Sequence[SceneFrame]]) -> list[SceneState]:
        """The states after each window's frames, all windows stepped together."""
        states = [self._model.initial_state() for _ in frames]
        for step in range(max(len(observed) for observed in frames)):
            active = [index for index, observed in enumerate(frames) if step < len(observed)]
            stepped = self._model.step(
                [states[index] for index in active], [frames[index][step] for index in active]
            )
            for index, state in zip(active, stepped, strict=True):
                states[index] = state
        return states


def _in_world(forecast: SceneForecast) -> WindowForecast:
    """Offsets from each agent's position as world positions."""
    if forecast.samples is None or forecast.mean is None or forecast.covariance is None:
        raise ValueError("a forecast of windows needs samples and modes")
    origin = forecast.position[:, None, :]  # [A, 1, 2]
    probability = forecast.mode_probabilities.astype(np.float64)  # [A, Z]
    best = probability.argmax(axis=1)  # [A]
    mode_mean = forecast.mean[np.arange(len(best)), best]  # [A, H, 2]
    mean = np.einsum("az,azhi->ahi", probability, forecast.mean)  # [A, H, 2]
    samples = forecast.samples.transpose(1, 0, 2, 3)  # [S, A, H, 2]
    mixture = PositionMixture(
        probability / probability.sum(axis=1, keepdims=True),
        forecast.mean + origin[:, None],
        forecast.covariance.astype(np.float64),
    )
    return WindowForecast(samples + origin, mode_mean + origin, mean + origin, mixture)
