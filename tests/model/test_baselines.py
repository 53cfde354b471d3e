"""Baselines by name: what each foretells on tracks that can be worked out by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from trajectron_model.baselines import recipes, registry
from trajectron_model.baselines.kalman import (
    Kalman,
    NoiseLevels,
    foretell,
    log_density,
    observe,
    transition,
)
from trajectron_model.baselines.kalman_fitting import fit, mean_log_density
from trajectron_model.baselines.linear import Linear, extended
from trajectron_model.baselines.network import NetworkPredictor
from trajectron_model.checkpoint import CheckpointError
from trajectron_model.data.eth_ucy import TEST_SETS
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, sgan_windows
from trajectron_model.predictor import DensityPredictor, Predictor, WindowForecast

HORIZON = 3

Track = Sequence[tuple[float, float] | None]
LEVELS = NoiseLevels(acceleration=0.5, position_m=0.1, velocity_mps=2.0)


def recording(tracks: Sequence[Track], name: str = "tracks") -> Recording:
    """Tracks from step 0 on, None where an agent is absent; then steps without anybody."""
    rows = [
        (step, agent, *place)
        for agent, track in enumerate(tracks)
        for step, place in enumerate(track)
        if place is not None
    ]
    table = np.array(rows)
    return Recording.from_rows(
        name=name,
        dt_s=0.4,
        start_time_s=0.0,
        ids=[str(agent) for agent in range(len(tracks))],
        types=["pedestrian"] * len(tracks),
        step=table[:, 0].astype(np.int64),
        agent=table[:, 1].astype(np.int64),
        position=table[:, 2:],
        num_steps=max(len(track) for track in tracks) + HORIZON,
    )


def window(*tracks: Track) -> Window:
    observed = max(len(track) for track in tracks)
    return Window(recording(list(tracks)), 0, observed, HORIZON, np.arange(len(tracks)))


def straight(steps: int = 8, step: tuple[float, float] = (0.5, -0.2)) -> list[tuple[float, float]]:
    return [(1.0 + k * step[0], 2.0 + k * step[1]) for k in range(steps)]


def walkers(steps: int = 26, agents: int = 4, seed: int = 0, shift: float = 0.0) -> Recording:
    """People who wander, one of whom comes late and is missing for two steps."""
    random = np.random.default_rng(seed)
    strides = random.normal([0.4, 0.1], 0.1, (agents, 1, 2))
    jolts = random.normal(0.0, 0.03, (agents, steps, 2))
    walks = (
        np.cumsum(strides + np.cumsum(jolts, axis=1), axis=1)
        + 1.5 * np.arange(agents)[:, None, None]
    )
    tracks: list[list[tuple[float, float] | None]] = [
        [(float(x) + shift, float(y) - shift) for x, y in walk] for walk in walks
    ]
    tracks[0][:4] = [None] * 4
    tracks[0][5] = tracks[0][6] = None
    return recording(tracks)


def everyone_now(of: Recording, *, first: int, observed: int) -> Window:
    """A window that judges whoever is seen at its newest observed step."""
    rows = of.rows(first + observed - 1, first + observed)
    return Window(of, first, observed, 12, of.agent[rows])


def made(name: str) -> Predictor:
    """A baseline; networks with random weights: what is asked here holds for any."""
    if name not in recipes.NETWORKS:
        return registry.baseline(name, "eth")
    torch.manual_seed(1)
    return NetworkPredictor(recipes.NETWORKS[name]().eval(), name)


def assert_same(one: WindowForecast, other: WindowForecast, shift: tuple[float, float]) -> None:
    for name in ("samples", "mode_mean", "mean"):
        np.testing.assert_allclose(getattr(one, name) + shift, getattr(other, name), atol=2e-4)


@pytest.mark.parametrize("name", registry.NAMES)
def test_every_baseline_meets_the_contract(name: str) -> None:
    """Few and many observed steps, someone just come, someone who was missing."""
    predictor = made(name)
    crowd = walkers()
    windows = [
        everyone_now(crowd, first=first, observed=observed)
        for first, observed in ((4, 1), (4, 2), (0, 8), (3, 5), (0, 14))
    ]
    together = predictor.predict(windows, num_samples=5, seed=3)
    for each, forecast in zip(windows, together, strict=True):
        agents = len(each.judged)
        assert forecast.samples.shape == (5, agents, 12, 2)
        assert forecast.mean.shape == forecast.mode_mean.shape == (agents, 12, 2)
        assert np.isfinite(forecast.samples).all() and np.isfinite(forecast.mean).all()
        (alone,) = predictor.predict([each], num_samples=5, seed=3)
        assert_same(alone, forecast, (0.0, 0.0))
        start = each.history()[:, -1]
        assert np.abs(forecast.mean[:, 0] - start).max() < 2.0


@pytest.mark.parametrize("name", registry.NAMES)
def test_every_baseline_moves_with_the_scene(name: str) -> None:
    predictor = made(name)
    here = everyone_now(walkers(), first=2, observed=9)
    far = everyone_now(walkers(shift=5e5), first=2, observed=9)
    (one,) = predictor.predict([here], num_samples=4, seed=1)
    (other,) = predictor.predict([far], num_samples=4, seed=1)
    assert_same(one, other, (5e5, -5e5))


@pytest.mark.parametrize("name", registry.NAMES)
def test_no_baseline_sees_what_comes_after(name: str) -> None:
    predictor = made(name)
    whole = walkers()
    seen = everyone_now(whole, first=0, observed=10)
    cut = everyone_now(replace(whole.between(0, 10), num_steps=26), first=0, observed=10)
    (one,) = predictor.predict([seen], num_samples=3, seed=1)
    (other,) = predictor.predict([cut], num_samples=3, seed=1)
    assert_same(one, other, (0.0, 0.0))


@pytest.mark.parametrize("name", ["constant-velocity-noise", *registry.LEARNED])
def test_the_seed_and_the_newest_step_choose_the_samples(name: str) -> None:
    predictor = made(name)
    straight_on = recording([straight(20), straight(20, (0.4, 0.1))])
    first = everyone_now(straight_on, first=0, observed=8)
    later = everyone_now(straight_on, first=0, observed=9)

    def spread(of: Window, seed: int) -> np.ndarray:
        (forecast,) = predictor.predict([of], num_samples=4, seed=seed)
        return forecast.samples - forecast.samples[:1]

    assert not np.allclose(spread(first, 1), spread(first, 2))
    assert not np.allclose(spread(first, 1), spread(later, 1), atol=1e-2)


@pytest.mark.parametrize("name", registry.NAMES)
def test_an_absent_agent_cannot_be_judged(name: str) -> None:
    gone = window(straight(8), straight(7))
    with pytest.raises(ValueError, match="absent at the newest observed step"):
        made(name).predict([gone], num_samples=1, seed=0)


@pytest.mark.parametrize("test_set", [*TEST_SETS, None])
@pytest.mark.parametrize("name", registry.LEARNED)
def test_what_was_learned_is_bundled_and_says_from_what(name: str, test_set: str | None) -> None:
    held_out = {
        "eth": {"biwi_eth"},
        "hotel": {"biwi_hotel"},
        "univ": {"students001", "students003"},
        "zara1": {"crowds_zara01"},
        "zara2": {"crowds_zara02"},
    }
    predictor = registry.baseline(name, test_set)
    (forecast,) = predictor.predict([window(straight(8))], num_samples=2, seed=0)
    assert np.isfinite(forecast.samples).all()
    facts = registry.provenance(name, test_set)
    seen = facts["training"]["recordings"] + facts["validation"]["recordings"]
    assert seen and all(len(one["sha256"]) == 64 for one in seen)
    names = {one["name"] for one in seen}
    assert names == {
        "biwi_eth",
        "biwi_hotel",
        "crowds_zara01",
        "crowds_zara02",
        "crowds_zara03",
        "students001",
        "students003",
        "uni_examples",
    } - held_out.get(test_set or "", set())
    assert facts["outcome"] in ("converged", "reached the cap") and "licence" in facts
    assert len(registry.sha256(name, test_set)) == 64


@pytest.mark.parametrize("name", sorted(set(registry.NAMES) - set(registry.LEARNED)))
def test_what_learns_nothing_has_no_provenance(name: str) -> None:
    assert not registry.provenance(name, "zara1")
    assert not registry.sha256(name, "zara1")


def test_unknown_baselines_and_missing_weights_are_answered_with_what_there_is() -> None:
    with pytest.raises(CheckpointError, match="the baselines are constant-velocity, "):
        registry.baseline("oracle")
    with pytest.raises(CheckpointError, match=r"but test set moon are bundled.*kalman-without-eth"):
        registry.baseline("kalman", "moon")


def test_linear_walks_a_line_on() -> None:
    (forecast,) = Linear().predict([window(straight(8))], num_samples=2, seed=0)
    expected = [[(1.0 + k * 0.5, 2.0 - k * 0.2) for k in (8, 9, 10)]]
    np.testing.assert_allclose(forecast.mean, expected, atol=1e-9)
    np.testing.assert_allclose(forecast.samples, [expected, expected], atol=1e-9)


def test_linear_fits_by_least_squares() -> None:
    """Places 0, 1, 0, 1 at times -3 to 0: slope 0.2, middle 0.5 at -1.5, so 0.8 at the newest."""
    history = np.zeros((1, 4, 2))
    history[0, :, 0] = [0.0, 1.0, 0.0, 1.0]
    np.testing.assert_allclose(extended(history, 2)[0, :, 0], [1.0, 1.2])


def test_linear_minds_gaps_and_stays_where_it_was_seen_once() -> None:
    history = np.full((2, 4, 2), np.nan)
    history[0, [0, 3]] = [[0.0, 0.0], [3.0, 6.0]]
    history[1, 3] = [5.0, 5.0]
    line = extended(history, 2)
    np.testing.assert_allclose(line, [[[4.0, 8.0], [5.0, 10.0]], [[5.0, 5.0], [5.0, 5.0]]])


def test_kalman_follows_a_straight_line() -> None:
    """The pull towards standing still, which an agent begins with, is gone after some steps."""
    (forecast,) = Kalman(LEVELS).predict([window(straight(16))], num_samples=1, seed=0)
    expected = [[(1.0 + k * 0.5, 2.0 - k * 0.2) for k in (16, 17, 18)]]
    np.testing.assert_allclose(forecast.mean, expected, atol=0.02)


def test_kalman_by_hand_after_two_observations() -> None:
    """One axis; P is diag(r^2, v^2) after the first, and dt mixes them before the second."""
    r, v, q, dt = 0.1, 2.0, 0.5, 0.4
    p00 = r**2 + dt**2 * v**2 + q**2 * dt**3 / 3
    p01 = dt * v**2 + q**2 * dt**2 / 2
    p11 = v**2 + q**2 * dt
    gain = np.array([p00, p01]) / (p00 + r**2)
    belief = observe(np.array([[[3.0, 0.0], [3.6, 0.0]]]), dt, LEVELS)
    np.testing.assert_allclose(belief.mean[0, :, 0], [3.0 + gain[0] * 0.6, gain[1] * 0.6])
    expected = [[p00 * (1 - gain[0]), p01 * (1 - gain[0])]]
    np.testing.assert_allclose(belief.covariance[0, :1], expected)
    assert belief.covariance[0, 1, 1] == pytest.approx(p11 - gain[1] * p01)


def test_kalman_grows_unsure_over_a_gap_and_with_the_horizon() -> None:
    seen = np.array(straight(4))[None]
    gap = np.concatenate([seen, np.full((1, 2, 2), np.nan)], axis=1)
    belief = observe(seen, 0.4, LEVELS)
    waited, ahead = observe(gap, 0.4, LEVELS), foretell(belief, 2, 0.4, LEVELS)
    np.testing.assert_allclose(waited.mean[0], ahead.mean[0, -1])
    np.testing.assert_allclose(waited.covariance[0], ahead.covariance[0, -1])
    assert (np.diff(foretell(belief, 12, 0.4, LEVELS).covariance[0, :, 0, 0]) > 0).all()


def test_kalman_samples_are_of_its_mixture() -> None:
    (forecast,) = Kalman(LEVELS).predict([window(straight(5))], num_samples=20_000, seed=0)
    assert forecast.mixture is not None
    assert forecast.mixture.probability.tolist() == [[1.0]]
    np.testing.assert_allclose(forecast.mixture.mean[:, 0], forecast.mean)
    np.testing.assert_allclose(forecast.samples.mean(axis=0), forecast.mean, atol=0.03)
    variance = forecast.samples.var(axis=0)[0]  # [H, 2]
    np.testing.assert_allclose(variance, forecast.mixture.covariance[0, 0, :, [0, 2]].T, rtol=0.05)


def test_kalman_log_prob_of_one_step_is_its_mixture() -> None:
    """And of all of them the determinant of the joint covariance, worked out in full."""
    whole = recording([straight(11)])
    judged = Window(whole, 0, 8, HORIZON, np.array([0]))
    predictor = Kalman(LEVELS)
    assert isinstance(predictor, DensityPredictor)
    matrix, added = transition(0.4, LEVELS)
    belief = observe(judged.history(), 0.4, LEVELS)
    ahead = foretell(belief, HORIZON, 0.4, LEVELS)
    single = replace(judged, horizon=1)
    difference = single.future()[:, 0] - ahead.mean[:, 0, 0]
    expected = log_density(difference, ahead.covariance[:, 0, 0, 0])
    np.testing.assert_allclose(predictor.log_prob([single])[0], expected)
    joint = np.zeros((HORIZON, HORIZON))
    for later in range(HORIZON):
        for sooner in range(later + 1):
            carried = np.linalg.matrix_power(matrix, later - sooner) @ ahead.covariance[0, sooner]
            joint[later, sooner] = joint[sooner, later] = carried[0, 0]
    residual = judged.future()[0] - ahead.mean[0, :, 0]  # [H, 2]
    squared = float((residual * np.linalg.solve(joint, residual)).sum())
    logdet = float(np.linalg.slogdet(joint).logabsdet)
    density = -0.5 * squared - logdet - HORIZON * math.log(2 * math.pi)
    np.testing.assert_allclose(predictor.log_prob([judged])[0], [density], rtol=1e-6)
    assert added.shape == (2, 2)


def test_kalman_levels_are_found_again_in_tracks_made_with_them() -> None:
    """Of tracks that are the filter's own, the fitted levels beat all others tried."""
    random = np.random.default_rng(0)
    made = NoiseLevels(acceleration=0.4, position_m=0.05, velocity_mps=1.0)
    matrix, added = transition(0.4, made)
    state = np.zeros((300, 2, 2))
    state[:, 1] = random.normal(0.0, made.velocity_mps, (300, 2))
    root, track = np.linalg.cholesky(added), []
    for _ in range(20):
        state = matrix @ state + root @ random.normal(size=state.shape)
        track.append(state[:, 0] + random.normal(0.0, made.position_m, (300, 2)))
    tracks = [[(float(x), float(y)) for x, y in one] for one in np.stack(track, axis=1)]
    windows = sgan_windows(recording(tracks))
    found = fit(windows)
    assert found.acceleration == pytest.approx(0.4, rel=0.25)
    assert found.velocity_mps == pytest.approx(1.0, rel=0.25)
    best = mean_log_density(windows, found)
    for factor in (0.4, 2.5):
        other = found._replace(acceleration=factor * found.acceleration)
        assert mean_log_density(windows, other) < best
