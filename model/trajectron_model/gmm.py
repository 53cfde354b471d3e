"""A mixture of bivariate Gaussians, in the manner of torch.distributions.

batch_shape [...], event_shape [2], M components.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


class BivariateMixture(NamedTuple):
    """sum_m w_m N(mean_m, covariance_m) with standard deviations and a correlation each."""

    log_weights: Tensor  # [..., M], normalised
    mean: Tensor  # [..., M, 2]
    scale: Tensor  # [..., M, 2], positive
    correlation: Tensor  # [..., M], in (-1, 1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density [...] in nats of values [..., 2]."""
        u = (value.unsqueeze(-2) - self.mean) / self.scale  # [..., M, 2]
        rho = self.correlation
        rest = 1.0 - rho.square()
        quadratic = (u[..., 0].square() - 2.0 * rho * u[..., 0] * u[..., 1]) + u[..., 1].square()
        log_norm = self.scale.log().sum(dim=-1) + 0.5 * rest.log() + math.log(2.0 * math.pi)
        return torch.logsumexp(self.log_weights - 0.5 * quadratic / rest - log_norm, dim=-1)

    def covariance(self) -> Tensor:
        """[..., M, 3]: xx, xy, yy of each component."""
        sx, sy = self.scale.unbind(dim=-1)
        return torch.stack([sx.square(), self.correlation * sx * sy, sy.square()], dim=-1)

    def moments(self) -> tuple[Tensor, Tensor]:
        """Mean [..., 2] and covariance [..., 3] of the whole mixture."""
        return merge_moments(self.log_weights.exp(), self.mean, self.covariance())


def choose(weights: Tensor, uniform: Tensor) -> Tensor:
    """The index [...] at which the cumulated weights [..., M] pass ``uniform`` [...]."""
    edges = weights.cumsum(dim=-1)
    # Measured against their own total: weights sum to one but for rounding.
    below = edges <= uniform.unsqueeze(-1) * edges[..., -1:]
    return below.sum(dim=-1).clamp_max(weights.shape[-1] - 1)


def correlated(mean: Tensor, scale: Tensor, rho: Tensor, normal: Tensor) -> Tensor:
    """Bivariate Gaussian values [..., 2] from standard normals [..., 2] (Cholesky factor)."""
    first, second = normal.unbind(dim=-1)
    mixed = rho * first + (1.0 - rho.square()).sqrt() * second
    return mean + scale * torch.stack([first, mixed], dim=-1)


def merge_moments(weights: Tensor, mean: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Moments of a mixture from those of its parts.

    Args:
        weights: [..., M], summing to one.
        mean: [..., M, 2].
        covariance: [..., M, 3].

    Returns:
        mean [..., 2] and covariance [..., 3].
    """
    w = weights.unsqueeze(-1)
    centre = (w * mean).sum(dim=-2)
    off = mean - centre.unsqueeze(-2)
    spread = torch.stack(
        [off[..., 0].square(), off[..., 0] * off[..., 1], off[..., 1].square()], dim=-1
    )
    return centre, (w * (covariance + spread)).sum(dim=-2)
