"""Metrics on cases computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trajectron_model.metrics import (
    Float,
    average_displacement,
    best_of,
    displacement,
    final_displacement,
    joint_best_of,
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
