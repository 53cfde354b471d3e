"""The social-force crowd: repeatable, apart from each other, inside its walls, on its way."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial import cKDTree

from trajectron_model.simulation import (
    LAYOUTS,
    Crowd,
    Float64,
    Layout,
    Scenario,
    SocialForce,
    acceleration,
    advance,
    crossing,
    crowds,
    nearest_on_segment,
    simulate,
)

QUIET = SocialForce(fluctuation_mps=0.0)
OPEN = Layout(
    walls=np.empty((0, 2, 2)),
    gates=np.array([[(0.0, -1.0), (0.0, 1.0)], [(100.0, -1.0), (100.0, 1.0)]]),
    routes=np.array([(0, 1), (1, 0)]),
)


def crowd_of(position: Sequence[tuple[float, float]], route: Sequence[int], speed: float) -> Crowd:
    """Agents at rest."""
    count = len(position)
    return Crowd(
        ids=np.arange(count),
        position=np.array(position, dtype=float),
        velocity=np.zeros((count, 2)),
        desired_speed=np.full(count, speed),
        route=np.array(route),
        leg=np.ones(count, dtype=np.int64),
    )


def walk(crowd: Crowd, layout: Layout, steps: int, force: SocialForce = QUIET) -> list[Crowd]:
    rng = np.random.default_rng(0)
    result = [crowd]
    for _ in range(steps):
        result.append(advance(result[-1], layout, force, 0.04, rng))
    return result


def recorded(scenario: Scenario, num_agents: int, frames: int, seed: int = 1) -> list[Crowd]:
    return list(itertools.islice(crowds(scenario, num_agents, seed=seed), frames))


def nearest_distances(position: Float64) -> Float64:
    return np.asarray(cKDTree(position).query(position, k=2)[0])[:, 1]


def test_nearest_point_of_a_segment_is_an_end_or_the_foot_of_the_perpendicular() -> None:
    segment = np.array([(0.0, 0.0), (2.0, 0.0)])
    points = np.array([(-1.0, 1.0), (0.5, 3.0), (5.0, 0.0)])
    np.testing.assert_allclose(nearest_on_segment(points, segment), [(0, 0), (0.5, 0), (2, 0)])


def test_a_lone_walker_at_rest_starts_with_speed_over_relaxation_time() -> None:
    force = acceleration(crowd_of([(0, 0)], [0], speed=1.5), OPEN, QUIET)
    np.testing.assert_allclose(force, [(1.5 / 0.5, 0.0)])


def test_a_lone_walker_approaches_the_desired_speed_exponentially() -> None:
    last = walk(crowd_of([(0, 0)], [0], speed=1.2), OPEN, steps=50)[-1]
    assert last.velocity[0, 0] == pytest.approx(1.2 * (1 - math.exp(-2.0 / 0.5)), rel=0.01)
    assert last.velocity[0, 1] == 0.0


def test_a_wall_pushes_away_from_it_as_its_potential_falls() -> None:
    wall = Layout(np.array([[(-50.0, 0.0), (50.0, 0.0)]]), OPEN.gates, OPEN.routes)
    crowd = crowd_of([(0.0, 0.3)], [0], speed=1.0)
    force = acceleration(crowd, wall, QUIET) - acceleration(crowd, OPEN, QUIET)
    np.testing.assert_allclose(force, [(0.0, 10.0 / 0.2 * math.exp(-0.3 / 0.2))])


def test_someone_standing_repels_by_the_circular_potential_less_from_behind() -> None:
    # The first has the second before it, the second has the first at its back.
    crowd = crowd_of([(0.0, 0.0), (1.0, 0.0)], [0, 0], speed=1.0)
    force = acceleration(crowd, OPEN, QUIET) - 1.0 / 0.5 * np.array([(1.0, 0.0), (1.0, 0.0)])
    push = 2.1 / 0.3 * math.exp(-1.0 / 0.3)
    np.testing.assert_allclose(force, [(-push, 0.0), (0.5 * push, 0.0)], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("apart", [(0.0, 0.0), (1e-9, 0.0), (0.3, 0.0), (0.67, 0.0), (0.0, 0.5)])
def test_the_force_stays_bounded_wherever_two_walkers_stand(apart: tuple[float, float]) -> None:
    crowd = crowd_of([(0.0, 0.0), apart], [0, 0], speed=1.34)
    crowd = crowd._replace(velocity=np.array([(1.34, 0.0), (1.34, 0.0)]))
    force = acceleration(crowd, OPEN, QUIET)
    assert np.isfinite(force).all()
    assert np.linalg.norm(force, axis=1).max() <= 2.1 / 0.3 + 120.0 * 0.4 + 1.34 / 0.5


def test_two_who_meet_head_on_evade_and_both_get_through() -> None:
    crowd = crowd_of([(40.0, 0.05), (60.0, -0.05)], [0, 1], speed=1.3)
    run = walk(crowd, OPEN, steps=500, force=SocialForce(fluctuation_mps=0.01))
    gaps = [np.linalg.norm(c.position[0] - c.position[1]) for c in run]
    assert min(gaps) > 0.3
    assert run[-1].position[0, 0] > 60.0
    assert run[-1].position[1, 0] < 40.0


def test_who_is_pushed_into_the_wrong_arm_of_a_crossing_comes_out_again() -> None:
    layout = crossing(30)
    stray = crowd_of([(-1.5, -4.0)], [0], speed=1.3)
    run = walk(stray, layout, steps=150)
    assert abs(run[-1].position[0, 1]) < 2.0, "still in the lower arm"


@pytest.mark.parametrize("scenario", Scenario)
def test_the_same_seed_gives_the_same_crowd_and_another_seed_another(scenario: Scenario) -> None:
    first, again = recorded(scenario, 40, 12, seed=5), recorded(scenario, 40, 12, seed=5)
    for one, two in zip(first, again, strict=True):
        for a, b in zip(one, two, strict=True):
            np.testing.assert_array_equal(a, b)
    other = recorded(scenario, 40, 1, seed=6)[0]
    assert not np.array_equal(first[0].position, other.position)


@pytest.mark.parametrize("scenario", Scenario)
def test_bodies_do_not_overlap_by_more_than_a_squeeze(scenario: Scenario) -> None:
    run = recorded(scenario, 80, 80)
    gaps = np.concatenate([nearest_distances(c.position) for c in run])
    assert gaps.min() > 0.2
    assert np.quantile(gaps, 0.05) > 0.4


@pytest.mark.parametrize("scenario", Scenario)
def test_walkers_keep_near_their_desired_speed_and_below_its_bound(scenario: Scenario) -> None:
    run = recorded(scenario, 80, 60)
    ratio = np.concatenate([np.linalg.norm(c.velocity, axis=1) / c.desired_speed for c in run])
    assert ratio.max() <= 1.3 + 1e-9
    assert 0.85 < ratio.mean() < 1.05


@pytest.mark.parametrize("scenario", Scenario)
def test_agents_come_and_go_while_their_number_stays(scenario: Scenario) -> None:
    run = recorded(scenario, 60, 100)
    assert len(run[0].ids) == 60
    assert all(50 <= len(c.ids) <= 60 for c in run)
    assert all((np.diff(c.ids) > 0).all() for c in run)
    assert run[-1].ids.max() > 100, "nobody new has come"
    gone: set[int] = set()
    for before, after in itertools.pairwise(run):
        gone |= set(before.ids.tolist()) - set(after.ids.tolist())
        assert not gone & set(after.ids.tolist()), "an id was used twice"


def test_both_directions_flow_through_the_corridor_between_its_walls() -> None:
    run = recorded(Scenario.CORRIDOR, 100, 120)
    layout = LAYOUTS[Scenario.CORRIDOR](100)
    half = layout.walls[:, :, 1].max()
    assert all(np.abs(c.position[:, 1]).max() < half for c in run)
    last = run[-1]
    right = last.route == 0
    assert 0.25 < right.mean() < 0.75
    assert last.velocity[right, 0].mean() > 1.0
    assert last.velocity[~right, 0].mean() < -1.0


def test_lanes_form_in_the_corridor() -> None:
    # The paper's finding: whoever walks beside or ahead mostly walks the same way.
    def alike(crowd: Crowd) -> float:
        pairs = cKDTree(crowd.position * [0.3, 1.0]).query_pairs(0.8, output_type="ndarray")
        return float((crowd.route[pairs[:, 0]] == crowd.route[pairs[:, 1]]).mean())

    run = recorded(Scenario.CORRIDOR, 120, 150)
    early = np.mean([alike(c) for c in run[:5]])
    late = np.mean([alike(c) for c in run[100:]])
    assert late > early + 0.1


def test_walls_of_the_crossing_hold() -> None:
    layout = LAYOUTS[Scenario.CROSSING](100)
    near = np.abs(layout.walls).min()
    for crowd in recorded(Scenario.CROSSING, 100, 100):
        # Inside one of the two corridors, at least: not in the blocks at the corners.
        assert (np.abs(crowd.position).min(1) < near).all()


@pytest.mark.parametrize("scenario", Scenario)
def test_two_thousand_agents_stay_finite_and_apart(scenario: Scenario) -> None:
    run = recorded(scenario, 2000, 6)
    assert len(run[0].ids) == 2000
    for crowd in run:
        assert all(np.isfinite(array).all() for array in crowd)
        assert nearest_distances(crowd.position).min() > 0.2


def test_one_agent_is_a_crowd_too() -> None:
    run = recorded(Scenario.SQUARE, 1, 60)
    assert {len(c.ids) for c in run} <= {0, 1}
    assert run[-1].ids.max(initial=0) >= 1


def test_frames_carry_time_ids_types_and_positions() -> None:
    frames = list(itertools.islice(simulate(Scenario.SQUARE, 5, seed=2, agent_type="robot"), 3))
    walked = list(itertools.islice(crowds(Scenario.SQUARE, 5, seed=2), 3))
    assert [f.time_s for f in frames] == pytest.approx([0.0, 0.4, 0.8])
    for frame, crowd in zip(frames, walked, strict=True):
        assert frame.ids == tuple(str(i) for i in crowd.ids)
        assert frame.types == ("robot",) * len(crowd.ids)
        np.testing.assert_array_equal(frame.positions, crowd.position)


def test_frames_far_apart_are_integrated_as_finely() -> None:
    frames = list(itertools.islice(simulate(Scenario.CORRIDOR, 30, seed=2, dt_s=1.0), 10))
    assert frames[-1].time_s == pytest.approx(9.0)
    assert min(nearest_distances(f.positions).min() for f in frames) > 0.2


@pytest.mark.parametrize(
    ("num_agents", "dt_s"), [(0, 0.4), (-3, 0.4), (5, 0.0), (5, -1.0), (5, math.nan)]
)
def test_senseless_arguments_are_refused_at_once(num_agents: int, dt_s: float) -> None:
    with pytest.raises(ValueError, match="must be"):
        simulate(Scenario.SQUARE, num_agents, seed=0, dt_s=dt_s)
