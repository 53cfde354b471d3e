"""Densities: against scipy, against Gaussians whose regions are known, on the awkward cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from trajectron_model.evaluation.densities import (
    LEVELS,
    LOG_DENSITY_FLOOR,
    highest_density_regions,
    kde_log_density,
    kde_regions,
    mixture_log_density,
)
from trajectron_model.predictor import PositionMixture

ROUND = (1.0, 0.0, 1.0)


def gaussian(
    agents: int = 1,
    mean: tuple[float, float] = (0.0, 0.0),
    covariance: tuple[float, float, float] = ROUND,
) -> PositionMixture:
    """One Gaussian, one step, the same for all agents."""
    return PositionMixture(
        np.ones((agents, 1)),
        np.tile(np.array(mean), (agents, 1, 1, 1)),
        np.tile(np.array(covariance), (agents, 1, 1, 1)),
    )


def test_the_density_of_a_standard_normal_at_its_mean() -> None:
    found = mixture_log_density(gaussian(), np.zeros((1, 1, 2)))
    assert found.tolist() == [[pytest.approx(-math.log(2.0 * math.pi))]]


def test_the_density_of_a_mixture_is_scipys() -> None:
    random = np.random.default_rng(0)
    factor = random.normal(size=(3, 4, 2, 2, 2))  # [A, Z, H, 2, 2]
    full = factor @ factor.swapaxes(-1, -2) + 0.1 * np.eye(2)
    mean = random.normal(size=(3, 4, 2, 2)) + 500.0
    probability = random.dirichlet(np.ones(4), size=3)
    covariance = np.stack([full[..., 0, 0], full[..., 0, 1], full[..., 1, 1]], axis=-1)
    at = random.normal(size=(3, 2, 2)) + 500.0
    found = mixture_log_density(PositionMixture(probability, mean, covariance), at)
    for agent in range(3):
        for step in range(2):
            expected = sum(
                probability[agent, mode]
                * stats.multivariate_normal(mean[agent, mode, step], full[agent, mode, step]).pdf(
                    at[agent, step]
                )
                for mode in range(4)
            )
            assert found[agent, step] == pytest.approx(math.log(expected), rel=1e-9)


def test_a_mode_without_probability_weighs_nothing() -> None:
    pair = PositionMixture(
        np.array([[1.0, 0.0]]),
        np.array([[[[0.0, 0.0]], [[3.0, 0.0]]]]),
        np.array([[[ROUND], [ROUND]]]),
    )
    at = np.array([[[0.5, 0.5]]])
    assert mixture_log_density(pair, at) == pytest.approx(mixture_log_density(gaussian(), at))
    far = np.array([[[1e4, 0.0]]])
    assert mixture_log_density(pair, far)[0, 0] == pytest.approx(-0.5e8 - math.log(2 * math.pi))
    assert np.isnan(mixture_log_density(pair, np.full((1, 1, 2), np.nan))).all()


def test_the_kernel_estimate_is_scipys() -> None:
    random = np.random.default_rng(1)
    samples = random.normal(size=(60, 2, 3, 2)) @ np.array([[2.0, 0.5], [0.0, 0.3]])
    truth = random.normal(size=(2, 3, 2))
    found = kde_log_density(samples, truth)
    for agent in range(2):
        for step in range(3):
            kernel = stats.gaussian_kde(samples[:, agent, step].T)
            expected = kernel.logpdf(truth[agent, step])[0]
            assert found[agent, step] == pytest.approx(max(expected, -20.0), rel=1e-9)


def test_the_kernel_estimate_is_floored_and_silent_where_nothing_is_known() -> None:
    samples = np.random.default_rng(2).normal(size=(30, 1, 2, 2))
    truth = np.array([[[100.0, 0.0], [np.nan, np.nan]]])
    found = kde_log_density(samples, truth)
    assert found[0, 0] == LOG_DENSITY_FLOOR == -20.0
    assert np.isnan(found[0, 1])


@pytest.mark.parametrize("spread", [(0.0, 0.0), (1.0, 0.0), (1.0, 2.0)])
def test_samples_on_a_point_or_on_a_line_have_no_density(spread: tuple[float, float]) -> None:
    line = np.linspace(-1.0, 1.0, 50)[:, None, None, None] * np.array(spread) + 7.3
    assert kde_log_density(line, np.full((1, 1, 2), 7.3)).tolist() == [[-20.0]]
    regions = kde_regions(line, np.full((1, 1, 2), 7.3), np.random.default_rng(0))
    assert regions.covered.tolist() == [[[0.0]]] * len(LEVELS)
    assert regions.area_m2.tolist() == [[[0.0]]] * len(LEVELS)


def test_regions_of_a_gaussian_are_the_ellipses_one_knows() -> None:
    # The region of level p ends where the squared Mahalanobis distance is -2 log(1 - p).
    agents, spread = 400, (4.0, 1.0, 1.0)
    mixture = gaussian(agents, covariance=spread)
    at_distance_one = np.array([2.0, 0.5])  # (4, 1) / 2: a column of the covariance over sigma
    for index, level in enumerate(LEVELS):
        radius = math.sqrt(-2.0 * math.log(1.0 - level))
        for factor, least, most in ((0.8, 0.98, 1.0), (1.2, 0.0, 0.02)):
            truth = np.tile(factor * radius * at_distance_one, (agents, 1, 1))
            regions = highest_density_regions(mixture, truth, np.random.default_rng(3))
            assert least <= regions.covered[index].mean() <= most
        area = math.pi * radius**2 * math.sqrt(4.0 * 1.0 - 1.0)
        assert regions.area_m2[index].mean() == pytest.approx(area, rel=0.03)


def test_a_calibrated_forecast_is_covered_as_often_as_its_levels_say() -> None:
    random = np.random.default_rng(4)
    agents, horizon = 3000, 2
    probability = np.tile([0.7, 0.3], (agents, 1))
    means = np.tile(np.array([[-2.0, 0.0], [3.0, 1.0]])[:, None], (agents, 1, horizon, 1))
    covariance = np.tile(np.array([0.5, 0.2, 1.0]), (agents, 2, horizon, 1))
    mode = (random.random((agents, horizon)) > 0.7).astype(int)
    factor = np.linalg.cholesky(np.array([[0.5, 0.2], [0.2, 1.0]]))
    centre = np.array([[-2.0, 0.0], [3.0, 1.0]])[mode]
    truth = centre + random.normal(size=(agents, horizon, 2)) @ factor.T
    mixture = PositionMixture(probability, means, covariance)
    regions = highest_density_regions(mixture, truth, random)
    for level, covered in zip(LEVELS, regions.covered, strict=True):
        assert covered.mean() == pytest.approx(level, abs=0.02)


def test_regions_do_not_depend_on_where_the_scene_is() -> None:
    near, far = gaussian(20), gaussian(20, mean=(5e5, 4e6))
    truth = np.random.default_rng(5).normal(size=(20, 1, 2))
    here = highest_density_regions(near, truth, np.random.default_rng(6))
    there = highest_density_regions(far, truth + np.array([5e5, 4e6]), np.random.default_rng(6))
    np.testing.assert_array_equal(here.covered, there.covered)
    np.testing.assert_allclose(here.area_m2, there.area_m2, rtol=1e-4)


def test_regions_of_samples_are_those_of_what_they_were_drawn_from() -> None:
    random = np.random.default_rng(7)
    samples = random.normal(size=(100, 300, 1, 2))
    truth = random.normal(size=(300, 1, 2))
    regions = kde_regions(samples, truth, random)
    # A kernel estimate is a little wider than its source: by the bandwidth, Scott's 0.46.
    assert 0.78 < regions.covered[1].mean() < 0.95
    area = -2.0 * math.pi * math.log(1.0 - 0.8)
    assert area < regions.area_m2[1].mean() < 1.35 * area


def test_an_unknown_truth_is_neither_covered_nor_missed() -> None:
    regions = highest_density_regions(
        gaussian(2), np.array([[[0.0, 0.0]], [[np.nan, np.nan]]]), np.random.default_rng(0)
    )
    assert regions.covered[3, 0, 0] == 1.0
    assert np.isnan(regions.covered[:, 1]).all()
    assert np.isfinite(regions.area_m2).all()
