"""A forecast that waits for its future, and how the future is read off a session's frames.

Shape letters: A agents, Z modes, H horizon steps.

The truth at a step is where the agent stood in the frame of that time; between two frames no
more than one model step apart it is interpolated; else it is not known. Nothing is extrapolated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from trajectron_model.predictor import PositionMixture
from trajectron_service.messages import AgentForecast
from trajectron_service.timebase import Observation, interpolate

# Times that differ by less than this share of a step are the same.
_SAME = 1e-3


@dataclass(eq=False)
class Pending:
    """Some agents of one forecast: their mixture once it is known, and the truth so far.

    Attributes:
        model: its name.
        reference_time_s: of the newest frame, on the client's clock.
        dt_s: of a step.
        horizon: H.
        ids, types: of the agents, [A].
        reserved_s: what the budget set aside.
        mixture: None until it has been drawn.
        truth: [A, H, 2] metres, NaN where not known.
        reached: steps whose time has passed.
        dropped: whether nobody wants it any more.
    """

    model: str
    reference_time_s: float
    dt_s: float
    horizon: int
    ids: tuple[str, ...]
    types: tuple[str, ...]
    reserved_s: float
    mixture: PositionMixture | None = None
    truth: NDArray[np.float64] = field(init=False, repr=False)
    reached: int = 0
    dropped: bool = False

    def __post_init__(self) -> None:
        self.truth = np.full((len(self.ids), self.horizon, 2), np.nan)

    @property
    def complete(self) -> bool:
        """Whether all of its future has passed."""
        return self.reached >= self.horizon

    @property
    def known(self) -> NDArray[np.bool_]:
        """[A] agents that were seen at one step at least."""
        seen: NDArray[np.bool_] = np.any(~np.isnan(self.truth[..., 0]), axis=1)
        return seen

    def advance(self, before: Observation | None, frame: Observation, places: Places) -> None:
        """Reads the steps that have passed with ``frame``, which follows ``before``."""
        near_s = _SAME * self.dt_s
        while not self.complete:
            time_s = self.reference_time_s + (self.reached + 1) * self.dt_s
            if time_s > frame.time_s + near_s:
                return
            if abs(time_s - frame.time_s) <= near_s:
                self._take(places)
            elif (
                before is not None
                and before.time_s < time_s
                and frame.time_s - before.time_s <= self.dt_s + near_s
            ):
                self._take(places_of(interpolate(before, frame, time_s)))
            self.reached += 1

    def _take(self, places: Places) -> None:
        for row, agent in enumerate(zip(self.ids, self.types, strict=True)):
            place = places.get(agent)
            if place is not None:
                self.truth[row, self.reached] = place


# Where agents stand, by id and type: one that comes back as another type is another agent.
Places = Mapping[tuple[str, str], NDArray[np.float64]]


def places_of(frame: Observation) -> Places:
    """The agents of a frame."""
    return dict(zip(zip(frame.ids, frame.types, strict=True), frame.positions, strict=True))


def mixture_of(agents: Sequence[AgentForecast], horizon: int) -> PositionMixture:
    """The whole mixture over positions in the world, of forecasts that bring modes.

    Raises:
        ValueError: one without modes.
    """
    means, covariances = [], []
    for agent in agents:
        if agent.mean is None or agent.covariance is None:
            raise ValueError(f"the forecast of {agent.id!r} has no modes")
        means.append(agent.mean[:, :horizon] + np.array([agent.x, agent.y]))
        covariances.append(agent.covariance[:, :horizon].astype(np.float64))
    probability = np.stack([agent.mode_probabilities for agent in agents]).astype(np.float64)
    probability /= probability.sum(axis=1, keepdims=True)
    return PositionMixture(probability, np.stack(means), np.stack(covariances))


def rows_of(mixture: PositionMixture, chosen: NDArray[np.bool_]) -> PositionMixture:
    """The mixture of some agents; ``chosen`` is [A]."""
    return PositionMixture(
        mixture.probability[chosen], mixture.mean[chosen], mixture.covariance[chosen]
    )
