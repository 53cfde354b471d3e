"""What comes back from a state: samples, modes, their invariances and their seeds."""

from __future__ import annotations

import resource
from collections.abc import Callable

import numpy as np
import pytest

from trajectron_model.config import MAX_SAMPLES
from trajectron_model.forecast import Float32, ForecastRequest, SceneForecast
from trajectron_model.state import SceneFrame, SceneState
from trajectron_model.trajectron import Trajectron

SceneMaker = Callable[..., list[SceneFrame]]
Fold = Callable[[Trajectron, list[SceneFrame]], SceneState]
MIXED = ("pedestrian", "vehicle", "obstacle")


def given(array: Float32 | None) -> Float32:
    assert array is not None
    return array


def forecast(network: Trajectron, state: SceneState, **options: object) -> SceneForecast:
    return network.forecast([state], [ForecastRequest(**options)])[0]  # type: ignore[arg-type]


def walkers(places: np.ndarray, velocities: np.ndarray, steps: int = 8) -> list[SceneFrame]:
    ids = tuple(str(i) for i in range(len(places)))
    return [
        SceneFrame(0.4 * t, ids, ("pedestrian",) * len(ids), places + 0.4 * t * velocities)
        for t in range(steps)
    ]


@pytest.fixture(scope="module")
def state(model: Trajectron, crowd: SceneMaker, fold: Fold) -> SceneState:
    return fold(model, crowd(missing=0.1))


def test_every_form_has_its_arrays(model: Trajectron, state: SceneState) -> None:
    agents, values = len(state.ids), model.config.latent_values
    full = forecast(model, state, num_samples=7, horizon=5)
    assert full.samples is not None and full.samples.shape == (agents, 7, 5, 2)
    assert full.mean is None and full.mode_probabilities.shape == (agents, values)
    both = forecast(model, state, num_samples=7, horizon=5, include_modes=True)
    assert both.mean is not None and both.mean.shape == (agents, values, 5, 2)
    np.testing.assert_array_equal(given(both.samples), full.samples)
    gmm = forecast(model, state, mode="gmm", horizon=5)
    assert gmm.samples is None and gmm.covariance is not None
    assert gmm.covariance.shape == (agents, values, 5, 3)
    np.testing.assert_allclose(given(gmm.mean), given(both.mean), atol=1e-5)


def test_modes_are_a_proper_mixture(model: Trajectron, state: SceneState) -> None:
    gmm = forecast(model, state, mode="gmm", horizon=60)
    np.testing.assert_allclose(gmm.mode_probabilities.sum(axis=1), 1.0, atol=1e-5)
    assert gmm.covariance is not None
    xx, xy, yy = np.moveaxis(gmm.covariance.astype(np.float64), -1, 0)
    assert (xx > 0).all() and (yy > 0).all() and (xx * yy - xy**2 > 0).all()
    spread = xx + yy
    assert (np.diff(spread, axis=-1) > 0).all(), "uncertainty grows with the horizon"


def test_z_best_takes_the_most_probable_latent_value(model: Trajectron, state: SceneState) -> None:
    best = forecast(model, state, mode="z_best", num_samples=30)
    assert best.sample_modes is not None
    expected = best.mode_probabilities.argmax(axis=1)
    assert (best.sample_modes == expected[:, None]).all()


def test_full_draws_latent_values_with_their_probabilities(
    model: Trajectron, state: SceneState
) -> None:
    full = forecast(model, state, num_samples=2000, horizon=1)
    assert full.sample_modes is not None
    for drawn, probability in zip(full.sample_modes, full.mode_probabilities, strict=True):
        share = np.bincount(drawn, minlength=probability.size) / drawn.size
        assert np.abs(share - probability).max() < 5.0 * np.sqrt(0.25 / 2000)


def test_longest_horizon_and_most_samples(model: Trajectron, fold: Fold) -> None:
    state = fold(model, walkers(np.zeros((1, 2)), np.ones((1, 2))))
    long = forecast(model, state, num_samples=MAX_SAMPLES, horizon=60)
    assert long.samples is not None and long.samples.shape == (1, 2000, 60, 2)
    assert np.isfinite(long.samples).all()


def test_memory_grows_with_what_comes_back_not_with_what_is_decoded(
    model: Trajectron, fold: Fold
) -> None:
    """200 agents x 2000 samples of one step: 6 kB a row held at once would be 2.4 GB."""
    random = np.random.default_rng(0)
    state = fold(model, walkers(random.uniform(0, 60, (200, 2)), random.normal(0, 1, (200, 2))))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = forecast(model, state, num_samples=2000, horizon=1)
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert found.samples is not None and found.samples.shape == (200, 2000, 1, 2)
    assert grown_kb < 600_000


