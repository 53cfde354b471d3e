"""Windows, on a scene drawn by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from trajectron_model.data.eth_ucy import EthUcy
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, batches, sgan_windows
from trajectron_model.evaluation import protocols

# Who is there at each of eight steps; windows below are of 2 observed and 2 further steps.
PRESENCE = {
    "whole": "########",
    "early": "#####...",
    "gap": "####.###",
    "brief": ".##.....",
}


def scene(presence: dict[str, str]) -> Recording:
    """Agents at x = step, y = their number, where their line has a mark."""
    rows = [
        (step, agent, float(step), float(agent))
        for agent, line in enumerate(presence.values())
        for step, mark in enumerate(line)
        if mark == "#"
    ]
    table = np.array(rows)
    return Recording.from_rows(
        name="scene",
        dt_s=0.4,
        start_time_s=0.0,
        ids=list(presence),
        types=["pedestrian"] * len(presence),
        step=table[:, 0].astype(np.int64),
        agent=table[:, 1].astype(np.int64),
        position=table[:, 2:],
        num_steps=len(next(iter(presence.values()))),
    )


def cut(presence: dict[str, str], min_agents: int) -> dict[int, tuple[str, ...]]:
    """The judged agents by first step of the windows of 2 + 2 steps."""
    windows = sgan_windows(scene(presence), observed=2, horizon=2, min_agents=min_agents)
    return {window.first: window.ids for window in windows}


def test_judged_are_those_present_in_all_steps() -> None:
    assert cut(PRESENCE, min_agents=1) == {
        0: ("whole", "early", "gap"),
        1: ("whole", "early"),
        2: ("whole",),
        3: ("whole",),
        4: ("whole",),
    }


def test_a_window_needs_enough_judged_agents() -> None:
    assert cut(PRESENCE, min_agents=2).keys() == {0, 1}
    assert cut(PRESENCE, min_agents=4) == {}


def test_frames_are_the_observed_steps_with_everyone_in_them() -> None:
    (window, *_) = sgan_windows(scene(PRESENCE), observed=2, horizon=2)
    frames = window.frames()
    assert [frame.ids for frame in frames] == [
        ("whole", "early", "gap"),
        ("whole", "early", "gap", "brief"),
    ]
    assert [frame.time_s for frame in frames] == [0.0, 0.4]


def test_history_and_future_are_the_judged_agents_positions() -> None:
    window = sgan_windows(scene(PRESENCE), observed=2, horizon=2)[1]
    assert (window.first, window.now) == (1, 2)
    assert window.history().tolist() == [
        [[1.0, 0.0], [2.0, 0.0]],
        [[1.0, 1.0], [2.0, 1.0]],
    ]
    assert window.future()[0].tolist() == [[3.0, 0.0], [4.0, 0.0]]


def test_an_absent_agent_has_no_position() -> None:
    window = Window(scene(PRESENCE), 0, 2, 2, np.array([3]))
    assert np.isnan(window.history()[0, 0]).all()
    assert window.history()[0, 1].tolist() == [1.0, 3.0]


def test_observations_count_from_where_an_agent_last_appeared() -> None:
    # At 0.4 s a step: five steps of absence are 2 s and bridged, six are not.
    lines = {
        "always": "#" * 12,
        "short": "##....####",
        "long": "###......##",
        "late": ".........###",
    }
    recording = scene({name: line.ljust(12, ".") for name, line in lines.items()})
    window = Window(recording, 0, 10, 2, np.arange(4))
    assert window.observations().tolist() == [10, 6, 1, 1]
    later = Window(recording, 2, 8, 2, np.arange(4))
    assert later.observations().tolist() == [8, 4, 1, 1]


def test_the_truth_may_be_another_recording_than_what_is_observed() -> None:
    clean = scene(PRESENCE)
    moved = replace(clean, position=clean.position + 100.0)
    window = Window(moved, 0, 2, 2, np.array([0]), truth=clean)
    assert window.history()[0, :, 0].tolist() == [100.0, 101.0]
    assert window.future()[0, :, 0].tolist() == [2.0, 3.0]


def test_a_future_beyond_the_recording_is_not_known() -> None:
    window = Window(scene(PRESENCE), 0, 7, 3, np.array([0]))
    assert window.future()[0, 0].tolist() == [7.0, 0.0]
    assert np.isnan(window.future()[0, 1:]).all()


def test_recordings_shorter_than_a_window_have_none() -> None:
    assert cut({"a": "###", "b": "###"}, min_agents=2) == {}


@given(st.lists(st.text("#.", min_size=9, max_size=9), min_size=1, max_size=4))
def test_windows_are_those_found_by_looking_at_each(lines: list[str]) -> None:
    presence = {"always": "#########"} | {f"{n}": line for n, line in enumerate(lines)}
    expected = {
        first: ids
        for first in range(6)
        for ids in [tuple(a for a, line in presence.items() if line[first : first + 4] == "####")]
        if len(ids) >= 2
    }
    assert cut(presence, min_agents=2) == expected


def test_batches_hold_all_windows_in_order() -> None:
    windows = sgan_windows(scene(PRESENCE), observed=2, horizon=2, min_agents=1)
    sizes = [[len(window.judged) for window in batch] for batch in batches(windows, 3)]
    assert sizes == [[3], [2, 1], [1, 1]]
    assert [len(batch) for batch in batches(windows, 1)] == [1] * 5
    assert list(batches([], 3)) == []


def test_real_windows_are_whole(eth_ucy: EthUcy) -> None:
    for window in protocols.windows("sgan", eth_ucy.test("hotel")):
        assert np.isfinite(window.history()).all()
        assert np.isfinite(window.future()).all()
        assert set(window.ids) <= set(window.frames()[-1].ids)
