"""The contract that every predictor meets, and the Trajectron behind it.

Shape letters: A judged agents of one window, S samples, H horizon steps, Z modes (the
Trajectron's latent values).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trajectron_model.data.windows import AGENT_TIMEOUT_S, Window, batches
from trajectron_model.forecast import ForecastRequest, SceneForecast
from trajectron_model.likelihood import future_log_prob
from trajectron_model.noise import Sampling
from trajectron_model.state import SceneFrame, SceneState
from trajectron_model.trajectron import Trajectron

_MAX_TRAJECTORIES = 25_000
"""Sampled at once: 128 hidden values of each are about a dozen megabytes."""

_MAX_LIKELIHOODS = 2_000
"""Agents whose encodings are gathered at once for their likelihoods."""

_SHORT = 16
"""A window of at most so many steps that begins alone is stepped in a batch with others."""


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
    agents included, and agents unseen for longer than the service's timeout are dropped; only
    the judged agents are forecast. Windows that begin together are folded once, one from the
    other; those that do not are stepped as a batch. Samples are keyed by the window's newest
    step, as a session's are by its version, so that windows of one agent do not share noise.

    Args:
        model: as loaded from a checkpoint; its weights stay as they are from then on.
        name: how tables call it.
        mode: ``z_best`` for forecasts of the most probable mode alone.
        sampling: see ``ForecastRequest``.
    """

    def __init__(
        self,
        model: Trajectron,
        name: str,
        *,
        mode: Literal["full", "z_best"] = "full",
        sampling: Sampling = "iid",
    ) -> None:
        self._model = model
        self._name = name
        self._mode = mode
        self._sampling = sampling
        # States follow from frames alone, so keeping the last ones changes no result.
        self._observed: tuple[list[Window], list[SceneState]] = ([], [])
        self._newest: tuple[Window, SceneState] | None = None

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
        states = self._states(windows)
        max_agents = max(1, _MAX_TRAJECTORIES // num_samples)
        forecasts: list[WindowForecast] = []
        for batch in batches(windows, max_agents):
            first = len(forecasts)
            requests = [
                ForecastRequest(
                    mode=self._mode,
                    num_samples=num_samples,
                    horizon=window.horizon,
                    seed=seed,
                    step=window.now,
                    agents=window.ids,
                    include_modes=True,
                    sampling=self._sampling,
                )
                for window in batch
            ]
            found = self._model.forecast(states[first : first + len(batch)], requests)
            forecasts += [_in_world(one, self._mode) for one in found]
        return forecasts

    def log_prob(self, windows: Sequence[Window]) -> list[NDArray[np.float64]]:
        """See `DensityPredictor`; raises what `predict` does.

        NaN as well for agents of a type that never moves. Of an agent that has shown no
        direction the density is the mean over the angle by which its samples are turned.
        """
        states = self._states(windows)
        found: list[NDArray[np.float64]] = []
        for batch in batches(windows, _MAX_LIKELIHOODS):
            found += future_log_prob(
                self._model,
                states[len(found) : len(found) + len(batch)],
                [window.ids for window in batch],
                [window.future() for window in batch],
                best_mode_only=self._mode == "z_best",
            )
        return found

    def _states(self, windows: Sequence[Window]) -> list[SceneState]:
        """The state after each window's frames."""
        if self._observed[0] == list(windows):  # the very same windows
            return self._observed[1]
        dt_s = self._model.config.dt_s
        beginnings: dict[tuple[int, int], list[int]] = {}
        for index, window in enumerate(windows):
            if abs(window.recording.dt_s - dt_s) > 1e-6:
                raise ValueError(
                    f"{window.recording.name} has steps of {window.recording.dt_s} s; "
                    f"{self.name} works at {dt_s} s"
                )
            beginnings.setdefault((id(window.recording), window.first), []).append(index)
        states: dict[int, SceneState] = {}
        alone: list[int] = []
        for together in beginnings.values():
            if len(together) == 1 and windows[together[0]].observed <= _SHORT:
                alone += together
            else:
                together.sort(key=lambda index: windows[index].now)
                folded = self._fold([windows[index] for index in together])
                states.update(zip(together, folded, strict=True))
        observed = self._observe([windows[index].frames() for index in alone])
        states.update(zip(alone, observed, strict=True))
        found = [states[index] for index in range(len(windows))]
        self._observed = list(windows), found
        return found

    def _fold(self, windows: Sequence[Window]) -> list[SceneState]:
        """The states of windows that begin together, by their newest step."""
        first = windows[0]
        state, step = self._model.initial_state(), first.first
        if self._newest is not None:
            before, reached = self._newest
            same = before.recording is first.recording and before.first == first.first
            if same and before.now <= first.now:
                state, step = reached, before.now + 1
        states = []
        for window in windows:
            while step <= window.now:
                (state,) = self._step([state], [window.recording.frame(step)])
                step += 1
            states.append(state)
        self._newest = windows[-1], state
        return states

    def _observe(self, frames: Sequence[Sequence[SceneFrame]]) -> list[SceneState]:
        """The states after each window's frames, all windows stepped together."""
        states = [self._model.initial_state() for _ in frames]
        for step in range(max((len(observed) for observed in frames), default=0)):
            active = [index for index, observed in enumerate(frames) if step < len(observed)]
            stepped = self._step(
                [states[index] for index in active], [frames[index][step] for index in active]
            )
            for index, state in zip(active, stepped, strict=True):
                states[index] = state
        return states

    def _step(self, states: Sequence[SceneState], frames: Sequence[SceneFrame]) -> list[SceneState]:
        """One frame into each state, without those whom a session would have dropped by then."""
        kept = [_without_departed(s, f.time_s) for s, f in zip(states, frames, strict=True)]
        return self._model.step(kept, frames)


def _without_departed(state: SceneState, time_s: float) -> SceneState:
    limit = time_s - AGENT_TIMEOUT_S * (1.0 + 1e-9)
    here = (state.last_seen_s >= limit).tolist()
    if all(here):
        return state
    return state.keep([agent for agent, stays in zip(state.ids, here, strict=True) if stays])


def _in_world(forecast: SceneForecast, mode: Literal["full", "z_best"]) -> WindowForecast:
    """Offsets from each agent's position as world positions; of one mode only for ``z_best``."""
    if forecast.samples is None or forecast.mean is None or forecast.covariance is None:
        raise ValueError("a forecast of windows needs samples and modes")
    origin = forecast.position[:, None, :]  # [A, 1, 2]
    probability = forecast.mode_probabilities.astype(np.float64)  # [A, Z]
    means, covariances = forecast.mean, forecast.covariance.astype(np.float64)
    best = probability.argmax(axis=1)  # [A]
    rows = np.arange(len(best))
    mode_mean = means[rows, best] + origin  # [A, H, 2]
    samples = forecast.samples.transpose(1, 0, 2, 3) + origin  # [S, A, H, 2]
    if mode == "z_best":
        only = PositionMixture(
            np.ones((len(best), 1)), mode_mean[:, None], covariances[rows, best][:, None]
        )
        return WindowForecast(samples, mode_mean, mode_mean, only)
    probability /= probability.sum(axis=1, keepdims=True)
    mean = np.einsum("az,azhi->ahi", probability, means) + origin  # [A, H, 2]
    mixture = PositionMixture(probability, means + origin[:, None], covariances)
    return WindowForecast(samples, mode_mean, mean, mixture)
