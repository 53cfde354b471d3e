"""The spread of analytic modes: how it is corrected, and that the fit finds what was wrong."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from trajectron_model.config import Dispersion, ModelConfig, NodeType
from trajectron_model.dispersion import disperse
from trajectron_model.forecast import ForecastRequest
from trajectron_model.predictor import PositionMixture
from trajectron_model.state import SceneFrame
from trajectron_model.training import calibration
from trajectron_model.trajectron import Trajectron

LEVELS = np.array([0.5, 0.8, 0.9, 0.95])


def test_without_dispersion_covariances_stay() -> None:
    covariance = torch.tensor([[[[4.0, 1.0, 2.0]]]])
    assert disperse(covariance, torch.ones(1, 1), ()) is covariance


def test_a_factor_scales_standard_deviations_and_the_last_holds_beyond() -> None:
    covariance = torch.tensor([4.0, 1.0, 2.0]).repeat(1, 1, 3, 1)  # [1, 1, 3, 3]
    scaled = disperse(covariance, torch.ones(1, 1), (Dispersion(0.5, 0.0), Dispersion(2.0, 0.0)))
    expected = [[1.0, 0.25, 0.5], [16.0, 4.0, 8.0], [16.0, 4.0, 8.0]]
    assert torch.allclose(scaled[0, 0], torch.tensor(expected))


def test_a_contrast_widens_the_wide_modes_and_narrows_the_narrow_ones() -> None:
    # Spreads 1 and 4, equally probable: their geometric mean is 2, so with contrast 1 the
    # standard deviations become 1 x 1/2 and 4 x 2.
    covariance = torch.tensor([[[[1.0, 0.0, 1.0]], [[16.0, 0.0, 16.0]]]])
    probability = torch.tensor([[0.5, 0.5]])
    scaled = disperse(covariance, probability, (Dispersion(1.0, 1.0),))
    assert torch.allclose(scaled[0, :, 0, 0], torch.tensor([0.25, 64.0]))


def test_forecasts_carry_the_dispersion_of_their_type(model: Trajectron) -> None:
    frames = [
        SceneFrame(0.4 * t, ("a",), ("pedestrian",), np.array([[0.5 * t, 0.1 * t]]))
        for t in range(4)
    ]
    state = model.initial_state()
    for frame in frames:
        (state,) = model.step([state], [frame])
    request = ForecastRequest(mode="gmm", horizon=3)
    before = model.forecast([state], [request])[0]
    kinds = (replace(model.config.types[0], dispersion=(Dispersion(0.5, 0.0),)),)
    wider = Trajectron(replace(model.config, types=kinds)).eval()
    wider.load_state_dict(model.state_dict())
    after = wider.forecast([state], [request])[0]
    assert before.mean is not None and after.mean is not None
    assert before.covariance is not None and after.covariance is not None
    np.testing.assert_array_equal(after.mean, before.mean)
    np.testing.assert_allclose(after.covariance, 0.25 * before.covariance, rtol=1e-4)


@pytest.mark.parametrize("too_wide", [0.5, 2.5])
def test_the_fit_undoes_a_known_error_of_scale(too_wide: float) -> None:
    judged = _forecasts_that_are(too_wide)
    raw = calibration.coverage([judged], ())
    fitted = calibration.fit([judged])
    mended = calibration.coverage([judged], fitted)
    assert np.abs(raw.mean(axis=1) - LEVELS).mean() > 0.1
    assert np.abs(mended.mean(axis=1) - LEVELS).mean() < 0.02
    for factor, contrast in fitted:
        assert contrast == 0.0
        assert factor == pytest.approx(1.0 / too_wide, rel=0.1)


def test_recordings_weigh_the_same_however_many_agents_they_have() -> None:
    narrow, wide = _forecasts_that_are(0.01, agents=300), _forecasts_that_are(100.0, agents=10)
    share = calibration.coverage([narrow, wide], ())
    np.testing.assert_allclose(share, 0.5, atol=0.02)


def _forecasts_that_are(too_wide: float, agents: int = 600) -> calibration.Judged:
    """Two modes far apart; the truth is drawn from them with another standard deviation."""
    random = np.random.default_rng(0)
    mean = np.zeros((agents, 2, 2, 2))
    mean[:, 1] = 40.0
    covariance = np.zeros((agents, 2, 2, 3))
    covariance[..., [0, 2]] = too_wide**2
    probability = np.tile([0.3, 0.7], (agents, 1))
    mode = (random.random(agents) < 0.7).astype(int)
    truth = mean[np.arange(agents), mode] + random.standard_normal((agents, 2, 2))
    return calibration.Judged(PositionMixture(probability, mean, covariance), truth)


def test_the_dispersion_is_part_of_the_configuration() -> None:
    kinds = (NodeType("pedestrian", dispersion=(Dispersion(0.7, 0.5), Dispersion(0.8, 0.0))),)
    config = ModelConfig(types=kinds)
    assert ModelConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize("wrong", [(0.0, 0.0), (1.0, 9.0), (math.nan, 0.0)])
def test_a_dispersion_out_of_bounds_is_refused(wrong: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="dispersion of 'pedestrian'"):
        NodeType("pedestrian", dispersion=(Dispersion(*wrong),))
