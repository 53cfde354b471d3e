"""Metrics on cases computed by hand."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trajectron_model.evaluation import metrics
from trajectron_model.evaluation.metrics import (
    Float,
    average_displacement,
    best_of,
    brier_final_displacement,
    collision_share,
    displacement,
    energy_score,
    final_displacement,
    joint_best_of,
    mean_over_known,
    miss_rate,
)


def test_displacement_is_the_distance_at_each_step() -> None:
    truth = np.array([[[0.0, 0.0], [1.0, 1.0]]])  # [A, H, 2]
    forecast = np.array([[[[3.0, 4.0], [1.0, 1.0]]], [[[0.0, 0.0], [1.0, 3.0]]]])  # [S, A, H, 2]
    distance = displacement(forecast, truth)
    assert distance.tolist() == [[[5.0, 0.0]], [[0.0, 2.0]]]
    assert average_displacement(distance).tolist() == [[2.5], [1.0]]
    assert final_displacement(distance).tolist() == [[0.0], [2.0]]


# Two agents: sample 0 suits the first, sample 1 the second, sample 2 both middling.
ERRORS = np.array([[0.0, 9.0], [8.0, 1.0], [3.0, 3.0]])  # [S, A]


def test_per_agent_each_picks_its_own_sample() -> None:
    assert best_of(ERRORS, 3).tolist() == [0.0, 1.0]


def test_joint_one_sample_serves_all() -> None:
    assert joint_best_of(ERRORS, 3).tolist() == [3.0, 3.0]


def test_joint_picks_by_the_sum_not_by_any_agent() -> None:
    assert joint_best_of(np.array([[0.0, 9.0], [8.0, 0.5]]), 2).tolist() == [8.0, 0.5]


def test_more_samples_than_n_are_averaged_over_disjoint_groups() -> None:
    errors = np.array([[1.0], [2.0], [7.0], [5.0], [0.0]])  # groups of two; the last is left over
    assert best_of(errors, 2).tolist() == [(1.0 + 5.0) / 2]
    assert joint_best_of(errors, 2).tolist() == [(1.0 + 5.0) / 2]
    assert best_of(errors, 1).tolist() == [3.0]


@pytest.mark.parametrize("n", [0, 4])
def test_best_of_more_than_there_are_is_refused(n: int) -> None:
    with pytest.raises(ValueError, match=f"best of {n} needs at least {n} samples; there are 3"):
        best_of(ERRORS, n)
    with pytest.raises(ValueError, match="there are 3"):
        joint_best_of(ERRORS, n)


@given(
    hnp.arrays(
        np.float64,
        st.tuples(st.integers(1, 12), st.integers(1, 4)),
        elements=st.floats(0, 100),
    )
)
def test_the_joint_form_lies_between_one_sample_and_the_best_per_agent(errors: Float) -> None:
    samples = len(errors)
    joint = joint_best_of(errors, samples)
    assert np.all(joint >= best_of(errors, samples))
    assert joint.sum() <= best_of(errors, 1).sum() + 1e-9


def test_a_lone_agent_has_one_form_only() -> None:
    errors = np.random.default_rng(0).uniform(size=(100, 1))
    for n in (1, 5, 20, 100):
        np.testing.assert_array_equal(best_of(errors, n), joint_best_of(errors, n))


def test_groups_give_the_expected_minimum() -> None:
    # The minimum of n uniform numbers is 1 / (n + 1) on average.
    errors = np.random.default_rng(1).uniform(size=(20 * 5000, 1))
    assert best_of(errors, 20)[0] == pytest.approx(1 / 21, rel=0.05)


NAN = np.nan


def test_errors_are_over_the_known_steps() -> None:
    truth = np.array([[[0.0, 0.0], [0.0, 0.0], [NAN, NAN]], [[NAN, NAN]] * 3])
    forecast = np.array([[[1.0, 0.0], [3.0, 0.0], [9.0, 0.0]]] * 2)
    distance = displacement(forecast, truth)
    assert average_displacement(distance)[0] == 2.0
    assert final_displacement(distance)[0] == 3.0  # at the last step that is known
    assert np.isnan(average_displacement(distance)[1])
    assert np.isnan(final_displacement(distance)[1])


def test_a_gap_in_the_truth_is_left_out() -> None:
    assert mean_over_known(np.array([[1.0, NAN, 3.0], [NAN, NAN, NAN]]))[0] == 2.0
    assert final_displacement(np.array([[1.0, NAN, 3.0]])).tolist() == [3.0]
    assert final_displacement(np.array([[1.0, 2.0, NAN]])).tolist() == [2.0]


def test_a_miss_is_an_end_further_than_two_metres_away() -> None:
    errors = np.array([[2.0, 2.1], [5.0, 3.0], [2.5, 0.0], [9.0, 9.0]])  # [S, A]
    assert miss_rate(errors, 1).tolist() == [0.75, 0.75]
    assert miss_rate(errors, 2).tolist() == [0.5, 0.5]
    assert miss_rate(errors, 4).tolist() == [0.0, 0.0]
    assert np.isnan(miss_rate(np.array([[NAN]]), 1)).all()


def test_brier_adds_the_doubt_in_the_best_of_the_five_likeliest_modes() -> None:
    # Renormalised over the five: 0.3 / 0.9; the sixth is nearest, but too unlikely to compete.
    probability = np.array([[0.1, 0.3, 0.2, 0.2, 0.1, 0.1]])
    final = np.array([4.0, 2.0, 3.0, 5.0, 6.0, 0.0])
    distance = np.stack([np.full_like(final, 9.0), final], axis=-1)[:, None]  # [Z, A, H]
    doubt = 1.0 - 0.3 / 0.9
    assert brier_final_displacement(probability, distance).tolist() == [
        pytest.approx(2.0 + doubt**2)
    ]


def test_brier_of_a_single_mode_is_its_error() -> None:
    score = brier_final_displacement(np.array([[1.0]]), np.array([[[1.0, 2.5]]]))
    assert score.tolist() == [2.5]


def test_energy_is_distance_to_the_truth_less_half_the_spread() -> None:
    # Two steps; the samples are off by (3, 4) and by (0, 0) over both steps together.
    truth = np.zeros((1, 2, 2))
    samples = np.array([[[[3.0, 0.0], [0.0, 4.0]]], [[[0.0, 0.0], [0.0, 0.0]]]])  # [S, A, H, 2]
    assert energy_score(samples, truth).tolist() == [pytest.approx((5.0 + 0.0) / 2 - 0.5 * 5.0)]
    truth[0, 1] = NAN
    assert energy_score(samples, truth).tolist() == [pytest.approx((3.0 + 0.0) / 2 - 0.5 * 3.0)]
    truth[0, 0] = NAN
    assert np.isnan(energy_score(samples, truth)).all()


def test_energy_of_one_trajectory_is_its_distance() -> None:
    assert energy_score(np.full((7, 1, 1, 2), 3.0), np.zeros((1, 1, 2))).tolist() == [
        pytest.approx(3.0 * np.sqrt(2.0))
    ]


def test_energy_does_not_depend_on_the_number_of_samples_in_the_mean() -> None:
    random = np.random.default_rng(0)
    truth = np.zeros((400, 3, 2))
    few = energy_score(random.normal(size=(4, 400, 3, 2)), truth)
    many = energy_score(random.normal(size=(60, 400, 3, 2)), truth)
    assert few.mean() == pytest.approx(many.mean(), rel=0.05)


def paths(*ends: list[list[float]]) -> np.ndarray:
    """One sample of agents' positions: [1, A, H, 2]."""
    return np.array([ends])


