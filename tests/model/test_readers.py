"""Readers take what the formats say, and name file, line and reason for the rest."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trajectron_model.data.errors import DataError
from trajectron_model.data.readers import read, read_apolloscape, read_csv, read_eth_ucy
from trajectron_model.data.recording import Recording
from trajectron_model.data.writers import write_csv, write_eth_ucy

ETH = "780\t1.0\t8.46\t3.59\n790\t1.0\t9.57\t3.79\n790\t2.0\t1.0\t-2.0\n"
APOLLOSCAPE = "0 7 3 10.0 20.0 38.4 0.3 0.5 1.1 0.03\n1 7 3 11.0 20.0 38.4 0.3 0.5 1.1 0.03\n"


def file(folder: Path, text: str | bytes, name: str = "scene.txt") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def csv_file(folder: Path, *rows: str, header: str = "time,id,type,x,y") -> Path:
    return file(folder, "\n".join([header, *rows]) + "\n", "scene.csv")


def track(recording: Recording, agent_id: str) -> dict[int, tuple[float, float]]:
    """The positions of one agent by step."""
    rows = recording.agent == recording.ids.index(agent_id)
    x, y = recording.position[rows].T.tolist()
    return dict(zip(recording.step[rows].tolist(), zip(x, y, strict=True), strict=True))


def test_eth_ucy_text_is_read_onto_its_steps(tmp_path: Path) -> None:
    recording = read_eth_ucy(file(tmp_path, ETH))
    assert recording.name == "scene"
    assert recording.ids == ("1", "2")
    assert recording.types == ("pedestrian", "pedestrian")
    assert recording.num_steps == 2
    assert recording.start_time_s == pytest.approx(31.2)
    assert track(recording, "1") == {0: (8.46, 3.59), 1: (9.57, 3.79)}
    assert track(recording, "2") == {1: (1.0, -2.0)}


def test_the_order_of_rows_does_not_matter(tmp_path: Path) -> None:
    lines = ETH.splitlines(keepends=True)
    straight = read_eth_ucy(file(tmp_path, ETH))
    shuffled = read_eth_ucy(file(tmp_path, "".join(lines[::-1]), "other.txt"))
    assert shuffled.ids == straight.ids
    for name in ("step", "agent", "position"):
        np.testing.assert_array_equal(getattr(shuffled, name), getattr(straight, name))


def test_spaces_blank_lines_and_windows_line_ends_are_fine(tmp_path: Path) -> None:
    text = "\ufeff" + ETH.replace("\t", "  ").replace("\n", "\r\n") + "\r\n"
    assert track(read_eth_ucy(file(tmp_path, text)), "1") == {0: (8.46, 3.59), 1: (9.57, 3.79)}


def test_an_empty_step_stays_a_step(tmp_path: Path) -> None:
    recording = read_eth_ucy(file(tmp_path, "0 1 0 0\n30 1 3 0\n"))
    assert recording.num_steps == 4
    assert track(recording, "1") == {0: (0.0, 0.0), 3: (3.0, 0.0)}


def test_frames_per_step_and_dt_are_what_the_caller_says(tmp_path: Path) -> None:
    recording = read_eth_ucy(file(tmp_path, "6 1 0 0\n12 1 1 0\n"), frames_per_step=6, dt_s=0.5)
    assert recording.num_steps == 2
    assert (recording.start_time_s, recording.time_s(1)) == (0.5, 1.0)


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("0 1 2.0 3.0\n10 1 2.0\n", 2, "3 columns; expected 4"),
        ("0 1 2.0 3.0\n10 1 2.0 3.0 4.0\n", 2, "5 columns; expected 4"),
        ("0 1 2.0 three\n", 1, "y is 'three', not a number"),
        ("0 one 2.0 3.0\n", 1, "id is 'one', not a number"),
        ("0 1 nan 3.0\n", 1, "x is nan; it must be finite"),
        ("0 1 2.0 3.0\n\n10 1 2.0 -inf\n", 3, "y is -inf; it must be finite"),
        ("inf 1 2.0 3.0\n", 1, "frame is inf; it must be finite"),
        ("0 1 2.0 3.0\n10 1 2.0 3.0\n0 1.0 2.0 3.0\n", 3, "on line 1 already"),
        ("0 1 2.0 3.0\n10 1 2.0 3.0\n15 1 2.0 3.0\n", 3, "frame 15 is not a whole number of steps"),
        ("0 1 2.0 3.0\n1e12 1 2.0 3.0\n", 2, "at most 1000000 fit a recording"),
        ("", 1, "the file is empty"),
        (" \n\n", 1, "the file is empty"),
        (b"0 1 2 3\n10 1 2 \xff\n", 2, "not UTF-8 text"),
    ],
)
def test_bad_eth_ucy_text_names_the_line(
    tmp_path: Path, text: str | bytes, line: int, reason: str
) -> None:
    path = file(tmp_path, text)
    with pytest.raises(DataError) as caught:
        read_eth_ucy(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert reason in str(caught.value)
    assert caught.value.line == line


def test_a_missing_file_and_a_folder_are_data_errors(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere\.txt: No such file"):
        read(tmp_path / "nowhere.txt")
    with pytest.raises(DataError, match="Is a directory"):
        read(tmp_path)


def test_csv_on_the_grid_is_taken_as_it_is(tmp_path: Path) -> None:
    path = csv_file(tmp_path, "10.0,a,pedestrian,0,0", "10.4,a,pedestrian,1,2", "10.8,b,car,5,5")
    recording = read_csv(path)
    assert (recording.dt_s, recording.start_time_s, recording.num_steps) == (0.4, 10.0, 3)
    assert recording.ids == ("a", "b")
    assert recording.types == ("pedestrian", "car")
    assert track(recording, "a") == {0: (0.0, 0.0), 1: (1.0, 2.0)}
    assert track(recording, "b") == {2: (5.0, 5.0)}


def test_csv_at_another_rate_is_interpolated_between_the_two_nearest(tmp_path: Path) -> None:
    rows = [f"{t},a,pedestrian,{x},0" for t, x in [(0.0, 0), (0.3, 3), (0.6, 9), (0.9, 9)]]
    positions = track(read_csv(csv_file(tmp_path, *rows)), "a")
    assert positions.keys() == {0, 1, 2}
    assert positions[0] == (0.0, 0.0)
    assert positions[1] == pytest.approx((5.0, 0.0))  # a third of the way from 3 to 9
    assert positions[2] == pytest.approx((9.0, 0.0))


def test_a_long_gap_is_not_bridged_and_nothing_is_extrapolated(tmp_path: Path) -> None:
    rows = [
        "0.0,a,pedestrian,0,0",
        "0.5,b,pedestrian,0,0",  # from 0.5 to 1.5: a gap of 1.0 s is the longest bridged
        "1.5,b,pedestrian,10,0",
        "1.6,a,pedestrian,16,0",  # 1.6 s after its last: absent between
        "2.0,a,pedestrian,20,0",
    ]
    recording = read_csv(csv_file(tmp_path, *rows))
    assert track(recording, "a") == {0: (0.0, 0.0), 4: (16.0, 0.0), 5: (20.0, 0.0)}
    bridged = track(recording, "b")
    assert bridged.keys() == {2, 3}  # 0.8 and 1.2 s; neither 0.4 s before nor 1.6 s after
    assert bridged[2] == pytest.approx((3.0, 0.0))


def test_two_observations_near_one_step_are_one_row(tmp_path: Path) -> None:
    rows = ["0,a,pedestrian,0,0", "0.4,a,pedestrian,1,0", "0.400001,a,pedestrian,2,0"]
    assert track(read_csv(csv_file(tmp_path, *rows)), "a") == {0: (0.0, 0.0), 1: (1.0, 0.0)}


def test_times_since_1970_keep_their_precision(tmp_path: Path) -> None:
    rows = [f"{1.7e9 + 0.4 * k:.3f},a,pedestrian,{k},0" for k in range(1000)]
    recording = read_csv(csv_file(tmp_path, *rows))
    assert len(recording.step) == recording.num_steps == 1000
    np.testing.assert_array_equal(recording.position[:, 0], np.arange(1000.0))


@settings(max_examples=60, deadline=None)
@given(
    intervals=st.lists(st.floats(0.02, 1.6), min_size=1, max_size=30),
    velocity=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
)
def test_straight_walks_stay_straight_at_any_rate(
    tmp_path_factory: pytest.TempPathFactory,
    intervals: list[float],
    velocity: tuple[float, float],
) -> None:
    times = np.concatenate([[0.0], np.cumsum(intervals)])
    rows = [f"{t!r},a,pedestrian,{velocity[0] * t!r},{velocity[1] * t!r}" for t in times.tolist()]
    recording = read_csv(csv_file(tmp_path_factory.mktemp("walk"), *rows))
    at = recording.step * 0.4
    np.testing.assert_allclose(recording.position, at[:, None] * np.array(velocity), atol=1e-3)
    after = np.searchsorted(times, at - 1e-3)
    alone = np.abs(times[after] - at) < 1e-3
    gap = times[after] - times[np.maximum(after - 1, 0)]
    assert np.all(alone | (gap <= 1.0 + 1e-3))


@pytest.mark.parametrize(
    ("rows", "line", "reason"),
    [
        (["0,a,pedestrian,0,0", "0.4,a,pedestrian,1"], 3, "4 columns; expected 5"),
        (["0,a,pedestrian,zero,0"], 2, "x is 'zero', not a number"),
        (["0,a,pedestrian,0,"], 2, "y is '', not a number"),
        (["nan,a,pedestrian,0,0"], 2, "time is nan; it must be finite"),
        (["0,a,pedestrian,0,inf"], 2, "y is inf; it must be finite"),
        (["0,,pedestrian,0,0"], 2, "id is empty"),
        (["0,a,,0,0"], 2, "type is empty"),
        (["0,a,pedestrian,0,0", "0,b,car,0,0", "0.0,a,pedestrian,1,0"], 4, "on line 2 already"),
        (["0,a,pedestrian,0,0", "0.4,a,car,0,0"], 3, "agent a is a car here and a pedestrian"),
        (["0,a,pedestrian,0,0", "1e9,a,pedestrian,0,0"], 3, "at most 1000000 fit a recording"),
        (['0,"a,pedestrian,0,0'], 2, "not CSV"),
        ([], 1, "there are no rows after the header"),
    ],
)
def test_bad_csv_names_the_line(tmp_path: Path, rows: list[str], line: int, reason: str) -> None:
    path = csv_file(tmp_path, *rows)
    with pytest.raises(DataError) as caught:
        read_csv(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert reason in str(caught.value)


def test_an_unknown_header_is_shown_beside_the_right_one(tmp_path: Path) -> None:
    path = csv_file(tmp_path, "0,1,ped,2,3", header="frame,id,label,x_est,y_est")
    with pytest.raises(DataError, match=r":1: the header is frame,id,.*expected time,id,type,x,y"):
        read(path)


def test_the_columns_of_csv_may_stand_in_any_order(tmp_path: Path) -> None:
    path = csv_file(tmp_path, "1.5,2.5,a,car,0", header="x, y, ID, Type, Time")
    assert track(read_csv(path), "a") == {0: (1.5, 2.5)}


def test_apolloscape_is_read_at_its_own_rate_or_another(tmp_path: Path) -> None:
    path = file(tmp_path, APOLLOSCAPE)
    own = read_apolloscape(path)
    assert (own.dt_s, own.types) == (0.5, ("pedestrian",))
    assert track(own, "7") == {0: (10.0, 20.0), 1: (11.0, 20.0)}
    other = read_apolloscape(path, dt_s=0.25)
    assert other.num_steps == 3
    assert track(other, "7")[1] == pytest.approx((10.5, 20.0))


def test_apolloscape_at_its_own_rate_leaves_missing_frames_missing(tmp_path: Path) -> None:
    text = APOLLOSCAPE + "3 7 3 13.0 20.0 38.4 0.3 0.5 1.1 0.03\n"
    assert track(read_apolloscape(file(tmp_path, text)), "7").keys() == {0, 1, 3}


def test_apolloscape_types_have_names_and_other_is_left_out(tmp_path: Path) -> None:
    text = "".join(f"0 {kind} {kind} 1 2 0 0 0 0 0\n" for kind in (1, 2, 3, 4, 5))
    path = file(tmp_path, text)
    assert read_apolloscape(path).types == ("vehicle", "vehicle", "pedestrian", "cyclist")
    assert read_apolloscape(path, include_other=True).types[-1] == "other"
    with pytest.raises(DataError, match=":2: type is 9; expected 1 to 5"):
        read_apolloscape(file(tmp_path, APOLLOSCAPE.replace("1 7 3", "1 7 9")))


def test_the_format_is_recognised(tmp_path: Path) -> None:
    assert read(file(tmp_path, ETH)).dt_s == 0.4
    assert read(file(tmp_path, APOLLOSCAPE), dt_s=0.5).types == ("pedestrian",)
    assert read(csv_file(tmp_path, "0,a,car,1,2")).types == ("car",)
    with pytest.raises(DataError, match=r":1: 3 columns; expected the CSV header"):
        read(file(tmp_path, "1 2 3\n"))


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    recording = read_csv(csv_file(tmp_path, "0,a,car,1.25,2", "0.8,a,car,1,2", "0.8,b,bus,-3,4"))
    as_csv, as_text = io.StringIO(), io.StringIO()
    write_csv(recording, as_csv)
    write_eth_ucy(recording, as_text)
    again = read_csv(file(tmp_path, as_csv.getvalue(), "again.csv"))
    assert (again.ids, again.types) == (recording.ids, recording.types)
    text = read_eth_ucy(file(tmp_path, as_text.getvalue(), "again.txt"))
    for copy in (again, text):
        np.testing.assert_array_equal(copy.step, recording.step)
        np.testing.assert_array_equal(copy.agent, recording.agent)
        np.testing.assert_allclose(copy.position, recording.position, atol=1e-6)
