"""Positions from velocities, the bound on speed, and how uncertainty grows."""

from __future__ import annotations

import torch

from trajectron_model.integration import integrate, limit_speed, walk


def test_integrating_true_velocities_gives_true_positions() -> None:
    track = torch.tensor([[0.0, 0.0], [0.5, 0.1], [0.9, 0.4], [1.0, 1.0]], dtype=torch.float64)
    velocity = track.diff(dim=0) / 0.4
    torch.testing.assert_close(integrate(velocity, 0.4), track[1:] - track[0])


def test_only_speeds_above_the_limit_are_scaled_down() -> None:
    velocity = torch.tensor([[3.0, 4.0], [0.3, 0.4], [0.0, 0.0]])
    limited = limit_speed(velocity, 2.5)
    torch.testing.assert_close(limited, torch.tensor([[1.5, 2.0], [0.3, 0.4], [0.0, 0.0]]))


def test_a_limit_of_zero_means_standing_still() -> None:
    assert limit_speed(torch.tensor([3.0, 4.0]), 0.0).tolist() == [0.0, 0.0]


def test_position_covariance_is_that_of_a_random_walk_in_velocity() -> None:
    dt, steps, count = 0.4, 6, 400_000
    factor = torch.tensor([[0.3, 0.0], [0.2, 0.1]])
    noise = torch.randn(count, steps, 2, generator=torch.Generator().manual_seed(0)) @ factor.T
    position = integrate(noise.cumsum(dim=1), dt)
    increment = (factor @ factor.T)[[0, 0, 1], [0, 1, 1]]
    moments = walk(increment.expand(steps, 3), dt)
    for step, expected in enumerate(moments):
        found = position[:, step].T.cov()[[0, 0, 1], [0, 1, 1]]
        torch.testing.assert_close(found, expected, rtol=0.02, atol=1e-4)