def test_two_who_cross_between_steps_collide() -> None:
    now = np.array([[0.0, 0.0], [1.0, 0.0]])
    swapped = paths([[1.0, 0.0]], [[0.0, 0.0]])
    assert collision_share(swapped, now).tolist() == [1.0, 1.0]
    # The same, passing at 0.2 m.
    passing = paths([[1.0, 0.2]], [[0.0, 0.2]])
    assert collision_share(passing, np.array([[0.0, 0.0], [1.0, 0.4]])).tolist() == [0.0, 0.0]


def test_collisions_are_counted_over_samples_and_other_agents() -> None:
    now = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 9.0]])
    apart = paths([[0.0, 1.0]], [[5.0, 1.0]], [[0.0, 8.0]])
    meeting = paths([[0.0, 1.0]], [[0.05, 1.0]], [[0.0, 8.0]])
    share = collision_share(np.concatenate([apart, meeting, apart, apart]), now)
    assert share.tolist() == [0.125, 0.125, 0.0]  # one of four samples, one of two others


def test_who_stands_still_beside_another_at_a_tenth_of_a_metre_has_not_collided() -> None:
    now = np.array([[0.0, 0.0], [0.1001, 0.0]])
    assert collision_share(now[None, :, None], now).tolist() == [0.0, 0.0]
    assert collision_share(0.9 * now[None, :, None], now).tolist() == [1.0, 1.0]


def test_nobody_collides_alone() -> None:
    assert np.isnan(collision_share(np.zeros((3, 1, 2, 2)), np.zeros((1, 2)))).all()


def crowd(agents: int, samples: int = 20) -> tuple[Float, Float]:
    """Sampled paths [S, A, 6, 2] of people who jostle in a square, and where they are [A, 2]."""
    random = np.random.default_rng(0)
    now = random.uniform(0.0, 3.0, (agents, 2))
    steps = random.normal(0.0, 0.3, (samples, agents, 6, 2))
    return now[:, None] + steps.cumsum(axis=2), now


@pytest.mark.parametrize("pairs_at_a_time", [0, 1, 4, 7, 1000])
def test_collisions_do_not_depend_on_how_the_pairs_are_cut(
    monkeypatch: pytest.MonkeyPatch, pairs_at_a_time: int
) -> None:
    samples, now = crowd(9)
    monkeypatch.setattr(metrics, "_CELLS", pairs_at_a_time * 20 * 7 * 2)
    share = collision_share(samples, now)
    each = [
        [collision_share(samples[:, [one, other]], now[[one, other]])[0] for other in range(9)
         if other != one]
        for one in range(9)
    ]  # fmt: skip
    np.testing.assert_allclose(share, np.mean(each, axis=1), rtol=1e-12)
    assert share.any()


def peak_memory(agents: int) -> int:
    """Bytes that counting the collisions of a crowd takes beside its samples."""
    samples, now = crowd(agents)
    tracemalloc.start()
    try:
        collision_share(samples, now)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_collisions_in_a_crowd_take_bounded_memory() -> None:
    """All 44,850 pairs of 300 people at once would be 100 MB an array."""
    few, many = peak_memory(100), peak_memory(300)  # nine times the pairs
    assert many < 20e6
    assert many < 1.5 * few
