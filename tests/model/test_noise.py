"""Noise follows from seed, agent, step and sampling, and from nothing else.

Of stratified noise: each sample alone is distributed as an independent one, and the samples
of an agent together are more even.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special, stats
from scipy.stats import qmc

from trajectron_model.noise import AgentNoise, Sampling, agent_noise, scene_noise

BOTH = pytest.mark.parametrize("sampling", ["iid", "stratified"])
SEEDS, SAMPLES, HORIZON = 2000, 5, 4


def flat(noise: AgentNoise) -> np.ndarray:
    return np.concatenate([column.ravel() for column in noise])


def as_uniform(noise: AgentNoise) -> NDArray[np.float64]:
    """[S, 2 + 3 H] every number of every sample, normals through their distribution function."""
    normal = special.ndtr(noise.normal.astype(np.float64)).reshape(len(noise.latent), -1)
    return np.column_stack([noise.latent, noise.turn, noise.component, normal])


def path_end(noise: AgentNoise) -> NDArray[np.float64]:
    """[S, 2] standard normal: where changes of velocity of the same size take a path."""
    weights = np.arange(noise.normal.shape[1], 0.0, -1.0)
    end: NDArray[np.float64] = np.einsum("t,sti->si", weights, noise.normal)
    return end / np.linalg.norm(weights)


@pytest.fixture(scope="module")
def many() -> NDArray[np.float64]:
    """[seeds, S, 2 + 3 H] stratified noise of one agent, as uniform numbers."""
    return np.stack(
        [
            as_uniform(agent_noise(seed, "a", 3, SAMPLES, HORIZON, "stratified"))
            for seed in range(SEEDS)
        ]
    )


@BOTH
def test_the_same_key_gives_the_same_noise(sampling: Sampling) -> None:
    one, same = (flat(agent_noise(7, "a", 8, 20, 12, sampling)) for _ in range(2))
    assert (one == same).all()


@BOTH
@pytest.mark.parametrize("other", [(8, "a", 8), (7, "b", 8), (7, "a", 9), (2**62, "a", 8)])
def test_another_seed_agent_or_step_gives_other_noise(
    other: tuple[int, str, int], sampling: Sampling
) -> None:
    first = agent_noise(7, "a", 8, 100, 12, sampling).normal.ravel()
    second = agent_noise(*other, 100, 12, sampling).normal.ravel()
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.1


def test_a_seed_and_a_step_are_not_interchangeable() -> None:
    assert (flat(agent_noise(1, "a", 2, 5, 3)) != flat(agent_noise(2, "a", 1, 5, 3))).any()


def test_ids_may_be_any_text() -> None:
    assert agent_noise(0, "Ä–人", 0, 2, 2).normal.shape == (2, 2, 2)


@BOTH
@pytest.mark.parametrize("samples", [7, 1200])
def test_a_scenes_agents_get_the_noise_that_each_has_alone(
    samples: int, sampling: Sampling
) -> None:
    ids = ("a", "b", "c", "d")
    together = scene_noise(7, ids, 8, samples, 5, sampling)
    for row, agent in enumerate(ids):
        alone = agent_noise(7, agent, 8, samples, 5, sampling)
        for one, other in zip(alone, together, strict=True):
            np.testing.assert_allclose(one, other[row], rtol=0.0, atol=1e-6)


@BOTH
@pytest.mark.parametrize(("samples", "horizon"), [(1, 1), (1, 12), (7, 1), (2000, 60)])
def test_any_number_of_samples_and_steps(samples: int, horizon: int, sampling: Sampling) -> None:
    noise = agent_noise(5, "a", 1, samples, horizon, sampling)
    assert noise.latent.shape == noise.turn.shape == (samples,)
    assert noise.component.shape == (samples, horizon)
    assert noise.normal.shape == (samples, horizon, 2)
    assert all(column.dtype == np.float32 and np.isfinite(column).all() for column in noise)


@BOTH
def test_noise_is_uniform_and_normal(sampling: Sampling) -> None:
    noise = agent_noise(3, "a", 0, 2000, 12, sampling)
    assert stats.kstest(noise.component.ravel(), "uniform").pvalue > 1e-3
    assert stats.kstest(noise.normal.ravel(), "norm").pvalue > 1e-3
    assert 0.0 <= min(c.min() for c in noise[:3]) <= max(c.max() for c in noise[:3]) < 1.0


@pytest.mark.parametrize("sample", [0, 2, SAMPLES - 1])
def test_each_stratified_sample_alone_is_uniform(many: NDArray[np.float64], sample: int) -> None:
    found = [stats.kstest(many[:, sample, d], "uniform").pvalue for d in range(many.shape[2])]
    assert min(found) > 1e-3


def test_the_numbers_of_one_stratified_sample_are_independent(many: NDArray[np.float64]) -> None:
    correlation = np.corrcoef(many[:, 0], rowvar=False) - np.eye(many.shape[2])
    assert np.abs(correlation).max() < 4.5 / np.sqrt(SEEDS)
    # Which a dependence without correlation would show: latent value against the leading normals.
    latent, first = np.floor(4.0 * many[:, 0, [0, -8]]).astype(int).T
    counts = np.bincount(4 * latent + first, minlength=16)
    assert stats.chisquare(counts).pvalue > 1e-3


def test_stratified_agents_are_independent(many: NDArray[np.float64]) -> None:
    other = [
        as_uniform(agent_noise(seed, "b", 3, SAMPLES, HORIZON, "stratified"))[1]
        for seed in range(SEEDS)
    ]
    between = np.corrcoef(many[:, 0], np.array(other), rowvar=False)[14:, :14]
    assert np.abs(between).max() < 4.5 / np.sqrt(SEEDS)


@pytest.mark.parametrize("samples", [1, 3, 20, 100])
def test_stratified_latent_values_come_in_their_shares(samples: int) -> None:
    """Whatever interval stands for a value: it is hit as often as its width says, within one."""
    latent = agent_noise(11, "a", 2, samples, 12, "stratified").latent
    for low, high in ((0.0, 0.3), (0.25, 0.75), (0.61, 0.97), (0.5, 1.0)):
        hit = np.count_nonzero((low <= latent) & (latent < high))
        assert abs(hit - samples * (high - low)) < 1.0 + 1e-4 * samples


def test_stratified_turns_and_components_have_one_sample_in_each_part_of_their_range() -> None:
    noise = agent_noise(11, "a", 2, 20, 12, "stratified")
    for column in (noise.turn, *noise.component.T):
        assert sorted(np.floor(20.0 * column.astype(np.float64)).astype(int)) == list(range(20))


def test_stratified_samples_come_in_no_order() -> None:
    """So that the first few of them are no worse than a few others."""
    rank = [agent_noise(s, "a", 0, 20, 1, "stratified").latent[[0, 1]] for s in range(500)]
    first, second = np.array(rank).T
    assert abs(np.mean(first < second) - 0.5) < 0.1
    assert np.mean(np.abs(first - second) > 0.1) > 0.7


def test_latent_values_and_ends_of_paths_are_evenly_spread_together() -> None:
    def uneven(agent: str, sampling: Sampling) -> float:
        noise = agent_noise(1, agent, 0, 20, 12, sampling)
        points = np.column_stack([noise.latent, special.ndtr(path_end(noise))])
        return float(qmc.discrepancy(points))

    iid, stratified = (
        np.array([uneven(str(a), kind) for a in range(50)]) for kind in ("iid", "stratified")
    )
    assert stratified.max() < np.median(iid)
    assert np.median(stratified) < 0.4 * np.median(iid)


def test_means_of_stratified_samples_vary_less() -> None:
    def spread(sampling: Sampling) -> float:
        ends = [path_end(agent_noise(s, "a", 0, 20, 12, sampling)).mean(axis=0) for s in range(300)]
        return float(np.var(ends))

    assert spread("iid") == pytest.approx(1.0 / 20.0, rel=0.25)
    assert spread("stratified") < 0.1 * spread("iid")
