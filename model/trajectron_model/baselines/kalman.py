"""A Kalman filter for each agent: constant velocity, disturbed by white noise of acceleration.

State: position and velocity of one axis; both axes are alike and independent, so each agent has
one 2 x 2 covariance (Bar-Shalom, Li & Kirubarajan, "Estimation with applications to tracking
and navigation" (2001), section 6.2.2). The forecast is one Gaussian for each step. Three noise
levels are fitted by likelihood of the foretold positions (`kalman_fitting`), and nothing else.

Shape letters: A agents, T observed steps, H horizon steps, S samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from trajectron_model.baselines.randomness import window_generator
from trajectron_model.data.windows import Window
from trajectron_model.predictor import PositionMixture, WindowForecast

Float = NDArray[np.float64]

MEMORY_STEPS = 20
"""Observed steps that are filtered at most: what is older has no weight left."""


class NoiseLevels(NamedTuple):
    """What the filter believes; standard deviations.

    Attributes:
        acceleration: of the white noise of acceleration over a second, m/s^1.5.
        position_m: of an observed position.
        velocity_mps: of each component of a velocity not yet observed.
    """

    acceleration: float
    position_m: float
    velocity_mps: float


START = NoiseLevels(acceleration=0.5, position_m=0.05, velocity_mps=1.0)
"""Where the search for the noise levels begins."""


class Belief(NamedTuple):
    """A Gaussian over each agent's position and velocity; one covariance for both axes."""

    mean: Float  # [A, 2, 2]: position (m) and velocity (m/s), then the axis
    covariance: Float  # [A, 2, 2] of position and velocity


class LevelsModule(nn.Module):
    """The noise levels as a module, so that they are saved as other baselines' weights are."""

    def __init__(self, levels: NoiseLevels = START) -> None:
        super().__init__()
        self.register_buffer("levels", torch.tensor(levels, dtype=torch.float64))
        self.levels: torch.Tensor

    def value(self) -> NoiseLevels:
        """As numbers."""
        return NoiseLevels(*self.levels.tolist())


def transition(dt_s: float, levels: NoiseLevels) -> tuple[Float, Float]:
    """The matrix of a step, and the covariance it adds; [2, 2] each."""
    matrix = np.array([[1.0, dt_s], [0.0, 1.0]])
    added = np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    return matrix, levels.acceleration**2 * added


def observe(history: Float, dt_s: float, levels: NoiseLevels) -> Belief:
    """Filters observed positions.

    An agent's first observation gives its position, with velocity zero give or take
    ``levels.velocity_mps``; steps at which it is absent only spread the belief.

    Args:
        history: [A, T, 2] metres, NaN where absent; everyone is seen at least once.
        dt_s: seconds between steps.
        levels: of the filter.
    """
    matrix, added = transition(dt_s, levels)
    agents = len(history)
    first = np.diag([levels.position_m**2, levels.velocity_mps**2])
    mean, covariance = np.zeros((agents, 2, 2)), np.broadcast_to(first, (agents, 2, 2))
    begun = np.zeros(agents, dtype=bool)
    for step in range(history.shape[1]):
        seen = ~np.isnan(history[:, step, 0])
        position = np.where(seen[:, None], history[:, step], 0.0)  # [A, 2]
        foretold = matrix @ mean
        spread = matrix @ covariance @ matrix.T + added
        variance = spread[:, 0, 0] + levels.position_m**2  # [A]
        gain = spread[:, :, 0] / variance[:, None]  # [A, 2]
        innovation = position - foretold[:, 0]  # [A, 2]
        corrected = foretold + gain[:, :, None] * innovation[:, None, :]
        kept = spread - gain[:, :, None] * spread[:, None, 0, :]
        start = np.stack([position, np.zeros_like(position)], axis=1)
        old, new = (begun & seen)[:, None, None], (~begun & seen)[:, None, None]
        waiting = (begun & ~seen)[:, None, None]
        mean = np.where(old, corrected, np.where(new, start, np.where(waiting, foretold, mean)))
        covariance = np.where(
            old, kept, np.where(new, first, np.where(waiting, spread, covariance))
        )
        begun |= seen
    return Belief(mean, covariance)


