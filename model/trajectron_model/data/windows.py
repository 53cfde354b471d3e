"""Evaluation windows: a stretch of observed steps, the steps to foretell, the agents judged.

Shape letters: T observed steps, H horizon steps, A judged agents.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from trajectron_model.data.recording import Recording

if TYPE_CHECKING:
    from trajectron_model.state import SceneFrame


AGENT_TIMEOUT_S = 2.0
"""Who was unseen for longer is a new agent when seen again: the service's own default."""


@dataclass(frozen=True, eq=False)
class Window:
    """One window; it holds indices only and reads its recording when asked.

    A predictor may look at `frames` and `history` alone: the ``observed`` steps and nothing
    before or after them.

    Attributes:
        recording: the recording it is a window of.
        first: the first observed step.
        observed: number of observed steps.
        horizon: number of steps to foretell, right after the observed ones.
        judged: [A] agents whose forecasts are judged, indices into the recording's ids,
            ascending.
        in_best_of: [A] which of them best-of-N is over; None for all.
        truth: the recording without the noise that ``recording`` was given; None where it
            was given none.
    """

    recording: Recording
    first: int
    observed: int
    horizon: int
    judged: NDArray[np.int64] = field(repr=False)
    in_best_of: NDArray[np.bool_] | None = field(default=None, repr=False)
    truth: Recording | None = field(default=None, repr=False)

    @property
    def now(self) -> int:
        """The newest observed step."""
        return self.first + self.observed - 1

    @property
    def ids(self) -> tuple[str, ...]:
        """[A] ids of the judged agents."""
        return tuple(self.recording.ids[agent] for agent in self.judged.tolist())

    @property
    def types(self) -> tuple[str, ...]:
        """[A] types of the judged agents."""
        return tuple(self.recording.types[agent] for agent in self.judged.tolist())

    def frames(self) -> list[SceneFrame]:
        """[T] the observed steps, with everyone visible in them, judged or context."""
        return [self.recording.frame(self.first + step) for step in range(self.observed)]

    def observations(self) -> NDArray[np.int64]:
        """[A] steps at which each judged agent was seen since it last (re)appeared.

        Who was unseen for longer than ``AGENT_TIMEOUT_S`` has appeared anew: sessions of the
        service have forgotten it by then.
        """
        seen = ~np.isnan(self.history()[..., 0])  # [A, T]
        steps = np.arange(self.observed)
        last = np.maximum.accumulate(np.where(seen, steps, -self.observed), axis=1)  # [A, T]
        unseen_s = (steps[1:] - last[:, :-1]) * self.recording.dt_s
        anew = seen[:, 1:] & (unseen_s > AGENT_TIMEOUT_S * (1.0 + 1e-9))
        begin = np.where(anew, steps[1:], 0).max(axis=1, initial=0)  # [A]
        count: NDArray[np.int64] = (seen & (steps >= begin[:, None])).sum(axis=1)
        return count

    def history(self) -> NDArray[np.float64]:
        """[A, T, 2] observed positions of the judged agents, metres; NaN where absent."""
        return self._positions(self.recording, self.first, self.first + self.observed)

    def future(self) -> NDArray[np.float64]:
        """[A, H, 2] true positions of the judged agents, metres; NaN where absent."""
        truth = self.recording if self.truth is None else self.truth
        return self._positions(truth, self.now + 1, self.now + 1 + self.horizon)

    def _positions(self, of: Recording, first: int, last: int) -> NDArray[np.float64]:
        rows = of.rows(first, min(last, of.num_steps))
        agent = of.agent[rows]
        column = np.searchsorted(self.judged, agent)
        known = column < len(self.judged)
        known[known] = self.judged[column[known]] == agent[known]
        positions = np.full((len(self.judged), last - first, 2), np.nan)
        step = of.step[rows] - first
        positions[column[known], step[known]] = of.position[rows][known]
        return positions


def sgan_windows(
    recording: Recording, *, observed: int = 8, horizon: int = 12, min_agents: int = 2
) -> list[Window]:
    """The windows of the protocol published with Social GAN (Gupta et al., CVPR 2018).

    Every ``observed + horizon`` consecutive steps, stride 1. Judged are the agents present in
    all of them; a window counts when at least ``min_agents`` are. Everyone else visible in the
    observed steps is context.

    Returns:
        windows by their first step; the judged agents of each ascending.
    """
    length = observed + horizon
    start, agent = _stretches(recording, length)
    order = np.lexsort((agent, start))
    start, agent = start[order], agent[order]
    firsts, begins, counts = np.unique(start, return_index=True, return_counts=True)
    windows = zip(firsts.tolist(), begins.tolist(), counts.tolist(), strict=True)
    return [
        Window(recording, first, observed, horizon, agent[begin : begin + count])
        for first, begin, count in windows
        if count >= min_agents
    ]


def _stretches(recording: Recording, length: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Every (first step, agent) from which the agent is present in ``length`` steps on end."""
    order = np.lexsort((recording.step, recording.agent))
    step, agent = recording.step[order], recording.agent[order]
    ahead = np.arange(len(step)) + length - 1
    inside = ahead < len(step)
    row, ahead = np.flatnonzero(inside), ahead[inside]
    # Steps of one agent rise strictly, so they are consecutive when the ends are so far apart.
    whole = (agent[ahead] == agent[row]) & (step[ahead] - step[row] == length - 1)
    return step[row[whole]], agent[row[whole]]


def batches(windows: Sequence[Window], max_agents: int) -> Iterator[Sequence[Window]]:
    """The windows in order, in runs of at most ``max_agents`` judged agents (at least a window)."""
    first, agents = 0, 0
    for index, window in enumerate(windows):
        if index > first and agents + len(window.judged) > max_agents:
            yield windows[first:index]
            first, agents = index, 0
        agents += len(window.judged)
    if first < len(windows):
        yield windows[first:]
