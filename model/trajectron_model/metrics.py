"""Errors of forecasts, in metres: pure functions of arrays.

Shape letters: S samples, A agents of one window, H horizon steps, G groups of samples.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def displacement(forecast: NDArray[np.floating], truth: Float) -> Float:
    """Distance between forecast and true positions.

    Args:
        forecast: [..., A, H, 2] metres.
        truth: [A, H, 2] metres.

    Returns:
        [..., A, H] metres.
    """
    difference = forecast - truth
    return np.hypot(difference[..., 0], difference[..., 1]).astype(np.float64, copy=False)


def average_displacement(distance: Float) -> Float:
    """ADE: the mean over the horizon. [..., A, H] metres to [..., A] metres."""
    ade: Float = distance.mean(axis=-1)
    return ade


def final_displacement(distance: Float) -> Float:
    """FDE: the distance at the last step. [..., A, H] metres to [..., A] metres."""
    return distance[..., -1]


def best_of(errors: Float, n: int) -> Float:
    """Best of n per agent: each agent picks its own best sample (minADE, minFDE).

    More than ``n`` independent samples are cut into disjoint groups of ``n`` in their order, and
    the groups' minima averaged: the expectation is that of one draw of ``n``, its variance lower.
    Samples left over are not used.

    Args:
        errors: [S, A] ADE or FDE of each sample, metres; independent samples, S >= n.

    Returns:
        [A] metres.

    Raises:
        ValueError: fewer than ``n`` samples.
    """
    best: Float = _groups(errors, n).min(axis=1).mean(axis=0)
    return best


def joint_best_of(errors: Float, n: int) -> Float:
    """Best of n joint over the scene: one sample index serves all agents of the window.

    The index is the one with the lowest error summed over the agents. ADE and FDE are each
    given here on their own, so each picks its own index. Groups as in `best_of`. The mean of
    the result over all windows' agents is the figure that Trajectron and Social GAN publish.

    Args:
        errors: [S, A] ADE or FDE of each sample, metres; all agents of one window; S >= n.

    Returns:
        [A] each agent's error under the chosen samples, metres.

    Raises:
        ValueError: fewer than ``n`` samples.
    """
    groups = _groups(errors, n)
    chosen = groups.sum(axis=-1).argmin(axis=1)  # [G]
    best: Float = groups[np.arange(len(groups)), chosen].mean(axis=0)
    return best


def _groups(errors: Float, n: int) -> Float:
    """[S, A] to [G, n, A]."""
    samples, agents = errors.shape
    if not 1 <= n <= samples:
        raise ValueError(f"best of {n} needs at least {n} samples; there are {samples}")
    whole = samples // n * n
    return errors[:whole].reshape(-1, n, agents)  # [G, n, A]
