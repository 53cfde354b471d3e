"""A straight line through each agent's observed positions, walked on at the same pace.

The Linear baseline of Social GAN's table (Gupta et al., CVPR 2018): "a linear regressor that
estimates linear parameters by minimizing the least square error". Least squares over time for
each agent and axis, over the same eight steps.

Shape letters: A agents, T observed steps, H horizon steps, S samples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trajectron_model.baselines.scenes import observed_scene
from trajectron_model.data.windows import Window
from trajectron_model.predictor import WindowForecast

Float = NDArray[np.float64]


class Linear:
    """One trajectory, however many samples are asked for."""

    @property
    def name(self) -> str:
        """How tables call it."""
        return "linear"

    def predict(
        self, windows: Sequence[Window], *, num_samples: int, seed: int
    ) -> list[WindowForecast]:
        """See `Predictor`. An agent seen once in the last eight steps stays where it is.

        Raises:
            ValueError: a judged agent that is absent at the newest observed step.
        """
        del seed
        forecasts = []
        for window in windows:
            scene = observed_scene(window, context=False)
            history = scene.position.transpose(1, 0, 2)  # [A, T, 2]
            line = extended(history, window.horizon) + scene.origin
            samples = np.broadcast_to(line, (num_samples, *line.shape))
            forecasts.append(WindowForecast(samples, line, line))
        return forecasts


def extended(history: Float, horizon: int) -> Float:
    """The least-squares line of each agent, at the steps after its history.

    Args:
        history: [A, T, 2] metres, NaN where absent; everyone is seen at least once.
        horizon: H.

    Returns:
        [A, H, 2] metres.
    """
    seen = ~np.isnan(history[..., :1])  # [A, T, 1]
    count = seen.sum(axis=1)  # [A, 1]
    time = np.arange(1.0 - history.shape[1], 1.0)[None, :, None]  # [1, T, 1], the newest is 0
    position = np.where(seen, history, 0.0)
    middle = (seen * time).sum(axis=1) / count  # [A, 1]
    centre = position.sum(axis=1) / count  # [A, 2]
    away = seen * (time - middle[:, None])  # [A, T, 1]
    spread = (away**2).sum(axis=1)  # [A, 1]
    slope = (away * position).sum(axis=1) / np.where(spread > 0.0, spread, 1.0)  # [A, 2]
    ahead = np.arange(1.0, horizon + 1.0)[None, :, None] - middle[:, None]  # [A, H, 1]
    return np.asarray(centre[:, None] + slope[:, None] * ahead)