@pytest.mark.parametrize(
    "options",
    [
        {"num_samples": 0},
        {"num_samples": 2001},
        {"horizon": 0},
        {"horizon": 61},
        {"seed": -1},
        {"seed": 2**63},
        {"mode": "best"},
    ],
)
def test_requests_out_of_bounds_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        ForecastRequest(**options)  # type: ignore[arg-type]


def test_an_agent_that_is_not_there_is_refused(model: Trajectron, state: SceneState) -> None:
    with pytest.raises(KeyError, match="nobody"):
        forecast(model, state, agents=("nobody",))


def test_samples_do_not_depend_on_company_order_or_batch(
    model: Trajectron, crowd: SceneMaker, fold: Fold, state: SceneState
) -> None:
    alone = forecast(model, state, seed=11, step=14, agents=("4",), num_samples=500)
    others = [fold(model, crowd(seed=s, agents=a)) for s, a in ((7, 3), (8, 20))]
    requests = [
        ForecastRequest(seed=1, num_samples=33),
        ForecastRequest(seed=11, step=14, agents=("9", "4", "2"), num_samples=500),
        ForecastRequest(mode="gmm"),
    ]
    batch = model.forecast([others[0], state, others[1]], requests)[1]
    assert alone.samples is not None and batch.samples is not None
    assert batch.ids == ("9", "4", "2")
    off = np.abs(alone.samples[0] - batch.samples[1]).max(axis=(1, 2)) > 1e-3
    assert off.mean() <= 1e-4
    np.testing.assert_allclose(alone.mode_probabilities[0], batch.mode_probabilities[1], atol=1e-5)


def test_another_seed_or_step_gives_other_samples(model: Trajectron, state: SceneState) -> None:
    first, *others = (
        forecast(model, state, seed=seed, step=step).samples
        for seed, step in ((1, 0), (2, 0), (1, 1))
    )
    assert first is not None
    for other in others:
        assert other is not None and np.abs(first - other).max() > 0.01


@pytest.mark.parametrize("shift_m", [(1e6, -1e6), (0.3, 17.0)])
def test_a_shifted_scene_has_the_same_forecast(
    model: Trajectron, crowd: SceneMaker, fold: Fold, shift_m: tuple[float, float]
) -> None:
    frames = crowd(missing=0.1)
    moved = [f._replace(positions=f.positions + shift_m) for f in frames]
    here, there = (
        forecast(model, fold(model, scene), include_modes=True, seed=3) for scene in (frames, moved)
    )
    for name in ("samples", "mean", "covariance", "mode_probabilities"):
        np.testing.assert_allclose(getattr(here, name), getattr(there, name), atol=1e-3)
    np.testing.assert_allclose(there.position, here.position + shift_m, rtol=1e-12)


@pytest.mark.parametrize("angle", [0.3, np.pi / 2, 2.5])
def test_a_rotated_scene_has_the_rotated_forecast(
    model: Trajectron, crowd: SceneMaker, fold: Fold, angle: float
) -> None:
    """Exact by construction: every vector is in its agent's own frame."""
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    frames = crowd(missing=0.1)
    moved = [f._replace(positions=f.positions @ turn) for f in frames]
    here, there = (
        forecast(model, fold(model, scene), include_modes=True, seed=3) for scene in (frames, moved)
    )
    assert here.heading_known.all()
    assert here.samples is not None and here.mean is not None
    np.testing.assert_allclose(here.samples @ turn, given(there.samples), atol=2e-3)
    np.testing.assert_allclose(here.mean @ turn, given(there.mean), atol=1e-3)
    covariance = given(here.covariance)
    matrix = covariance[..., [0, 1, 1, 2]].reshape(*covariance.shape[:-1], 2, 2)
    rotated = (turn.T @ matrix @ turn)[..., [0, 0, 1], [0, 1, 1]]
    np.testing.assert_allclose(rotated, given(there.covariance), atol=1e-3)