def foretell(belief: Belief, horizon: int, dt_s: float, levels: NoiseLevels) -> Belief:
    """The beliefs at the steps after; mean [A, H, 2, 2], covariance [A, H, 2, 2]."""
    matrix, added = transition(dt_s, levels)
    mean, covariance = belief
    means, covariances = [], []
    for _ in range(horizon):
        mean = matrix @ mean
        covariance = matrix @ covariance @ matrix.T + added
        means.append(mean)
        covariances.append(covariance)
    return Belief(np.stack(means, axis=1), np.stack(covariances, axis=1))


class Kalman:
    """See the module.

    Args:
        levels: fitted noise levels.
        name: how tables call it.
    """

    def __init__(self, levels: NoiseLevels, name: str = "kalman") -> None:
        self._levels = levels
        self._name = name

    @property
    def name(self) -> str:
        """How tables call it."""
        return self._name

    def predict(
        self, windows: Sequence[Window], *, num_samples: int, seed: int
    ) -> list[WindowForecast]:
        """See `Predictor`; samples are walks of the state, so their steps hang together.

        Raises:
            ValueError: a judged agent that was never observed.
        """
        return [self._predict_window(window, num_samples, seed) for window in windows]

    def log_prob(self, windows: Sequence[Window]) -> list[Float]:
        """See `DensityPredictor`: the filter's own likelihood, each step given those before.

        True positions count as positions of the state, not as observations of it.
        """
        return [self._log_prob_of(window) for window in windows]

    def _predict_window(self, window: Window, samples: int, seed: int) -> WindowForecast:
        dt_s = window.recording.dt_s
        belief = observe(recent_history(window), dt_s, self._levels)
        ahead = foretell(belief, window.horizon, dt_s, self._levels)
        mean = ahead.mean[:, :, 0]  # [A, H, 2]
        variance = ahead.covariance[:, :, 0, 0]  # [A, H]
        covariance = variance[..., None] * np.array([1.0, 0.0, 1.0])  # [A, H, 3]
        mixture = PositionMixture(np.ones((len(mean), 1)), mean[:, None], covariance[:, None])
        drawn = self._walks(belief, window, samples, seed)
        return WindowForecast(drawn, mean, mean, mixture)

    def _walks(self, belief: Belief, window: Window, samples: int, seed: int) -> Float:
        """[S, A, H, 2] positions: a state drawn from the belief, then disturbed at every step."""
        matrix, added = transition(window.recording.dt_s, self._levels)
        random = window_generator(window, seed)
        shape = (samples, *belief.mean.shape)  # [S, A, 2, 2]
        state = belief.mean + np.linalg.cholesky(belief.covariance) @ random.normal(size=shape)
        root = np.linalg.cholesky(added)
        positions = []
        for _ in range(window.horizon):
            state = matrix @ state + root @ random.normal(size=shape)
            positions.append(state[:, :, 0])
        return np.stack(positions, axis=2)

    def _log_prob_of(self, window: Window) -> Float:
        dt_s = window.recording.dt_s
        matrix, added = transition(dt_s, self._levels)
        mean, covariance = observe(recent_history(window), dt_s, self._levels)
        future = window.future()  # [A, H, 2]
        total = np.zeros(len(future))
        for step in range(window.horizon):
            mean = matrix @ mean
            covariance = matrix @ covariance @ matrix.T + added
            variance = covariance[:, 0, 0]
            innovation = future[:, step] - mean[:, 0]  # [A, 2]
            total = total + log_density(innovation, variance)
            gain = covariance[:, :, 0] / variance[:, None]
            mean = mean + gain[:, :, None] * innovation[:, None, :]
            covariance = covariance - gain[:, :, None] * covariance[:, None, 0, :]
        return total


def recent_history(window: Window) -> Float:
    """[A, T, 2] the last `MEMORY_STEPS` observed positions of the judged agents, metres.

    Raises:
        ValueError: a judged agent that is absent at the newest observed step.
    """
    first = max(window.first, window.now + 1 - MEMORY_STEPS)
    agents, position = window.recording.dense(first, window.now + 1)  # [N], [T, N, 2]
    if not np.isin(window.judged, agents[~np.isnan(position[-1, :, 0])]).all():
        raise ValueError("a judged agent is absent at the newest observed step")
    return position[:, np.searchsorted(agents, window.judged)].transpose(1, 0, 2)


def log_density(difference: Float, variance: Float) -> Float:
    """Of isotropic Gaussians; [..., 2] metres from the mean and [...] m^2 to [...] nats."""
    squared = (difference**2).sum(-1) / variance
    return np.asarray(-0.5 * squared - np.log(variance) - math.log(2.0 * math.pi))
