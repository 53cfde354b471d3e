"""A recording: rows in order, frames, parts and dense arrays."""

from __future__ import annotations

import numpy as np
import pytest

from trajectron_model.data.recording import Recording


def recording(rows: list[tuple[int, int, float, float]], num_steps: int | None = None) -> Recording:
    """Rows of step, agent, x, y."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    agents = int(table[:, 1].max()) + 1 if rows else 0
    return Recording.from_rows(
        name="scene",
        dt_s=0.4,
        start_time_s=10.0,
        ids=[f"agent {n}" for n in range(agents)],
        types=["pedestrian"] * agents,
        step=table[:, 0].astype(np.int64),
        agent=table[:, 1].astype(np.int64),
        position=table[:, 2:],
        num_steps=num_steps,
        source_sha256="abc",
    )


CROSSING = [
    (2, 1, 5.0, 0.0),
    (0, 0, 0.0, 0.0),
    (2, 0, 2.0, 0.0),
    (1, 0, 1.0, 0.0),
    (4, 1, 3.0, 0.0),
]


def test_rows_are_sorted_by_step_then_agent() -> None:
    scene = recording(CROSSING)
    assert scene.step.tolist() == [0, 1, 2, 2, 4]
    assert scene.agent.tolist() == [0, 0, 0, 1, 1]
    assert scene.num_steps == 5


def test_a_frame_has_time_ids_types_and_positions() -> None:
    frame = recording(CROSSING).frame(2)
    assert frame.time_s == pytest.approx(10.8)
    assert frame.ids == ("agent 0", "agent 1")
    assert frame.types == ("pedestrian", "pedestrian")
    assert frame.positions.tolist() == [[2.0, 0.0], [5.0, 0.0]]


def test_an_empty_step_is_an_empty_frame() -> None:
    frame = recording(CROSSING).frame(3)
    assert frame.ids == ()
    assert frame.positions.shape == (0, 2)


def test_a_part_counts_its_steps_anew_and_drops_who_is_not_in_it() -> None:
    part = recording(CROSSING).between(3, 5)
    assert part.ids == ("agent 1",)
    assert part.step.tolist() == [1]
    assert part.num_steps == 2
    assert part.start_time_s == pytest.approx(11.2)
    assert part.time_s(1) == pytest.approx(recording(CROSSING).time_s(4))


def test_dense_arrays_are_nan_where_an_agent_is_absent() -> None:
    agents, positions = recording(CROSSING).dense(1, 4)
    assert agents.tolist() == [0, 1]
    np.testing.assert_array_equal(positions[..., 0], [[1.0, np.nan], [2.0, 5.0], [np.nan, np.nan]])
    assert recording(CROSSING).dense()[1].shape == (5, 2, 2)


def test_a_recording_without_rows_is_possible() -> None:
    scene = recording([], num_steps=3)
    assert scene.frame(1).ids == ()
    assert scene.dense()[1].shape == (3, 0, 2)


@pytest.mark.parametrize(("first", "last"), [(-1, 2), (0, 6), (3, 2)])
def test_steps_outside_are_refused(first: int, last: int) -> None:
    with pytest.raises(IndexError, match="outside"):
        recording(CROSSING).between(first, last)


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ([(0, 0, 0.0, 0.0), (0, 0, 1.0, 0.0)], "two rows at one step"),
        ([(-1, 0, 0.0, 0.0)], "steps must lie in"),
        ([(7, 0, 0.0, 0.0)], "steps must lie in"),
    ],
)
def test_rows_that_do_not_fit_are_refused(
    rows: list[tuple[int, int, float, float]], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        recording(rows, num_steps=5)


def test_provenance_names_recording_part_and_file() -> None:
    assert recording(CROSSING).provenance == {"name": "scene", "part": "whole", "sha256": "abc"}
