"""Scenes changed so that they stay likely: mirrored, stretched, played at another pace.

Shape letters: T steps, N agents.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

SLOWEST, FASTEST = -1.2, 0.25
"""Bounds on the logarithm of the pace that a scene ends with: 0.3 to 1.28 of its own."""

_EARLIEST, _LATEST = -3.0, 6.0
_RAMP = 6.0


def steps_beyond(horizon: int) -> int:
    """Steps after the horizon's last that a scene played at `FASTEST` may reach."""
    return math.ceil((horizon - _EARLIEST) * math.expm1(FASTEST))


def mirrored(position: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.float64]:
    """The scene, [..., 2] metres, or as often its mirror image."""
    return position * np.array([1.0, -1.0]) if random.random() < 0.5 else position


def stretched(
    position: NDArray[np.float64], scale: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """The scene, [..., 2] metres, times a factor from [1 / (1 + scale), 1 + scale]."""
    span = math.log1p(scale)
    return position * math.exp(random.uniform(-span, span))


def paced(
    position: NDArray[np.float64], now: int, random: np.random.Generator
) -> NDArray[np.float64]:
    """The scene as a film whose speed changes: paths stay, everybody slows or hastens on them.

    The pace is 1, then from an onset 3 steps before ``now`` to 6 after it ramps over 6 steps,
    its logarithm linearly, to a final value drawn between `SLOWEST` and `FASTEST`. The frame of
    ``now`` stays where it is, and no earlier step sees anything later.

    Args:
        position: [T, N, 2] metres, NaN where absent.
        now: index of the newest observed step.
        random: decides the pace.

    Returns:
        [T, N, 2]: between two frames on a straight line, NaN where either is unknown.
    """
    log_pace, onset = random.uniform(SLOWEST, FASTEST), random.uniform(_EARLIEST, _LATEST)
    ramp = np.clip((np.arange(len(position)) - now - onset) / _RAMP, 0.0, 1.0)
    pace = np.exp(log_pace * ramp)
    film = np.concatenate([[0.0], (0.5 * (pace[1:] + pace[:-1])).cumsum()])
    return _frames_at(position, film - film[now] + now)


def _frames_at(position: NDArray[np.float64], film: NDArray[np.float64]) -> NDArray[np.float64]:
    """[T, N, 2] the scene at fractional steps ``film`` [T], NaN outside of it."""
    before = np.floor(film + 1e-9).astype(np.int64)
    share = np.where(film - before < 1e-9, 0.0, film - before)[:, None, None]
    inside = (before >= 0) & (before + (share[:, 0, 0] > 0.0) < len(position))
    before = before.clip(0, len(position) - 1)
    after = (before + 1).clip(max=len(position) - 1)
    between = (1.0 - share) * position[before] + share * position[after]
    frames = np.where(share == 0.0, position[before], between)
    frames[~inside] = np.nan
    return frames
