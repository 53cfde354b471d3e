"""Frames of any rate onto the grid: what each frame causes, and where forecasts start."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.service.building import observation

from trajectron_service.messages import Outcome
from trajectron_service.timebase import (
    DEPARTED_REMEMBERED,
    MAX_FILL_STEPS,
    Advance,
    Grid,
    Observation,
    Timeline,
    advance,
    classify,
    head,
    interpolate,
)

DT_S = 0.4


def timeline(interval_s: float | None = None, agent_timeout_s: float = 2.0) -> Timeline:
    return Timeline(Grid.of(DT_S, interval_s, agent_timeout_s))


def at(times: Iterable[float], speed: float = 1.0) -> list[Observation]:
    """One person who walks along x."""
    return [observation(t, ann=(speed * t, 0.0)) for t in times]


def fold(line: Timeline, frames: Iterable[Observation]) -> list[Advance]:
    taken = []
    for one in frames:
        assert classify(line, one) is Outcome.ACCEPTED
        taken.append(advance(line, one))
        line = taken[-1].timeline
    return taken


def step_times(taken: Sequence[Advance]) -> list[list[float]]:
    return [[round(s.frame.time_s, 9) for s in one.steps] for one in taken]


@pytest.mark.parametrize(
    ("interval_s", "chains"),
    [(None, 1), (0.4, 1), (0.1, 4), (0.04, 10), (0.0999, 4), (0.15, 1), (0.5, 1), (0.01, 1)],
)
def test_only_whole_fractions_of_dt_interleave_chains(
    interval_s: float | None, chains: int
) -> None:
    assert Grid.of(DT_S, interval_s, 2.0).chains == chains


def test_at_the_models_rate_each_frame_is_one_step_from_the_state_before() -> None:
    taken = fold(timeline(), at([0.0, 0.4, 0.8, 1.2]))
    steps = [step for one in taken for step in one.steps]
    assert [(s.source, s.result) for s in steps] == [(None, 0), (0, 1), (1, 2), (2, 3)]
    assert [s.frame.time_s for s in steps] == [0.0, 0.4, 0.8, 1.2]
    last = head(taken[-1].timeline)
    assert (last.source, last.frame) == (3, None)


def test_at_four_times_the_rate_each_frame_advances_the_chain_whose_turn_it_is() -> None:
    taken = fold(timeline(0.1), at(np.arange(10) * 0.1))
    steps = [step for one in taken for step in one.steps]
    assert [len(one.steps) for one in taken] == [1] * 10
    assert [s.source for s in steps] == [None, None, None, None, 0, 1, 2, 3, 4, 5]
    assert all(head(one.timeline).frame is None for one in taken)


def test_a_dropped_frame_is_interpolated_between_its_neighbours() -> None:
    times = [0.0, 0.1, 0.2, 0.3, 0.4, 0.6]  # 0.5 is missing
    taken = fold(timeline(0.1), at(times, speed=3.0))
    filled, newest = taken[-1].steps
    assert filled.frame.time_s == pytest.approx(0.5)
    assert filled.frame.positions[0, 0] == pytest.approx(1.5)
    assert (filled.source, newest.source) == (1, 2)


def test_a_jittering_or_drifting_clock_still_gives_one_step_a_frame() -> None:
    jitter = np.array([0.0, 0.02, -0.02, 0.015, -0.02, 0.0, 0.02, -0.01])
    taken = fold(timeline(), at(np.arange(8) * 0.4 + jitter))
    assert [len(one.steps) for one in taken] == [1] * 8
    drifting = fold(timeline(), at(np.arange(200) * 0.403))
    assert [len(one.steps) for one in drifting] == [1] * 200


def test_half_a_second_between_frames_is_put_on_the_grid() -> None:
    taken = fold(timeline(), at([0.0, 0.5, 1.0, 1.5, 2.0]))
    assert step_times(taken) == [[0.0], [0.4], [0.8], [1.2], [1.6, 2.0]]
    # From the newest state that is at least half a step old.
    heads = [head(one.timeline) for one in taken]
    assert [h.source for h in heads] == [0, 0, 2, 3, 5]
    assert [h.frame is None for h in heads] == [True, False, False, False, True]
    assert [h.time_s for h in heads] == [0.0, 0.5, 1.0, 1.5, 2.0]


def test_frames_faster_than_declared_do_not_hurry_the_model() -> None:
    taken = fold(timeline(), at(np.arange(13) * 0.1))
    assert step_times(taken) == [
        [0.0], [], [], [], [0.4], [], [], [], [0.8], [], [], [], [1.2]
    ]  # fmt: skip
    # 0.1 s after the first frame no state is old enough: the forecast starts afresh.
    sources = [head(one.timeline).source for one in taken]
    assert sources == [0, None, 0, 0, 1, 0, 1, 1, 2, 1, 2, 2, 3]


def test_of_many_frames_near_a_slot_the_nearest_takes_it() -> None:
    taken = fold(timeline(), at(np.arange(37) / 30.0))
    steps = [time for times in step_times(taken) for time in times]
    assert steps == pytest.approx([0.0, 0.4, 0.8, 1.2])


def test_after_a_long_silence_nothing_is_filled() -> None:
    line = timeline(agent_timeout_s=1000.0)
    *_, last = fold(line, [*at([0.0, 0.4]), observation(500.0, ann=(1.0, 0.0))])
    assert [(s.source, s.frame.time_s) for s in last.steps] == [(1, 500.0)]
    assert last.outcome is Outcome.ACCEPTED


def test_a_silence_beyond_the_agent_timeout_starts_everyone_anew() -> None:
    *_, last = fold(timeline(agent_timeout_s=0.9), at([0.0, 0.4, 1.4]))
    (step,) = last.steps
    assert step.drop == {"ann"}
    assert last.gaps == ("ann",)
    assert last.outcome is Outcome.ACCEPTED_WITH_GAPS


def test_an_agent_back_within_the_timeout_goes_on() -> None:
    frames = [
        observation(0.0, ann=(0.0, 0.0), bob=(5.0, 0.0)),
        observation(0.4, bob=(5.0, 0.0)),
        observation(0.8, bob=(5.0, 0.0), ann=(1.0, 0.0)),
    ]
    *_, last = fold(timeline(), frames)
    assert last.outcome is Outcome.ACCEPTED
    assert last.steps[0].drop == frozenset()


def test_an_agent_back_after_the_timeout_is_named_and_starts_anew() -> None:
    away = [observation(0.4 * k, bob=(5.0, 0.0)) for k in range(1, 7)]
    first = observation(0.0, ann=(0.0, 0.0), bob=(5.0, 0.0))
    taken = fold(timeline(), [first, *away, observation(2.8, bob=(5.0, 0.0), ann=(1.0, 0.0))])
    seen = ["ann" in one.timeline.seen for one in taken]
    # 2.0 s after it was seen it is still there; at 2.4 s it is dropped.
    assert seen == [True, True, True, True, True, True, False, True]
    assert [one.gaps for one in taken] == [()] * 7 + [("ann",)]
    assert "ann" in taken[-2].steps[0].drop
    assert "ann" not in head(taken[-2].timeline).ids


def test_every_chain_forgets_a_dropped_agent() -> None:
    line = timeline(0.1, agent_timeout_s=0.35)
    frames = [observation(0.1 * k, ann=(0.0, 0.0), bob=(1.0, 1.0)) for k in range(4)]
    frames += [observation(0.1 * k, bob=(1.0, 1.0)) for k in range(4, 12)]
    taken = fold(line, frames)
    drops = [one.steps[0].drop for one in taken]
    # Unseen since 0.3 s, dropped at 0.7 s: by each of the four chains as its turn comes.
    assert drops == [frozenset()] * 7 + [{"ann"}] * 4 + [frozenset()]
    assert not any("ann" in state.ids for state in taken[7].timeline.committed)


def test_an_agent_of_another_type_starts_anew() -> None:
    first = observation(0.0, ann=(0.0, 0.0))
    other = Observation(0.4, ("ann",), ("cyclist",), np.array([[0.3, 0.0]]))
    *_, last = fold(timeline(), [first, other])
    assert last.gaps == ("ann",)
    assert last.steps[0].drop == {"ann"}


def test_only_agents_of_both_frames_are_interpolated() -> None:
    before = observation(0.0, ann=(0.0, 0.0), bob=(4.0, 4.0))
    after = observation(1.0, cat=(9.0, 9.0), ann=(2.0, 4.0))
    between = interpolate(before, after, 0.25)
    assert between.ids == ("ann",)
    np.testing.assert_allclose(between.positions, [[0.5, 1.0]])


def test_an_empty_frame_is_a_frame() -> None:
    taken = fold(timeline(), [observation(0.0), observation(0.4, ann=(0.0, 0.0)), observation(0.8)])
    assert [one.outcome for one in taken] == [Outcome.ACCEPTED] * 3
    assert head(taken[-1].timeline).ids == {"ann"}


def test_same_time_is_a_duplicate_or_a_conflict_and_earlier_is_out_of_order() -> None:
    both = observation(0.4, ann=(0.0, 0.0), bob=(1.0, 1.0))
    line = advance(timeline(), both).timeline
    swapped = observation(0.4, bob=(1.0, 1.0), ann=(0.0, 0.0))
    assert classify(line, swapped) is Outcome.DUPLICATE
    assert classify(line, observation(0.4, ann=(0.0, 0.0))) is Outcome.CONFLICT
    moved = observation(0.4, ann=(0.0, 0.0), bob=(1.0, 1.5))
    assert classify(line, moved) is Outcome.CONFLICT
    assert classify(line, observation(0.3)) is Outcome.OUT_OF_ORDER
    assert classify(line, observation(0.5)) is Outcome.ACCEPTED


def test_a_scene_without_frames_has_no_head() -> None:
    with pytest.raises(ValueError, match="without frames"):
        head(timeline())


def test_the_memory_of_dropped_agents_is_bounded() -> None:
    line = timeline(agent_timeout_s=0.5)
    per_frame = DEPARTED_REMEMBERED // 4
    for k in range(12):
        names = {f"{k}-{i}": (0.0, 0.0) for i in range(per_frame)}
        line = advance(line, observation(k * 0.4, **names)).timeline
    assert len(line.departed) == DEPARTED_REMEMBERED
    assert len(line.seen) == 2 * per_frame


@st.composite
def recordings(draw: st.DrawFn) -> tuple[float | None, float, list[Observation]]:
    """Frames at any times, with agents that come and go, at any declared interval."""
    interval_s = draw(st.sampled_from([None, 0.4, 0.2, 0.1, 0.05, 0.15, 0.5, 0.7]))
    timeout_s = draw(st.sampled_from([0.5, 2.0, 30.0]))
    gaps = draw(
        st.lists(
            st.one_of(
                st.sampled_from([0.1, 0.2, 0.4, 0.5]),
                st.floats(0.001, 1.0),
                st.floats(1.0, 50.0),
            ),
            min_size=1,
            max_size=25,
        )
    )
    frames = []
    for time_s in np.cumsum(gaps):
        present = draw(st.sets(st.sampled_from(["ann", "bob", "cat"])))
        places = {n: (float(time_s) * i, 2.0 * i) for i, n in enumerate(sorted(present), 1)}
        frames.append(observation(float(time_s), **places))
    return interval_s, timeout_s, frames


@settings(max_examples=40, deadline=None)
@given(recordings())
def test_whatever_comes_work_is_bounded_and_nothing_is_extrapolated(
    recording: tuple[float | None, float, list[Observation]],
) -> None:
    interval_s, timeout_s, frames = recording
    line = timeline(interval_s, timeout_s)
    chains = line.grid.chains
    made: set[int] = set()
    for one in frames:
        before = line.newest
        taken = advance(line, one)
        line = taken.timeline
        assert len(taken.steps) <= MAX_FILL_STEPS * chains + 1
        for step in taken.steps:
            assert step.source is None or step.source in made
            assert step.result not in made
            made.add(step.result)
            if step.frame is not one:
                assert before is not None
                assert before.time_s < step.frame.time_s <= one.time_s + 1e-9
                assert set(step.frame.ids) <= set(before.ids) & set(one.ids)
        assert len(line.committed) <= chains + 1
        where = head(line)
        assert where.time_s == one.time_s
        assert set(one.ids) <= where.ids <= set(line.seen)
        assert where.source is None or where.source in {s.serial for s in line.committed}


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(0.02, 1.5), min_size=3, max_size=30))
def test_steps_of_a_chain_are_about_dt_apart(gaps: list[float]) -> None:
    taken = fold(timeline(agent_timeout_s=100.0), at(np.cumsum(gaps)))
    times = [step.frame.time_s for one in taken for step in one.steps]
    assert all(0.8 * DT_S - 1e-9 <= d <= 1.2 * DT_S + 1e-9 for d in np.diff(times))
