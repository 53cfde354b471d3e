"""Predictors: the Trajectron as the service runs it, constant velocity; neither sees the future."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from trajectron_model.baselines.constant_velocity import ConstantVelocity
from trajectron_model.config import ModelConfig, NodeType
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, sgan_windows
from trajectron_model.forecast import ForecastRequest
from trajectron_model.likelihood import future_log_prob
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


# Windows that begin together, as under streaming and paper.


def growing(recording: Recording, *nows: int) -> list[Window]:
    """Windows from the first step to each of ``nows``, that judge whoever is there."""
    windows = []
    for now in nows:
        there = recording.agent[recording.rows(now, now + 1)]
        windows.append(Window(recording, 0, now + 1, 3, there))
    return windows


def with_gaps() -> Recording:
    """The crowd, of whom some are missing for a while: 3 for one step, 4 for six (2.4 s)."""
    whole = crowd()
    away = (whole.agent == 3) & (whole.step == 9) | (whole.agent == 4) & (abs(whole.step - 8) <= 3)
    return replace(
        whole,
        step=whole.step[~away],
        agent=whole.agent[~away],
        position=whole.position[~away],
    )


@pytest.mark.parametrize("predictor", predictors(), ids=lambda one: one.name)
def test_windows_that_begin_together_are_forecast_as_alone(predictor: Predictor) -> None:
    windows = growing(with_gaps(), 0, 1, 7, 10, 20, 22)
    together = predictor.predict(windows, num_samples=4, seed=1)
    backwards = predictor.predict(windows[::-1], num_samples=4, seed=1)[::-1]
    for window, forecast, turned in zip(windows, together, backwards, strict=True):
        fresh = trajectron() if predictor.name == "random" else predictor
        (alone,) = fresh.predict([window], num_samples=4, seed=1)
        assert_same(alone, forecast)
        assert_same(turned, forecast)


def test_a_run_of_windows_goes_on_in_the_next_call() -> None:
    windows = growing(with_gaps(), 10, 17, 18, 20, 22)
    whole = trajectron().predict(windows, num_samples=2, seed=1)
    predictor = trajectron()
    parts = [
        *predictor.predict(windows[:2], num_samples=2, seed=1),
        *predictor.predict(windows[2:], num_samples=2, seed=1),
        *predictor.predict(windows[:1], num_samples=2, seed=1),  # and back again
    ]
    for expected, found in zip([*whole, whole[0]], parts, strict=True):
        assert_same(expected, found)


def test_who_was_away_for_longer_than_the_timeout_is_new_again() -> None:
    recording = with_gaps()
    (window,) = growing(recording, 12)
    (forecast,) = trajectron().predict([window], num_samples=2, seed=1)
    assert window.observations().tolist() == [13, 13, 13, 12, 1]
    # Agent 4 is back for one step: as if it had never been there before.
    later = recording.agent != 4
    later |= recording.step >= 12
    new = replace(
        recording,
        step=recording.step[later],
        agent=recording.agent[later],
        position=recording.position[later],
    )
    alone = growing(new, 12)[0]
    (fresh,) = trajectron().predict([alone], num_samples=2, seed=1)
    np.testing.assert_allclose(forecast.samples[:, 4], fresh.samples[:, 4], atol=1e-4)


def test_z_best_is_of_one_mode() -> None:
    window = sgan_windows(crowd())[0]
    (full,) = trajectron().predict([window], num_samples=400, seed=1)
    model = trajectron()._model
    (best,) = TrajectronPredictor(model, "z", mode="z_best").predict(
        [window], num_samples=400, seed=1
    )
    assert full.mixture is not None
    assert best.mixture is not None
    assert full.mixture.probability.shape == (5, 4)
    np.testing.assert_allclose(full.mixture.probability.sum(axis=1), 1.0)
    assert best.mixture.probability.tolist() == [[1.0]] * 5
    np.testing.assert_allclose(best.mean, full.mode_mean, atol=1e-5)
    np.testing.assert_allclose(best.mixture.mean[:, 0], best.mean)
    assert not np.allclose(best.samples, full.samples)


# The exact likelihood.


def walk(horizon: int, *, standing: bool = False, dt_s: float = 0.4) -> Window:
    """One walker beside another, or one who has not moved yet."""
    steps = 3 + horizon
    path = np.arange(steps)[:, None] * np.array([0.4, 0.3]) * (not standing)
    position = np.stack([path, path + np.array([0.0, 1.0])], axis=1) + 100.0  # [T, A, 2]
    step, agent = np.indices((steps, 2)).reshape(2, -1)
    recording = Recording.from_rows(
        name="walk",
        dt_s=dt_s,
        start_time_s=0.0,
        ids=["a", "b"],
        types=["pedestrian"] * 2,
        step=step,
        agent=agent,
        position=position.reshape(-1, 2),
    )
    return Window(recording, 0, 3, horizon, np.array([0]))


def wide(dt_s: float = 0.4) -> Trajectron:
    """A small model whose densities a coarse grid can integrate, with another unit of speed."""
    torch.manual_seed(7)
    config = ModelConfig(
        types=(NodeType("pedestrian", speed_scale_mps=2.0),),
        decoder_size=16,
        latent_values=3,
        mixture_components=2,
        dt_s=dt_s,
        sigma_min_mps=0.4,
        sigma_max_mps=1.0,
    )
    return Trajectron(config).eval()


def log_prob_of_ends(
    model: Trajectron, window: Window, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """[G] of the judged agent's future with each of [G, 2] last positions; and the true one's."""
    state = model.initial_state()
    for frame in window.frames():
        (state,) = model.step([state], [frame])
    futures = np.tile(window.future(), (len(ends) + 1, 1, 1))
    futures[:-1, -1] = ends
    (found,) = future_log_prob(model, [state], [["a"] * len(futures)], [futures])
    return found[:-1], found[-1:]


def grid_around(centre: np.ndarray, reach_m: float) -> tuple[np.ndarray, float]:
    """Places [G, 2] on a square grid, and the area of a cell."""
    line = np.linspace(-reach_m, reach_m, 25)
    offset = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return centre + offset, float((line[1] - line[0]) ** 2)


@pytest.mark.parametrize("standing", [False, True], ids=["walking", "standing"])
@pytest.mark.parametrize("dt_s", [0.4, 1.0])
def test_the_density_of_a_position_integrates_to_one(standing: bool, dt_s: float) -> None:
    window = walk(1, standing=standing, dt_s=dt_s)
    places, cell = grid_around(window.history()[0, -1], 12.0 * dt_s)
    found, _ = log_prob_of_ends(wide(dt_s), window, places)
    assert np.exp(found).sum() * cell == pytest.approx(1.0, abs=0.01)


def test_a_futures_density_is_the_first_steps_times_the_rests() -> None:
    longer, shorter = walk(2), walk(1)
    places, cell = grid_around(longer.future()[0, 0], 5.0)
    joint, _ = log_prob_of_ends(wide(), longer, places)
    _, first = log_prob_of_ends(wide(), shorter, places[:0])
    assert np.log(np.exp(joint).sum() * cell) == pytest.approx(first[0], abs=0.01)


def test_where_a_standing_agent_goes_is_equally_likely_in_every_direction() -> None:
    window = walk(1, standing=True)
    angle = np.linspace(0.0, 2.0 * np.pi, 7)
    round_ = window.history()[0, -1] + 0.3 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    found, _ = log_prob_of_ends(trajectron()._model, window, round_)
    np.testing.assert_allclose(found, found[0], atol=1e-3)


def test_a_future_that_is_not_complete_has_no_likelihood() -> None:
    window = sgan_windows(crowd())[4]
    (whole,) = trajectron().log_prob([window])
    assert np.isfinite(whole).all()
    kept = ~((window.recording.agent == 2) & (window.recording.step == STEPS - 1))
    short = replace(
        window.recording,
        step=window.recording.step[kept],
        agent=window.recording.agent[kept],
        position=window.recording.position[kept],
    )
    (found,) = trajectron().log_prob([replace(window, recording=short)])
    assert np.isnan(found).tolist() == [False, False, True, False, False]
    np.testing.assert_allclose(found[[0, 1, 3, 4]], whole[[0, 1, 3, 4]], atol=1e-3)


def test_the_likelihood_does_not_depend_on_the_windows_beside() -> None:
    windows = [*sgan_windows(crowd()), walk(12), walk(12, standing=True)]
    predictor = trajectron()
    together = predictor.log_prob(windows)
    for window, beside in zip(windows, together, strict=True):
        (alone,) = trajectron().log_prob([window])
        np.testing.assert_allclose(alone, beside, atol=1e-3)


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
