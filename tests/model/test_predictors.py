"""Predictors: the Trajectron as the service runs it, constant velocity; neither sees the future."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from trajectron_model.baselines.constant_velocity import ConstantVelocity
from trajectron_model.config import ModelConfig
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, sgan_windows
from trajectron_model.forecast import ForecastRequest
from trajectron_model.predictor import Predictor, TrajectronPredictor, WindowForecast
from trajectron_model.trajectron import Trajectron

STEPS = 24


def crowd(agents: int = 5, *, seed: int = 0, changed_after: int = STEPS) -> Recording:
    """Walkers side by side, 1 m apart; other walks from step ``changed_after`` on."""
    rng = np.random.default_rng(seed)
    strides = rng.normal([0.5, 0.0], 0.1, size=(STEPS, agents, 2))
    strides[changed_after:] += [0.0, 3.0]
    walks = np.cumsum(strides, axis=0) + np.arange(agents)[:, None] * [0.0, 1.0]
    step, agent = np.indices((STEPS, agents)).reshape(2, -1)
    return Recording.from_rows(
        name="crowd",
        dt_s=0.4,
        start_time_s=0.0,
        ids=[f"{n}" for n in range(agents)],
        types=["pedestrian"] * agents,
        step=step,
        agent=agent,
        position=walks.reshape(-1, 2),
    )


def trajectron() -> TrajectronPredictor:
    """A small model with random weights: what is asked here holds for any."""
    torch.manual_seed(7)
    config = ModelConfig(decoder_size=16, latent_values=4, mixture_components=3)
    return TrajectronPredictor(Trajectron(config).eval(), "random")


def predictors() -> list[Predictor]:
    return [trajectron(), ConstantVelocity(), ConstantVelocity(heading_noise_deg=25)]


def assert_same(first: WindowForecast, second: WindowForecast, atol: float = 1e-4) -> None:
    np.testing.assert_allclose(first.samples, second.samples, atol=atol)
    np.testing.assert_allclose(first.mode_mean, second.mode_mean, atol=atol)
    np.testing.assert_allclose(first.mean, second.mean, atol=atol)


@pytest.mark.parametrize("predictor", predictors(), ids=lambda one: one.name)
def test_shapes_are_as_the_contract_says(predictor: Predictor) -> None:
    windows = sgan_windows(crowd())
    forecasts = predictor.predict(windows, num_samples=3, seed=1)
    assert len(forecasts) == len(windows) == STEPS - 19
    for forecast in forecasts:
        assert forecast.samples.shape == (3, 5, 12, 2)
        assert forecast.mode_mean.shape == forecast.mean.shape == (5, 12, 2)
        assert np.isfinite(forecast.samples).all()


@pytest.mark.parametrize("predictor", predictors(), ids=lambda one: one.name)
def test_what_comes_after_the_observed_steps_changes_nothing(predictor: Predictor) -> None:
    known, changed = crowd(), crowd(changed_after=8)
    assert not np.allclose(known.dense()[1][8], changed.dense()[1][8])
    (straight,) = predictor.predict(sgan_windows(known)[:1], num_samples=3, seed=1)
    (swerved,) = predictor.predict(sgan_windows(changed)[:1], num_samples=3, seed=1)
    assert_same(straight, swerved, atol=0)


def test_what_comes_before_the_observed_steps_changes_nothing() -> None:
    whole = sgan_windows(crowd())[4]
    alone = sgan_windows(crowd().between(4, STEPS))[0]
    assert whole.history().tolist() == alone.history().tolist()
    predictor = ConstantVelocity()
    (late,) = predictor.predict([whole], num_samples=1, seed=1)
    (early,) = predictor.predict([alone], num_samples=1, seed=1)
    assert_same(late, early, atol=0)
    # The model's samples are keyed by the step, but its distribution is the same.
    (late,) = trajectron().predict([whole], num_samples=1, seed=1)
    (early,) = trajectron().predict([alone], num_samples=1, seed=1)
    np.testing.assert_allclose(late.mean, early.mean, atol=1e-6)


@pytest.mark.parametrize("predictor", predictors(), ids=lambda one: one.name)
def test_windows_beside_change_nothing(predictor: Predictor) -> None:
    windows = sgan_windows(crowd())
    together = predictor.predict(windows, num_samples=4, seed=1)
    for window, beside in zip(windows, together, strict=True):
        (alone,) = predictor.predict([window], num_samples=4, seed=1)
        assert_same(alone, beside)


@pytest.mark.parametrize("predictor", [trajectron(), ConstantVelocity(25)], ids=lambda o: o.name)
def test_the_seed_and_the_window_choose_the_samples(predictor: Predictor) -> None:
    first, second = sgan_windows(crowd())[:2]

    def spread(window: Window, seed: int) -> np.ndarray:
        (forecast,) = predictor.predict([window], num_samples=4, seed=seed)
        return forecast.samples - forecast.mean

    assert np.array_equal(spread(first, 1), spread(first, 1))
    assert not np.allclose(spread(first, 1), spread(first, 2))
    assert not np.allclose(spread(first, 1), spread(second, 1), atol=1e-2)


def test_the_trajectron_does_what_a_session_would() -> None:
    window = sgan_windows(crowd())[2]
    (forecast,) = trajectron().predict([window], num_samples=6, seed=5)
    torch.manual_seed(7)
    model = Trajectron(ModelConfig(decoder_size=16, latent_values=4, mixture_components=3)).eval()
    state = model.initial_state()
    for frame in window.frames():
        (state,) = model.step([state], [frame])
    request = ForecastRequest(
        mode="full", num_samples=6, horizon=12, seed=5, step=window.now, include_modes=True
    )
    (scene,) = model.forecast([state], [request])
    assert scene.ids == window.ids
    assert scene.samples is not None
    assert scene.mean is not None
    origin = scene.position[:, None]
    np.testing.assert_array_equal(origin[:, 0], window.history()[:, -1])
    for agent in range(5):
        probability = scene.mode_probabilities[agent]
        best = scene.mean[agent, probability.argmax()]
        every = sum(p * mean for p, mean in zip(probability, scene.mean[agent], strict=True))
        np.testing.assert_allclose(forecast.mode_mean[agent], best + origin[agent], atol=1e-4)
        np.testing.assert_allclose(forecast.mean[agent], every + origin[agent], atol=1e-4)
        for sample in range(6):
            np.testing.assert_allclose(
                forecast.samples[sample, agent],
                scene.samples[agent, sample] + origin[agent],
                atol=1e-4,
            )


def test_context_agents_are_seen_but_not_forecast() -> None:
    window = sgan_windows(crowd())[0]
    judged = replace(window, judged=window.judged[1:2])
    (one,) = trajectron().predict([judged], num_samples=3, seed=1)
    (every,) = trajectron().predict([window], num_samples=3, seed=1)
    assert one.samples.shape == (3, 1, 12, 2)
    np.testing.assert_allclose(one.mean[0], every.mean[1], atol=1e-5)
    lonely = crowd()
    kept = lonely.agent == 1
    alone = Recording.from_rows(
        name="alone",
        dt_s=0.4,
        start_time_s=0.0,
        ids=lonely.ids,
        types=lonely.types,
        step=lonely.step[kept],
        agent=lonely.agent[kept],
        position=lonely.position[kept],
    )
    (without,) = trajectron().predict([replace(judged, recording=alone)], num_samples=3, seed=1)
    assert not np.allclose(one.mean, without.mean, atol=1e-4)


def test_a_recording_of_another_dt_is_refused() -> None:
    window = sgan_windows(replace(crowd(), dt_s=0.5))[0]
    with pytest.raises(ValueError, match=r"crowd has steps of 0\.5 s; random works at 0\.4 s"):
        trajectron().predict([window], num_samples=1, seed=0)


def test_an_unknown_type_is_refused() -> None:
    window = sgan_windows(replace(crowd(), types=("tram",) * 5))[0]
    with pytest.raises(ValueError, match="tram"):
        trajectron().predict([window], num_samples=1, seed=0)


def two_steps(before: list[float], now: list[float]) -> Window:
    position = np.array([before, now])
    present = ~np.isnan(position[:, 0])
    recording = Recording.from_rows(
        name="walk",
        dt_s=0.4,
        start_time_s=0.0,
        ids=["a"],
        types=["pedestrian"],
        step=np.arange(2)[present],
        agent=np.zeros(int(present.sum()), dtype=np.int64),
        position=position[present],
        num_steps=5,
    )
    return Window(recording, 0, 2, 3, np.array([0]))


def test_constant_velocity_repeats_the_last_displacement() -> None:
    (forecast,) = ConstantVelocity().predict(
        [two_steps([0.0, 1.0], [0.5, 3.0])], num_samples=2, seed=0
    )
    expected = [[[1.0, 5.0], [1.5, 7.0], [2.0, 9.0]]]
    assert forecast.mean.tolist() == forecast.mode_mean.tolist() == expected
    assert forecast.samples.tolist() == [expected, expected]


def test_an_agent_just_come_stays_where_it_is() -> None:
    (forecast,) = ConstantVelocity(25).predict(
        [two_steps([np.nan, np.nan], [0.5, 3.0])], num_samples=2, seed=0
    )
    assert forecast.samples.tolist() == [[[[0.5, 3.0]] * 3]] * 2
    with pytest.raises(ValueError, match="absent at the newest observed step"):
        ConstantVelocity().predict([two_steps([0, 0], [np.nan, np.nan])], num_samples=1, seed=0)


def test_heading_noise_turns_the_whole_walk_and_keeps_its_length() -> None:
    (forecast,) = ConstantVelocity(25).predict(
        [two_steps([0.0, 0.0], [2.0, 0.0])], num_samples=4000, seed=0
    )
    strides = np.diff(forecast.samples, axis=2)[:, 0]  # [S, H - 1, 2]
    np.testing.assert_allclose(np.hypot(strides[..., 0], strides[..., 1]), 2.0)
    angle = np.degrees(np.arctan2(strides[..., 1], strides[..., 0]))
    np.testing.assert_allclose(angle[:, 0], angle[:, 1])
    assert abs(angle[:, 0].mean()) < 2
    assert angle[:, 0].std() == pytest.approx(25, rel=0.05)