def test_an_agent_seen_once_has_an_isotropic_forecast(model: Trajectron, fold: Fold) -> None:
    frames = walkers(np.array([[0.0, 0.0], [1.0, 0.5]]), np.zeros((2, 2)), steps=1)
    state = fold(model, frames)
    found = forecast(model, state, num_samples=2000, include_modes=True, horizon=6)
    assert found.observations.tolist() == [1, 1] and not found.heading_known.any()
    assert found.mean is not None and found.covariance is not None
    assert np.abs(found.mean).max() == 0.0
    np.testing.assert_allclose(found.covariance[..., 0], found.covariance[..., 2])
    assert np.abs(found.covariance[..., 1]).max() == 0.0
    assert found.samples is not None
    end = found.samples[0, :, -1]
    angles = np.arctan2(end[:, 1], end[:, 0])
    # Uniform directions: the mean resultant length of 2000 is about 0.02.
    assert np.abs(np.exp(1j * angles).mean()) < 0.08


def test_without_a_heading_neighbours_around_do_not_turn_the_encoding(
    model: Trajectron, fold: Fold
) -> None:
    places = np.array([[0.0, 0.0], [1.0, 0.5], [-0.7, 1.1]])
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    one, other = (
        forecast(model, fold(model, walkers(p, np.zeros_like(p), steps=1)), mode="gmm")
        for p in (places, places @ turn)
    )
    np.testing.assert_allclose(one.mode_probabilities, other.mode_probabilities, atol=1e-6)
    np.testing.assert_allclose(given(one.covariance), given(other.covariance), rtol=1e-4, atol=1e-6)


def test_samples_keep_the_speed_limit(model: Trajectron, fold: Fold) -> None:
    state = fold(model, walkers(np.zeros((1, 2)), np.array([[12.0, 2.0]])))
    found = forecast(model, state, num_samples=500)
    assert found.samples is not None
    track = np.concatenate([np.zeros((500, 1, 2)), found.samples[0]], axis=1)
    speed = np.linalg.norm(np.diff(track, axis=1), axis=-1) / model.config.dt_s
    assert speed.max() <= 12.42 + 1e-3
    assert speed.max() > 11.0


def test_modes_have_the_moments_of_their_own_samples_at_the_first_step(
    model: Trajectron, state: SceneState
) -> None:
    """There the carried Gaussian is exact, but for the bound on speed."""
    found = forecast(model, state, num_samples=2000, horizon=1, include_modes=True, mode="z_best")
    assert found.samples is not None and found.mean is not None and found.covariance is not None
    agents = np.arange(len(found.ids))
    best = found.mode_probabilities.argmax(axis=1)
    deviation = np.sqrt(found.covariance[agents, best, 0][:, [0, 2]])  # [A, 2]
    drawn = found.samples[:, :, 0]
    error = np.abs(drawn.mean(axis=1) - found.mean[agents, best, 0])
    assert (error < 5.0 * deviation / np.sqrt(2000)).all()
    np.testing.assert_allclose(drawn.std(axis=1), deviation, rtol=0.15)


def test_obstacles_stay_where_they_are(
    mixed_model: Trajectron, crowd: SceneMaker, fold: Fold
) -> None:
    state = fold(mixed_model, crowd(types=MIXED, missing=0.0))
    movers = forecast(mixed_model, state, num_samples=3)
    assert "obstacle" not in movers.types and set(movers.types) == {"pedestrian", "vehicle"}
    asked = forecast(mixed_model, state, num_samples=3, agents=("2",), include_modes=True)
    assert asked.types == ("obstacle",)
    assert asked.samples is not None and np.abs(asked.samples).max() == 0.0
    assert asked.mean is not None and np.abs(asked.mean).max() == 0.0


def test_an_obstacle_changes_what_those_near_it_do(
    mixed_model: Trajectron, crowd: SceneMaker, fold: Fold
) -> None:
    frames = crowd(types=("pedestrian",), missing=0.0)
    tree = frames[-1].positions[list(frames[-1].ids).index("0")] + [1.0, 0.0]
    with_tree = [
        f._replace(
            ids=(*f.ids, "tree"),
            types=(*f.types, "obstacle"),
            positions=np.concatenate([f.positions, tree[None]]),
        )
        for f in frames
    ]
    plain, blocked = (
        forecast(mixed_model, fold(mixed_model, s), mode="gmm", agents=("0",))
        for s in (frames, with_tree)
    )
    assert np.abs(given(plain.mean) - given(blocked.mean)).max() > 1e-4


def test_an_empty_scene_has_an_empty_forecast(model: Trajectron) -> None:
    found = forecast(model, model.initial_state())
    assert found.ids == () and found.samples is not None and found.samples.shape[0] == 0
