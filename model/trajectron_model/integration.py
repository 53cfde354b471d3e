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


class RandomWalk:
    """Moments of position when velocity is a random walk whose increments are independent.

    With v_t = v_{t-1} + d_t and x_t = x_{t-1} + v_t dt, the covariance of (x, v) is carried
    exactly, so errors of successive velocities correlate. Holding velocities independent
    instead would be under-dispersed: variances would grow with t and not with t^3.
    """

    def __init__(self, dt_s: float, like: Tensor) -> None:
        """Starts at a known position and velocity; covariances are [..., 3] like ``like``."""
        self.dt_s = dt_s
        self.position_cov = like.new_zeros(like.shape)
        self.cross_cov = like.new_zeros(like.shape)
        self.velocity_cov = like.new_zeros(like.shape)

    def step(self, increment_cov: Tensor) -> Tensor:
        """Adds one increment of covariance [..., 3] (m/s)^2; returns the position's, m^2."""
        dt = self.dt_s
        self.velocity_cov = self.velocity_cov + increment_cov
        self.position_cov = (
            self.position_cov + 2.0 * dt * self.cross_cov + dt * dt * self.velocity_cov
        )
        self.cross_cov = self.cross_cov + dt * self.velocity_cov
        return self.position_cov
