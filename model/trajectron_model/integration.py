"""Single-integrator dynamics: positions from velocities, and the bound on speed.

X_t = X_{t-1} + U_t dt (paper, section 4), with targets U_t = (X_t - X_{t-1}) / dt, so that
integrating the true velocities gives the true positions.
"""

from __future__ import annotations

from torch import Tensor


def integrate(velocity: Tensor, dt_s: float) -> Tensor:
    """Offsets from the last position [..., H, 2] in metres from velocities [..., H, 2] in m/s."""
    return velocity.cumsum(dim=-2) * dt_s


def limit_speed(velocity: Tensor, limit: float) -> Tensor:
    """Velocities [..., 2] scaled down to at most ``limit``, in their unit, where they exceed it."""
    speed = velocity.square().sum(dim=-1).sqrt()
    factor = (limit / speed.clamp_min(1e-9)).clamp_max(1.0)
    return velocity * factor.unsqueeze(-1)


def walk(increment_cov: Tensor, dt_s: float) -> Tensor:
    """Moments of position when velocity is a random walk whose increments are independent.

    With v_t = v_{t-1} + d_t and x_t = x_{t-1} + v_t dt, the increment at step r counts
    k = t - r + 1 times in x_t, so the position's covariance is dt^2 times the sum over r of
    k^2 cov(d_r). Cumulated sums of cumulated sums weigh by k, and once more by k (k + 1) / 2.
    Holding velocities independent instead would be under-dispersed: variances would grow with
    t and not with t^3.

    Args:
        increment_cov: [..., H, 3] (m/s)^2 of each step.
        dt_s: of a step.

    Returns:
        [..., H, 3] m^2.
    """
    by_k = increment_cov.cumsum(dim=-2).cumsum(dim=-2)
    return (2.0 * by_k.cumsum(dim=-2) - by_k) * (dt_s * dt_s)
