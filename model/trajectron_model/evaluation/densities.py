"""Densities over position: the analytic mixture, kernel estimates, highest-density regions.

Everything is per agent and step; log densities are in nats, of positions in metres.

Shape letters: S samples, A agents, H horizon steps, Z components, D draws, L levels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trajectron_model.predictor import PositionMixture

Float = NDArray[np.float64]

LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Probabilities of the highest-density regions whose coverage is measured."""

LOG_DENSITY_FLOOR = -20.0
"""Kernel estimates are not read below this (Ivanovic & Pavone 2019)."""

DRAWS = 199
"""Points drawn from each density to rank the truth's: with 199, ranks 0 to 199 are equally
likely under a calibrated forecast and every level is a whole number of them."""

_SINGULAR = 1e-14
_CELLS = 4_000_000
"""Kernel values held at a time: 16 MB in single precision."""


class Regions(NamedTuple):
    """The truth against the highest-density regions of a forecast."""

    covered: Float  # [L, A, H] 1 where the truth lies in the region, 0 where not, NaN if unknown
    area_m2: Float  # [L, A, H] of the region


class _Kernels(NamedTuple):
    """Gaussians by the inverse of their Cholesky factor, ready to be evaluated."""

    mean: Float  # [A, H, Z, 2]
    xx: Float  # [A, H, Z] u = xx dx
    yx: Float  # v = yx dx + yy dy
    yy: Float
    log_weight: Float  # [A, H, Z] log of probability over the norm


def mixture_log_density(mixture: PositionMixture, positions: Float) -> Float:
    """Log density of the whole mixture at a position for each agent and step.

    Args:
        mixture: of A agents.
        positions: [A, H, 2] metres; NaN gives NaN.

    Returns:
        [A, H] nats.
    """
    kernels = _kernels(mixture)
    off = positions[:, :, None, :] - kernels.mean  # [A, H, Z, 2]
    u = kernels.xx * off[..., 0]
    v = kernels.yx * off[..., 0] + kernels.yy * off[..., 1]
    return _log_sum_exp(kernels.log_weight - 0.5 * (u * u + v * v))


def kde_log_density(samples: NDArray[np.floating], positions: Float) -> Float:
    """Log density of a Gaussian kernel estimate, as ``scipy.stats.gaussian_kde`` has it.

    Scott's bandwidth, kernels shaped as the samples' covariance; floored at -20. Samples on a
    point or on a line have no density: the floor.

    Args:
        samples: [S, A, H, 2] metres, S >= 2.
        positions: [A, H, 2] metres; NaN gives NaN.

    Returns:
        [A, H] nats.
    """
    count = len(samples)
    covariance, degenerate = _kernel_covariance(samples)
    xx, yx, yy, log_norm = _whitening(covariance)
    dx = positions[..., 0] - samples[..., 0]  # [S, A, H]
    dy = positions[..., 1] - samples[..., 1]
    u, v = xx * dx, yx * dx + yy * dy
    exponent = -0.5 * (u * u + v * v)
    log_density = _log_sum_exp(np.moveaxis(exponent, 0, -1)) - math.log(count) - log_norm
    log_density = np.where(degenerate, LOG_DENSITY_FLOOR, log_density)
    floored = np.maximum(log_density, LOG_DENSITY_FLOOR)
    known: Float = np.where(np.isnan(positions[..., 0]), np.nan, floored)
    return known


def _kernel_covariance(samples: NDArray[np.floating]) -> tuple[Float, NDArray[np.bool_]]:
    """Covariance of the kernels [A, H, 3], the unit's where the samples' is singular; which are."""
    count = len(samples)
    off = samples - samples.mean(axis=0)  # [S, A, H, 2]
    x, y = off[..., 0], off[..., 1]
    scott = count ** (-1.0 / 6.0)  # n^(-1 / (d + 4)) in two dimensions
    covariance = np.stack([(x * x).sum(0), (x * y).sum(0), (y * y).sum(0)], axis=-1)
    covariance *= scott**2 / (count - 1)
    determinant = covariance[..., 0] * covariance[..., 2] - covariance[..., 1] ** 2
    trace = covariance[..., 0] + covariance[..., 2]
    # Relative to the trace; an absolute bound too, for points that are equal but for rounding.
    degenerate = (determinant <= _SINGULAR * trace**2) | (trace < _SINGULAR)
    covariance[degenerate] = (1.0, 0.0, 1.0)
    return covariance, degenerate


def highest_density_regions(
    mixture: PositionMixture, truth: Float, random: np.random.Generator
) -> Regions:
    """Whether the truth lies in the smallest regions that hold 50, 80, 90, 95% of a mixture.

    The density at the truth is ranked among those at points drawn from the mixture: the truth
    is in the region of level p when fewer than p (D + 1) draws are denser. The area is that of
    the points as dense as the draw of that rank, by importance sampling.

    Args:
        mixture: of A agents.
        truth: [A, H, 2] metres, NaN where not known.
        random: of the draws.
    """
    kernels = _kernels(mixture)
    points = _draw(mixture, random)  # [A, H, D, 2]
    every = np.concatenate([np.nan_to_num(truth)[:, :, None], points], axis=2)
    density = _density(kernels, every)  # [A, H, 1 + D]
    known = ~np.isnan(truth[..., 0])
    rank = (density[..., 1:] > density[..., :1]).sum(axis=-1)  # [A, H]
    falling = -np.sort(-density[..., 1:], axis=-1)  # [A, H, D]
    inverse = 1.0 / np.maximum(falling, np.finfo(np.float32).tiny)
    cumulated = np.cumsum(inverse, axis=-1, dtype=np.float64)
    covered, area = [], []
    for level in LEVELS:
        within = round(level * (DRAWS + 1))
        covered.append(np.where(known, rank < within, np.nan))
        # The draws before that rank are independent ones from inside the region.
        share = within / (DRAWS + 1)
        area.append(share * cumulated[..., within - 2] / (within - 1))
    return Regions(np.stack(covered), np.stack(area))


