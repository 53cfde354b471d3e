"""Observations at any rate put onto a regular time grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_STEPS = 1_000_000
"""The longest recording: 4.6 days at 0.4 s. Beyond it times are hardly in seconds."""

MAX_GAP_S = 1.0
"""Observations of an agent further apart than this are not bridged, seconds."""

_ON_GRID_STEPS = 1e-4
"""An observation this near to a grid step, in steps, is taken as it is."""


@dataclass(frozen=True)
class GridRows:
    """Rows on the grid, in no particular order; R of them.

    Attributes:
        step: [R] grid step, 0 at the origin.
        agent: [R] agent index, as given.
        position: [R, 2] metres.
    """

    step: NDArray[np.int64]
    agent: NDArray[np.int64]
    position: NDArray[np.float64]


def resample(
    time_s: NDArray[np.float64],
    agent: NDArray[np.int64],
    position: NDArray[np.float64],
    *,
    origin_s: float,
    dt_s: float,
    max_gap_s: float = MAX_GAP_S,
) -> GridRows:
    """Each agent's positions at the steps ``origin_s + k dt_s``.

    A step between two successive observations of an agent is interpolated linearly when they
    are at most ``max_gap_s`` apart; otherwise the agent is absent there. Nothing is
    extrapolated, so a step before an agent's first or after its last observation is empty.
    An interpolated step leans on the observation after it: forecasts from resampled
    recordings see at most one interval of the source (``max_gap_s`` at worst) further than
    their newest step.

    Args:
        time_s: [R'] seconds, not before ``origin_s``, in any order.
        agent: [R'] agent index.
        position: [R', 2] metres.
    """
    order = np.lexsort((time_s, agent))
    time_s, agent, position = time_s[order], agent[order], position[order]
    grid = (time_s - origin_s) / dt_s  # [R'] in steps
    nearest = np.rint(grid)
    on_grid = np.abs(grid - nearest) < _ON_GRID_STEPS
    grid = np.where(on_grid, nearest, grid)

    bridged = (np.diff(agent) == 0) & (np.diff(time_s) <= max_gap_s + _ON_GRID_STEPS * dt_s)
    first_inside = np.floor(grid[:-1]) + 1
    inside = np.ceil(grid[1:]) - first_inside  # steps strictly between two observations
    count = np.where(bridged, np.maximum(inside, 0), 0).astype(np.int64)
    before = np.repeat(np.arange(len(count)), count)
    nth = np.arange(len(before)) - np.repeat(np.cumsum(count) - count, count)
    step = first_inside[before] + nth
    weight = ((step - grid[before]) / (grid[before + 1] - grid[before]))[:, None]
    between = (1 - weight) * position[before] + weight * position[before + 1]

    return _without_repeats(
        np.concatenate([grid[on_grid], step]).astype(np.int64),
        np.concatenate([agent[on_grid], agent[before]]),
        np.concatenate([position[on_grid], between]),
    )


def _without_repeats(
    step: NDArray[np.int64], agent: NDArray[np.int64], position: NDArray[np.float64]
) -> GridRows:
    """One row per agent and step: two observations can be near enough to share a step."""
    _, first = np.unique(np.stack([step, agent]), axis=1, return_index=True)
    return GridRows(step[first], agent[first], position[first])
