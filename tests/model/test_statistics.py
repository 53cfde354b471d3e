"""Means, intervals and tests: by hand, against scipy, and as often right as they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from trajectron_model.evaluation import statistics
from trajectron_model.evaluation.scores import AgentScores
from trajectron_model.evaluation.statistics import Sample, Values

NAN = np.nan


def scores(window: list[int], **columns: list[float] | list[list[float]]) -> AgentScores:
    agents = len(window)
    return AgentScores(
        window=np.array(window),
        agent=np.array([f"{n}" for n in range(agents)]),
        type=np.array(["pedestrian"] * agents),
        observations=np.full(agents, 8),
        columns={name: np.array(values, dtype=np.float64) for name, values in columns.items()},
    )


def sample(of: AgentScores, windows: int, times: int = 200) -> Sample:
    return Sample.of(Values.of(of, windows), statistics.resample(windows, times, 0, "set"))


def test_agents_weigh_alike_in_a_set_whatever_their_windows() -> None:
    found = sample(scores([0, 0, 0, 2], error=[1.0, 2.0, 3.0, 10.0]), 3).scores()
    assert found.metrics["error"].value == 4.0
    assert found.metrics["error"].agents == 4


def test_what_is_not_defined_does_not_count() -> None:
    found = sample(scores([0, 0, 1], error=[1.0, NAN, 3.0], none=[NAN] * 3), 2).scores()
    assert (found.metrics["error"].value, found.metrics["error"].agents) == (2.0, 2)
    assert found.metrics.keys() == {"error"}


def test_steps_are_averaged_for_each_agent_first() -> None:
    steps = [[1.0, 3.0, NAN], [7.0, NAN, NAN]]
    found = sample(scores([0, 1], distance=steps), 2).scores()
    assert found.metrics["distance"].value == (2.0 + 7.0) / 2
    each = found.by_step["distance"]
    assert [None if one is None else (one.value, one.agents) for one in each] == [
        (4.0, 2), (3.0, 1), None,
    ]  # fmt: skip


def test_a_set_of_many_weighs_as_one_of_few_in_the_mean_but_not_in_the_pool() -> None:
    many = sample(scores([0, 0, 1], error=[1.0, 1.0, 1.0]), 2)
    few = sample(scores([0], error=[5.0]), 1)
    assert statistics.mean_of_sets([many, few]).metrics["error"].value == 3.0
    assert statistics.pooled([many, few]).metrics["error"].value == 2.0
    assert statistics.pooled([many, few]).metrics["error"].agents == 4


def test_a_metric_that_a_set_lacks_has_no_mean_over_sets() -> None:
    one = sample(scores([0, 1], error=[1.0, 2.0], density=[0.5, 0.5]), 2)
    without = sample(scores([0, 1], error=[1.0, 2.0]), 2)
    undefined = sample(scores([0, 1], error=[1.0, 2.0], density=[NAN, NAN]), 2)
    for other in (without, undefined):
        for sets in ([one, other], [other, one]):
            assert statistics.mean_of_sets(sets).metrics.keys() == {"error"}
            assert statistics.pooled(sets).metrics.keys() == {"error"}


def test_a_step_that_a_set_lacks_has_no_figure_and_moves_no_other() -> None:
    whole = sample(scores([0, 1], distance=[[10.0, 20.0, 30.0, 40.0]] * 2), 2)
    gap = sample(scores([0, 1], distance=[[1.0, 2.0, NAN, 4.0]] * 2), 2)
    for sets in ([whole, gap], [gap, whole]):
        for over in (statistics.mean_of_sets, statistics.pooled):
            steps = over(sets).by_step["distance"]
            assert [None if one is None else (one.value, one.agents) for one in steps] == [
                (5.5, 4), (11.0, 4), None, (22.0, 4),
            ]  # fmt: skip


def test_sets_without_a_step_in_common_have_no_figures_by_step() -> None:
    first = sample(scores([0, 1], distance=[[1.0, NAN]] * 2), 2)
    second = sample(scores([0, 1], distance=[[NAN, 3.0]] * 2), 2)
    for over in (statistics.mean_of_sets, statistics.pooled):
        found = over([first, second])
        assert found.metrics["distance"].value == 2.0
        assert not found.by_step


def test_a_group_in_few_windows_has_an_interval_all_the_same() -> None:
    """One of 40 windows has it, so a third of the resamplings do not."""
    lone = sample(scores([7], error=[3.0]), 40)
    found = statistics.mean_of_sets([lone, lone]).metrics["error"]
    assert (found.value, found.low, found.high) == (3.0, 3.0, 3.0)


def test_some_agents_and_some_metrics_steps_can_be_had_alone() -> None:
    whole = scores(
        [0, 1, 1], distance=[[1.0, 3.0]] * 3, area=[[1.0, 1.0]] * 3, error=[1.0, 2.0, 6.0]
    )
    some = Values.of(whole, 2).only(np.array([True, False, True]), ("distance",))
    found = Sample.of(some, statistics.resample(2, 100, 0, "set")).scores()
    assert found.metrics["error"].value == 3.5
    assert found.metrics.keys() == {"area", "distance", "error"}
    assert found.by_step.keys() == {"distance"}


def test_intervals_hold_the_true_mean_as_often_as_they_say() -> None:
    """Agents of a window share an error, so a bootstrap over agents would be too sure."""
    random = np.random.default_rng(1)
    windows, agents, held = 40, 5, 0
    window = np.repeat(np.arange(windows), agents).tolist()
    for repetition in range(400):
        shared = random.normal(1.0, 1.0, windows).repeat(agents)
        values = shared + random.normal(0.0, 0.1, windows * agents)
        draws = statistics.resample(windows, 200, repetition, "set")
        of = Values.of(scores(window, error=values.tolist()), windows)
        estimate = Sample.of(of, draws).scores().metrics["error"]
        held += estimate.low <= 1.0 <= estimate.high
    assert 0.88 < held / 400 < 0.98


def test_resamplings_are_the_same_for_every_entry() -> None:
    first = statistics.resample(10, 50, 3, "eth")
    assert first.shape == (50, 10)
    assert (first.sum(axis=1) == 10).all()
    np.testing.assert_array_equal(first, statistics.resample(10, 50, 3, "eth"))
    assert not np.array_equal(first, statistics.resample(10, 50, 3, "hotel"))
    assert not np.array_equal(first, statistics.resample(10, 50, 4, "eth"))


def test_windows_means_are_over_their_agents_and_steps() -> None:
    of = scores([0, 0, 2], error=[1.0, 3.0, 5.0], nll=[[1.0, 3.0], [4.0, NAN], [NAN, NAN]])
    np.testing.assert_array_equal(statistics.window_means(of, "error", 3), [2.0, NAN, 5.0])
    np.testing.assert_array_equal(statistics.window_means(of, "nll", 3), [3.0, NAN, NAN])


def test_the_paired_test_is_scipys() -> None:
    random = np.random.default_rng(1)
    first, second = random.normal(1.0, 1.0, 30), random.normal(1.3, 1.0, 30)
    found = statistics.paired_t_test(np.append(first, NAN), np.append(second, 1.0))
    expected = stats.ttest_rel(first, second)
    assert found is not None
    assert found.pairs == 30
    assert found.difference == pytest.approx((first - second).mean(), rel=1e-5)
    assert found.t == pytest.approx(expected.statistic, rel=1e-5)
    assert found.p == pytest.approx(expected.pvalue, rel=1e-5)


def test_without_spread_there_is_no_test() -> None:
    ones = np.ones(5)
    assert statistics.paired_t_test(ones, ones) is None
    assert statistics.paired_t_test(ones, ones + 1.0) is None
    assert statistics.paired_t_test(ones[:1], ones[:1] + 1.0) is None