def kde_regions(
    samples: NDArray[np.floating], truth: Float, random: np.random.Generator
) -> Regions:
    """`highest_density_regions` of a kernel estimate of samples.

    Where samples have no density (all in one place) nothing is covered, on an area of zero.

    Args:
        samples: [S, A, H, 2] metres, S >= 2.
        truth: [A, H, 2] metres, NaN where not known.
        random: of the draws.
    """
    covariance, degenerate = _kernel_covariance(samples)  # [A, H, 3], [A, H]
    count, agents = len(samples), samples.shape[1]
    kernels = np.broadcast_to(covariance[:, None], (agents, count, *covariance.shape[1:]))
    mean = samples.transpose(1, 0, 2, 3).astype(np.float64, copy=False)
    mixture = PositionMixture(np.full((agents, count), 1.0 / count), mean, kernels)
    regions = highest_density_regions(mixture, truth, random)
    known = ~np.isnan(truth[..., 0])
    return Regions(
        np.where(degenerate & known, 0.0, regions.covered),
        np.where(degenerate, 0.0, regions.area_m2),
    )


def _draw(mixture: PositionMixture, random: np.random.Generator) -> Float:
    """[A, H, D, 2] points, independent for every agent and step."""
    agents, values, horizon, _ = mixture.mean.shape
    edges = np.cumsum(mixture.probability, axis=1)  # [A, Z]
    # One table for all agents: the n-th one's edges lie between n and n + 1.
    each = np.arange(agents)[:, None]
    table = (each + edges / edges[:, -1:]).ravel()
    uniform = each + random.random((agents, horizon * DRAWS))
    component = np.searchsorted(table, uniform.ravel(), side="right").reshape(uniform.shape)
    component = np.clip(component - each * values, 0, values - 1).reshape(agents, horizon, DRAWS)
    rows = np.arange(agents)[:, None, None], component, np.arange(horizon)[:, None]
    mean, covariance = mixture.mean[rows], mixture.covariance[rows]  # [A, H, D, 2], [.., 3]
    normal = random.standard_normal((agents, horizon, DRAWS, 2))
    sx = np.sqrt(covariance[..., 0])
    xy = covariance[..., 1] / sx
    sy = np.sqrt(np.maximum(covariance[..., 2] - xy * xy, 0.0))
    mean[..., 0] += sx * normal[..., 0]
    mean[..., 1] += xy * normal[..., 0] + sy * normal[..., 1]
    points: Float = mean
    return points


def _density(kernels: _Kernels, points: Float) -> NDArray[np.float32]:
    """[A, H, D, 2] points to densities [A, H, D], 0 where they underflow: single precision."""
    agents, horizon, draws, _ = points.shape
    # Offsets from a place nearby keep single precision fit for coordinates of any size.
    centre = kernels.mean[:, :, :1]  # [A, H, 1, 2]
    points = (points - centre).astype(np.float32)
    mean = (kernels.mean - centre).astype(np.float32)
    xx, yx, yy, log_weight = (
        column.astype(np.float32)[:, :, None]
        for column in (kernels.xx, kernels.yx, kernels.yy, kernels.log_weight)
    )  # [A, H, 1, Z]
    density = np.empty((agents, horizon, draws), dtype=np.float32)
    run = max(1, _CELLS // (horizon * draws * mean.shape[2]))
    for first in range(0, agents, run):
        part = slice(first, first + run)
        dx = points[part, :, :, None, 0] - mean[part, :, None, :, 0]  # [run, H, D, Z]
        dy = points[part, :, :, None, 1] - mean[part, :, None, :, 1]
        dy *= yy[part]
        dy += yx[part] * dx
        dx *= xx[part]
        dx *= dx
        dy *= dy
        dx += dy
        dx *= -0.5
        dx += log_weight[part]
        density[part] = np.exp(dx, out=dx).sum(axis=-1)
    return density


def _kernels(mixture: PositionMixture) -> _Kernels:
    covariance = mixture.covariance.transpose(0, 2, 1, 3)  # [A, H, Z, 3]
    xx, yx, yy, log_norm = _whitening(covariance)
    with np.errstate(divide="ignore"):  # a mode of probability 0 weighs nothing
        log_weight = np.log(mixture.probability)[:, None, :] - log_norm
    return _Kernels(mixture.mean.transpose(0, 2, 1, 3), xx, yx, yy, log_weight)


def _whitening(covariance: Float) -> tuple[Float, Float, Float, Float]:
    """The inverse Cholesky factor of covariances [..., 3], and the log of the Gaussians' norm."""
    sx = np.sqrt(covariance[..., 0])
    xy = covariance[..., 1] / sx
    sy = np.sqrt(np.maximum(covariance[..., 2] - xy * xy, _SINGULAR * covariance[..., 2]))
    log_norm = math.log(2.0 * math.pi) + np.log(sx) + np.log(sy)
    return 1.0 / sx, -xy / (sx * sy), 1.0 / sy, log_norm


def _log_sum_exp(values: Float) -> Float:
    """Over the last axis; -inf where all are."""
    highest = values.max(axis=-1, keepdims=True)
    finite = np.where(np.isneginf(highest), 0.0, highest)
    with np.errstate(divide="ignore"):
        total: Float = np.log(np.exp(values - finite).sum(axis=-1)) + finite[..., 0]
    return total
