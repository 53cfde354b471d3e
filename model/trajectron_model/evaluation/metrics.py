"""Errors of forecasts, in metres: pure functions of arrays.

Truth that is not known is NaN, at the same steps for every sample of an agent.

Shape letters: S samples, A agents of one window, H horizon steps, Z modes, G groups of samples,
P pairs of agents.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, islice

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

MISS_THRESHOLD_M = 2.0
"""A forecast whose end is further than this from the true one has missed (Argoverse)."""

BRIER_MODES = 5
"""How many of the most probable modes compete in brier-minFDE."""

COLLISION_DISTANCE_M = 0.1
"""Two agents nearer than this have collided."""

_CELLS = 250_000
"""Coordinates of pairs held at a time: 2 MB an array."""


def displacement(forecast: NDArray[np.floating], truth: Float) -> Float:
    """Distance between forecast and true positions.

    Args:
        forecast: [..., A, H, 2] metres.
        truth: [A, H, 2] metres, NaN where not known.

    Returns:
        [..., A, H] metres, NaN where the truth is not known.
    """
    difference = forecast - truth
    return np.hypot(difference[..., 0], difference[..., 1]).astype(np.float64, copy=False)


def average_displacement(distance: Float) -> Float:
    """ADE: the mean over the known steps. [..., A, H] metres to [..., A]; NaN where none is."""
    return mean_over_known(distance)


def final_displacement(distance: Float) -> Float:
    """FDE: the distance at the last known step. [..., A, H] metres to [..., A] metres."""
    last = last_known(distance)[..., None]  # [..., A, 1]
    final: Float = np.take_along_axis(distance, last, axis=-1)[..., 0]
    return final


def mean_over_known(values: Float, axis: int = -1) -> Float:
    """The mean of what is not NaN; NaN where nothing is."""
    known = ~np.isnan(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    mean: Float = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    return mean


def last_known(values: Float) -> NDArray[np.int64]:
    """[..., H] to [...]: the last index that is not NaN; the last of all where every one is."""
    backwards = ~np.isnan(values[..., ::-1])
    last: NDArray[np.int64] = values.shape[-1] - 1 - backwards.argmax(axis=-1)
    return last


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


def miss_rate(final_errors: Float, n: int) -> Float:
    """Share of draws of n of which even the best ends further than 2 m from the truth.

    Args:
        final_errors: [S, A] FDE of each sample, metres; S >= n.

    Returns:
        [A] shares, over groups as in `best_of`.

    Raises:
        ValueError: fewer than ``n`` samples.
    """
    best = _groups(final_errors, n).min(axis=1)  # [G, A]
    missed = np.where(np.isnan(best), np.nan, best > MISS_THRESHOLD_M)
    share: Float = missed.mean(axis=0)
    return share


def _groups(errors: Float, n: int) -> Float:
    """[S, A] to [G, n, A]."""
    samples, agents = errors.shape
    if not 1 <= n <= samples:
        raise ValueError(f"best of {n} needs at least {n} samples; there are {samples}")
    groups = samples // n
    return errors[: groups * n].reshape(groups, n, agents)  # [G, n, A]


def sorted_slices(errors: Float, slices: int) -> Float:
    """The distribution of sample errors in short: sorted, in equal slices, the mean of each.

    Samples left over by the division are spread over the slices. The slices' mean is that of
    the errors (exactly, where nothing is left over).

    Args:
        errors: [S, A] of each sample.
        slices: Q, at most; with fewer samples each is one.

    Returns:
        [A, Q] ascending.
    """
    parts = np.array_split(np.sort(errors, axis=0), min(slices, len(errors)))
    kept: Float = np.stack([part.mean(axis=0) for part in parts], axis=1)
    return kept


def brier_final_displacement(probability: Float, mode_distance: Float) -> Float:
    """brier-minFDE: FDE of the best mode, plus (1 - its probability)^2 (Argoverse 2).

    Only the five most probable modes compete; their probabilities are renormalised.

    Args:
        probability: [A, Z] of the modes.
        mode_distance: [Z, A, H] displacement of each mode's mean, metres.

    Returns:
        [A] metres plus a number without unit.
    """
    final = final_displacement(mode_distance).T  # [A, Z]
    order = np.argsort(-probability, axis=1, kind="stable")[:, :BRIER_MODES]
    likely = np.take_along_axis(probability, order, axis=1)  # [A, up to 5]
    likely = likely / likely.sum(axis=1, keepdims=True)
    errors = np.take_along_axis(final, order, axis=1)
    best = errors.argmin(axis=1)[:, None]
    error = np.take_along_axis(errors, best, axis=1)[:, 0]
    doubt = 1.0 - np.take_along_axis(likely, best, axis=1)[:, 0]
    score: Float = error + doubt * doubt
    return score


def energy_score(samples: NDArray[np.floating], truth: Float) -> Float:
    """Energy score of the whole trajectory (Gneiting & Raftery 2007): E|Y - y| - E|Y - Y'| / 2.

    Norms are Euclidean over all known steps together; the second mean is over pairs of
    different samples, so that the score's expectation does not depend on their number.

    Args:
        samples: [S, A, H, 2] metres, independent.
        truth: [A, H, 2] metres, NaN where not known.

    Returns:
        [A] metres, lower is better; NaN where nothing is known.
    """
    known = ~np.isnan(truth[..., 0])  # [A, H]
    off = np.where(known[..., None], samples - truth, 0.0)  # [S, A, H, 2]
    count = len(samples)
    off = off.transpose(1, 0, 2, 3).reshape(len(truth), count, -1)  # [A, S, 2 H]
    square = np.einsum("asi,asi->as", off, off)  # [A, S]
    score = np.sqrt(square).mean(axis=1)  # [A]
    if count > 1:
        gram = off @ off.transpose(0, 2, 1)  # [A, S, S]
        between = square[:, :, None] + square[:, None, :] - 2.0 * gram
        spread = np.sqrt(np.maximum(between, 0.0))
        diagonal = np.arange(count)
        spread[:, diagonal, diagonal] = 0.0
        score = score - 0.5 * spread.sum(axis=(1, 2)) / (count * (count - 1))
    energy: Float = np.where(known.any(axis=1), score, np.nan)
    return energy


def collision_share(samples: NDArray[np.floating], now: Float) -> Float:
    """How often an agent's sampled path collides with another agent's of the same sample.

    Both walk straight from step to step, beginning where they are now; they collide when they
    come nearer than 0.1 m to each other.

    Args:
        samples: [S, A, H, 2] metres.
        now: [A, 2] metres, the newest observed positions.

    Returns:
        [A] share of (sample, other agent) pairs; NaN for an agent that is alone.
    """
    agents = samples.shape[1]
    if agents < 2:
        return np.full(agents, np.nan)
    start = np.broadcast_to(now, (len(samples), agents, 2))[:, :, None]  # [S, A, 1, 2]
    paths = np.concatenate([start, samples], axis=2)  # [S, A, H + 1, 2]
    collisions = np.zeros(agents, dtype=np.int64)
    for pairs in _runs_of_pairs(agents, max(1, _CELLS // paths[:, 0].size)):
        offset = paths[:, pairs[:, 0]] - paths[:, pairs[:, 1]]  # [S, P, H + 1, 2]
        collided = (_square_gap(offset) < COLLISION_DISTANCE_M**2).any(axis=2)  # [S, P]
        np.add.at(collisions, pairs, collided.sum(axis=0)[:, None])
    share: Float = collisions / (len(samples) * (agents - 1))
    return share


def _runs_of_pairs(agents: int, length: int) -> Iterator[NDArray[np.int64]]:
    """[P, 2] indices of two agents: every pair once, at most ``length`` of them at a time."""
    pairs = combinations(range(agents), 2)
    while run := list(islice(pairs, length)):
        yield np.array(run)


def _square_gap(offset: Float) -> Float:
    """How near two come who walk straight from step to step.

    Args:
        offset: [S, P, H + 1, 2] metres, from one to the other at every step.

    Returns:
        [S, P, H] square metres, between each step and the next.
    """
    begin, stride = offset[:, :, :-1], np.diff(offset, axis=2)  # [S, P, H, 2]
    length = np.einsum("sphi,sphi->sph", stride, stride)
    along = -np.einsum("sphi,sphi->sph", begin, stride)
    nearest_at = np.divide(along, length, out=np.zeros_like(along), where=length > 0.0)
    nearest = begin + np.clip(nearest_at, 0.0, 1.0)[..., None] * stride
    gap: Float = np.einsum("sphi,sphi->sph", nearest, nearest)
    return gap
