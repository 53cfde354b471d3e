"""Modes of negligible probability are left out of analytic forecasts, and of nothing else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from trajectron_model import registry
from trajectron_model.config import MODE_PROBABILITY_FLOOR
from trajectron_model.data.eth_ucy import EthUcy
from trajectron_model.data.windows import Window, sgan_windows
from trajectron_model.decoder import Decoder
from trajectron_model.evaluation.densities import highest_density_regions, mixture_log_density
from trajectron_model.forecast import ForecastRequest, SceneForecast
from trajectron_model.modes import without_negligible
from trajectron_model.predictor import PositionMixture, TrajectronPredictor
from trajectron_model.state import SceneFrame, SceneState
from trajectron_model.trajectron import Trajectron

SceneMaker = Callable[..., list[SceneFrame]]
Fold = Callable[[Trajectron, list[SceneFrame]], SceneState]


def test_what_is_left_of_a_prior_sums_to_one() -> None:
    probability = torch.tensor([[0.9, 0.001, 0.099], [0.3, 0.3, 0.4], [0.2, 0.3, 0.5]])
    floor = torch.tensor([0.01, 0.01, 1.0])
    left = without_negligible(probability.log(), floor).exp()
    expected = torch.tensor([[0.9 / 0.999, 0.0, 0.099 / 0.999], [0.3, 0.3, 0.4], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(left, expected)
    # Where nothing is left out, nothing changes.
    untouched = probability[1:2].log()
    assert torch.equal(without_negligible(untouched, floor[1:2]), untouched)


@pytest.fixture
def peaked(model: Trajectron, monkeypatch: pytest.MonkeyPatch) -> Trajectron:
    """A model whose prior leaves most latent values below the floor."""
    latent = model.node_model(0).latent
    plain = latent.prior

    def prior(encoding: Tensor) -> Tensor:
        return torch.log_softmax(40.0 * plain(encoding), dim=-1)

    monkeypatch.setattr(latent, "prior", prior)
    return model


def test_negligible_modes_are_not_rolled_out_and_drop_out_of_every_sum(
    peaked: Trajectron, crowd: SceneMaker, fold: Fold, monkeypatch: pytest.MonkeyPatch
) -> None:
    rolled_out: list[int] = []
    plain = Decoder.moments

    def counting(self: Decoder, prepared: object, agent: Tensor, *rest: object) -> object:
        rolled_out.append(len(agent))
        return plain(self, prepared, agent, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(Decoder, "moments", counting)
    state = fold(peaked, crowd())
    gmm, whole = (
        peaked.forecast([state], [request])[0]
        for request in (
            ForecastRequest(mode="gmm"),
            ForecastRequest(num_samples=1, include_modes=True),
        )
    )
    assert gmm.mean is not None and gmm.covariance is not None
    assert whole.mean is not None and whole.covariance is not None
    kept = gmm.mode_probabilities > 0.0
    assert (kept == (whole.mode_probabilities >= MODE_PROBABILITY_FLOOR)).all()
    assert rolled_out == [kept.sum(), kept.size]
    assert kept.sum() < kept.size / 2
    np.testing.assert_allclose(gmm.mode_probabilities.sum(axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(gmm.mean[kept], whole.mean[kept], atol=1e-5)
    best = whole.mode_probabilities.argmax(axis=1)
    for agent, mode in np.argwhere(~kept):
        np.testing.assert_array_equal(gmm.mean[agent, mode], gmm.mean[agent, best[agent]])
        np.testing.assert_array_equal(
            gmm.covariance[agent, mode], gmm.covariance[agent, best[agent]]
        )


def test_requests_of_one_batch_each_have_their_own_floor(
    peaked: Trajectron, crowd: SceneMaker, fold: Fold
) -> None:
    state = fold(peaked, crowd())
    asked = [ForecastRequest(mode="gmm"), ForecastRequest(num_samples=3, include_modes=True)]
    together = peaked.forecast([state, state], asked)
    for request, beside in zip(asked, together, strict=True):
        (alone,) = peaked.forecast([state], [request])
        assert ((alone.mode_probabilities == 0) == (beside.mode_probabilities == 0)).all()
    assert (together[1].mode_probabilities > 0).all()


def mixture(forecast: SceneForecast) -> PositionMixture:
    assert forecast.mean is not None and forecast.covariance is not None
    probability = forecast.mode_probabilities.astype(np.float64)
    mean = forecast.mean + forecast.position[:, None, None, :]
    return PositionMixture(
        probability / probability.sum(axis=1, keepdims=True),
        mean,
        forecast.covariance.astype(np.float64),
    )


def test_on_recordings_coverage_and_likelihood_stay_as_they_are(eth_ucy: EthUcy) -> None:
    """The set with the most modes below the floor."""
    model = registry.load(registry.DEFAULT).model.requires_grad_(False)
    windows: list[Window] = []
    for recording in eth_ucy.test("hotel"):
        windows += list(sgan_windows(recording))[:80]
    states = TrajectronPredictor(model, "ours")._states(windows)

    def scores(mode: str) -> tuple[np.ndarray, float]:
        requests = [
            ForecastRequest(mode=mode, num_samples=1, agents=w.ids, include_modes=True)  # type: ignore[arg-type]
            for w in windows
        ]
        covered, densities = [], []
        for window, found in zip(windows, model.forecast(states, requests), strict=True):
            regions = highest_density_regions(
                mixture(found), window.future(), np.random.default_rng(0)
            )
            covered.append(regions.covered.reshape(regions.covered.shape[0], -1))
            densities.append(mixture_log_density(mixture(found), window.future()).ravel())
        share = np.nanmean(np.concatenate(covered, axis=1), axis=1)
        return share, float(np.nanmean(np.concatenate(densities)))

    whole, pruned = scores("full"), scores("gmm")
    assert np.abs(whole[0] - pruned[0]).max() < 0.005
    assert abs(whole[1] - pruned[1]) < 0.005
