"""Everyone walks on as in the last step (Schoeller et al., RA-L 2020)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trajectron_model.baselines.randomness import window_generator
from trajectron_model.data.windows import Window
from trajectron_model.predictor import WindowForecast


class ConstantVelocity:
    """The last displacement, repeated over the horizon: causal, and hard to beat on average.

    Args:
        heading_noise_deg: standard deviation of a Gaussian angle by which each sample's
            velocity is turned, degrees; 25 is the published choice. Without it all samples
            are the one trajectory.
    """

    def __init__(self, heading_noise_deg: float = 0.0) -> None:
        self._heading_noise_deg = heading_noise_deg

    @property
    def name(self) -> str:
        """How tables call it."""
        noise = self._heading_noise_deg
        return f"constant velocity + {noise:g} deg" if noise else "constant velocity"

    def predict(
        self, windows: Sequence[Window], *, num_samples: int, seed: int
    ) -> list[WindowForecast]:
        """See `Predictor`. An agent that was absent at the step before stays where it is.

        Raises:
            ValueError: a judged agent that is absent at the newest observed step.
        """
        return [self._predict_window(window, num_samples, seed) for window in windows]

    def _predict_window(self, window: Window, num_samples: int, seed: int) -> WindowForecast:
        history = window.history()  # [A, T, 2]
        now = history[:, -1]  # [A, 2]
        if np.isnan(now).any():
            raise ValueError("a judged agent is absent at the newest observed step")
        before = history[:, -2] if history.shape[1] > 1 else np.full_like(now, np.nan)
        stride = np.nan_to_num(now - before)  # [A, 2] metres per step
        mean = self._walk(now, stride, window.horizon)
        if not self._heading_noise_deg:
            samples = np.broadcast_to(mean, (num_samples, *mean.shape))
            return WindowForecast(samples, mean, mean)
        angle = window_generator(window, seed).normal(
            scale=np.radians(self._heading_noise_deg), size=(num_samples, len(now))
        )
        sine, cosine = np.sin(angle), np.cos(angle)  # [S, A]
        turned = np.stack(
            [
                cosine * stride[:, 0] - sine * stride[:, 1],
                sine * stride[:, 0] + cosine * stride[:, 1],
            ],
            axis=-1,
        )  # [S, A, 2]
        return WindowForecast(self._walk(now, turned, window.horizon), mean, mean)

    @staticmethod
    def _walk(
        now: NDArray[np.float64], stride: NDArray[np.float64], horizon: int
    ) -> NDArray[np.float64]:
        """[..., A, H, 2] positions from [A, 2] and displacements per step [..., A, 2]."""
        steps = np.arange(1, horizon + 1)[:, None]  # [H, 1]
        return now[:, None, :] + steps * stride[..., None, :]
