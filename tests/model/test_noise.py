"""Noise follows from seed, agent and step, and from nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from trajectron_model.noise import AgentNoise, agent_noise


def flat(noise: AgentNoise) -> np.ndarray:
    return np.concatenate([column.ravel() for column in noise])


def test_the_same_key_gives_the_same_noise() -> None:
    assert (flat(agent_noise(7, "a", 8, 20, 12)) == flat(agent_noise(7, "a", 8, 20, 12))).all()


@pytest.mark.parametrize("other", [(8, "a", 8), (7, "b", 8), (7, "a", 9), (2**62, "a", 8)])
def test_another_seed_agent_or_step_gives_other_noise(other: tuple[int, str, int]) -> None:
    first, second = flat(agent_noise(7, "a", 8, 20, 12)), flat(agent_noise(*other, 20, 12))
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.15


def test_a_seed_and_a_step_are_not_interchangeable() -> None:
    assert (flat(agent_noise(1, "a", 2, 5, 3)) != flat(agent_noise(2, "a", 1, 5, 3))).any()


def test_ids_may_be_any_text() -> None:
    assert agent_noise(0, "Ä–人", 0, 2, 2).normal.shape == (2, 2, 2)


def test_noise_is_uniform_and_normal() -> None:
    noise = agent_noise(3, "a", 0, 2000, 12)
    assert stats.kstest(noise.component.ravel(), "uniform").pvalue > 1e-3
    assert stats.kstest(noise.normal.ravel(), "norm").pvalue > 1e-3
    assert 0.0 <= min(c.min() for c in noise[:3]) <= max(c.max() for c in noise[:3]) < 1.0
