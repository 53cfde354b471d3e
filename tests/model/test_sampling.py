"""Stratified samples of the model: unbiased, in their modes' shares, the same in any company."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from trajectron_model.forecast import ForecastRequest, SceneForecast
from trajectron_model.noise import Sampling
from trajectron_model.state import SceneFrame, SceneState
from trajectron_model.trajectron import Trajectron

SceneMaker = Callable[..., list[SceneFrame]]
Fold = Callable[[Trajectron, list[SceneFrame]], SceneState]
SEEDS, SAMPLES = 300, 16


@pytest.fixture(scope="module")
def state(model: Trajectron, crowd: SceneMaker, fold: Fold) -> SceneState:
    return fold(model, crowd(missing=0.1))


def over_seeds(model: Trajectron, state: SceneState, sampling: Sampling) -> list[SceneForecast]:
    """Forecasts of one agent under many seeds."""
    requests = [
        ForecastRequest(
            num_samples=SAMPLES, horizon=5, seed=seed, agents=(state.ids[0],), sampling=sampling
        )
        for seed in range(SEEDS)
    ]
    return model.forecast([state] * SEEDS, requests)


@pytest.fixture(scope="module")
def drawn(model: Trajectron, state: SceneState) -> dict[str, list[SceneForecast]]:
    return {
        "iid": over_seeds(model, state, "iid"),
        "stratified": over_seeds(model, state, "stratified"),
    }


def ends(forecasts: list[SceneForecast]) -> NDArray[np.float64]:
    """[seeds, S, 2] offsets at the last step."""
    found = [one.samples[0, :, -1] for one in forecasts if one.samples is not None]
    return np.array(found, dtype=np.float64)


def assert_equal_within_error(one: NDArray[np.float64], other: NDArray[np.float64]) -> None:
    """Means over seeds [seeds, ...] differ by less than four of their standard errors."""
    error = np.sqrt(one.var(axis=0, ddof=1) / SEEDS + other.var(axis=0, ddof=1) / SEEDS)
    assert (np.abs(one.mean(axis=0) - other.mean(axis=0)) < 4.0 * error).all()


def test_stratified_samples_have_the_mean_and_covariance_of_independent_ones(
    drawn: dict[str, list[SceneForecast]],
) -> None:
    iid, stratified = ends(drawn["iid"]), ends(drawn["stratified"])
    assert_equal_within_error(stratified.mean(axis=1), iid.mean(axis=1))
    centre = iid.mean(axis=(0, 1))
    squares = [
        np.einsum("nsi,nsj->nij", x - centre, x - centre) / SAMPLES for x in (stratified, iid)
    ]
    assert_equal_within_error(*squares)


def test_estimates_from_stratified_samples_vary_less(
    drawn: dict[str, list[SceneForecast]],
) -> None:
    spread = {name: ends(found).mean(axis=1).var(axis=0) for name, found in drawn.items()}
    assert (spread["stratified"] < 0.7 * spread["iid"]).all()


def test_each_latent_value_comes_with_its_probability_and_in_its_share(
    drawn: dict[str, list[SceneForecast]],
) -> None:
    probability = drawn["stratified"][0].mode_probabilities[0].astype(np.float64)
    counts = np.array(
        [
            np.bincount(one.sample_modes[0], minlength=probability.size)
            for one in drawn["stratified"]
            if one.sample_modes is not None
        ]
    )
    assert np.abs(counts - SAMPLES * probability).max() < 1.0 + 1e-3
    error = np.sqrt(probability * (1.0 - probability) / (SAMPLES * SEEDS))
    assert (np.abs(counts.mean(axis=0) / SAMPLES - probability) < 4.0 * error + 1e-6).all()


def test_stratified_samples_do_not_depend_on_company_order_or_batch(
    model: Trajectron, crowd: SceneMaker, fold: Fold, state: SceneState
) -> None:
    def asked(*agents: str) -> ForecastRequest:
        return ForecastRequest(
            seed=11, step=14, agents=agents, num_samples=500, sampling="stratified"
        )

    others = [fold(model, crowd(seed=s, agents=a)) for s, a in ((7, 3), (8, 20))]
    [alone] = model.forecast([state], [asked("4")])
    batch = model.forecast(
        [others[0], state, others[1]],
        [
            ForecastRequest(seed=1, num_samples=33),
            asked("9", "4", "2"),
            ForecastRequest(mode="gmm"),
        ],
    )[1]
    assert alone.samples is not None and batch.samples is not None
    off = np.abs(alone.samples[0] - batch.samples[1]).max(axis=(1, 2)) > 1e-3
    assert off.mean() <= 1.0 / 500.0


def test_a_request_may_stratify_beside_one_that_does_not(
    model: Trajectron, state: SceneState
) -> None:
    requests = [ForecastRequest(seed=3, sampling=kind) for kind in ("iid", "stratified")]
    together = model.forecast([state, state], requests)
    for request, found in zip(requests, together, strict=True):
        [alone] = model.forecast([state], [request])
        assert alone.samples is not None and found.samples is not None
        np.testing.assert_allclose(alone.samples, found.samples, atol=1e-3)


def test_no_other_sampling_exists() -> None:
    with pytest.raises(ValueError, match="sampling 'halton' is none of iid, stratified"):
        ForecastRequest(sampling="halton")  # type: ignore[arg-type]
