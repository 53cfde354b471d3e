"""What a learned baseline's network does, and the predictor around it.

Shape letters: S samples, N agents of all scenes of a batch, A judged agents, H horizon steps.
"""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from trajectron_model.baselines.randomness import window_generator
from trajectron_model.baselines.scenes import Scene, SceneBatch, observed_scene, stack
from trajectron_model.data.windows import Window, batches
from trajectron_model.predictor import WindowForecast

DT_S = 0.4
"""Steps of the recordings that the baselines were published on."""

_MAX_ROWS = 2_000
"""Trajectories rolled out at once: their gates, 256 values each, then stay in the cache."""
_MAX_AGENTS = 256


class SceneNetwork(nn.Module):
    """Foretells where the agents of scenes go, from the observed steps and noise."""

    context: bool = True
    """Whether it looks at agents that are not judged."""

    @abstractmethod
    def draw_noise(
        self, random: np.random.Generator, agents: int, samples: int, horizon: int
    ) -> NDArray[np.float32]:
        """[S, N, ...] standard normal numbers for the samples of one scene."""

    @abstractmethod
    def sample(self, batch: SceneBatch, horizon: int, noise: Tensor) -> Tensor:
        """Samples for the agents present at the newest of `MEMORY_STEPS` observed steps.

        Args:
            batch: its further steps, if any, are not looked at.
            horizon: H.
            noise: [S, N, ...] of `draw_noise`, scenes side by side.

        Returns:
            [S, N, H, 2] offsets from each agent's newest position, metres.
        """

    @abstractmethod
    def point_forecast(self, batch: SceneBatch, horizon: int) -> Tensor | None:
        """[N, H, 2] offsets, metres; None where it is the mean of the samples drawn."""


class NetworkPredictor:
    """A network on windows; see `Predictor`.

    It looks at the newest `MEMORY_STEPS` observed steps. An agent seen in fewer of them enters
    when it is first seen, with displacement zero; until then its state is blank. Agents of any
    type are taken for pedestrians.

    Args:
        network: trained.
        name: how tables call it.
    """

    def __init__(self, network: SceneNetwork, name: str) -> None:
        self._network = network
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
            ValueError: a recording of another dt than `DT_S`, or a judged agent that is absent
                at the newest observed step.
        """
        require_dt(windows, self._name)
        most = min(_MAX_AGENTS, max(1, _MAX_ROWS // num_samples))
        return [
            forecast
            for run in _of_one_horizon(windows)
            for batch in batches(run, most)
            for forecast in self._predict_batch(batch, num_samples, seed)
        ]

    def _predict_batch(
        self, windows: Sequence[Window], samples: int, seed: int
    ) -> list[WindowForecast]:
        scenes = [observed_scene(window, context=self._network.context) for window in windows]
        horizon = windows[0].horizon
        noise = [
            self._network.draw_noise(
                window_generator(window, seed), scene.position.shape[1], samples, horizon
            )
            for window, scene in zip(windows, scenes, strict=True)
        ]
        batch = stack(scenes)
        with torch.no_grad():
            drawn = self._sample(batch, horizon, np.concatenate(noise, axis=1))  # [S, A, H, 2]
            point = self._network.point_forecast(batch, horizon)
        mean = drawn.mean(axis=0) if point is None else point[batch.judged].numpy()  # [A, H, 2]
        return _in_world(scenes, drawn, mean)

    def _sample(
        self, batch: SceneBatch, horizon: int, noise: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """[S, A, H, 2], a bounded number of rows at a time."""
        most = max(1, _MAX_ROWS // len(batch.scene))
        parts = [
            self._network.sample(batch, horizon, torch.from_numpy(noise[at : at + most]))[
                :, batch.judged
            ].numpy()
            for at in range(0, len(noise), most)
        ]
        return np.concatenate(parts)


def require_dt(windows: Sequence[Window], name: str) -> None:
    """Raises ValueError where a recording's steps are not those that a network was trained on."""
    for window in windows:
        if abs(window.recording.dt_s - DT_S) > 1e-6:
            raise ValueError(
                f"{window.recording.name} has steps of {window.recording.dt_s} s; "
                f"{name} works at {DT_S} s"
            )


def _of_one_horizon(windows: Sequence[Window]) -> list[Sequence[Window]]:
    """The windows in order, cut where the horizon changes."""
    horizons = np.array([window.horizon for window in windows])
    cuts = [0, *(np.flatnonzero(np.diff(horizons)) + 1).tolist(), len(windows)]
    return [windows[a:b] for a, b in itertools.pairwise(cuts) if a < b]


def _in_world(
    scenes: Sequence[Scene], samples: NDArray[np.float32], mean: NDArray[np.float32]
) -> list[WindowForecast]:
    """Offsets of all judged agents as world positions, window by window."""
    forecasts, begin = [], 0
    for scene in scenes:
        rows = slice(begin, begin + len(scene.judged))
        begin = rows.stop
        last = scene.last_observed()[:, None]  # [A, 1, 2]
        point = mean[rows].astype(np.float64) + last
        forecasts.append(WindowForecast(samples[:, rows] + last, point, point))
    return forecasts
