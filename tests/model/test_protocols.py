"""Protocols: on scenes drawn by hand, and the published counts on the real recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trajectron_model.data.eth_ucy import EthUcy
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window
from trajectron_model.evaluation import protocols
from trajectron_model.evaluation.plan import PlanError


def scene(presence: dict[str, str]) -> Recording:
    """Agents at x = step + 1, y = their number + 1, where their line has a mark."""
    rows = np.array(
        [
            (step, agent)
            for agent, line in enumerate(presence.values())
            for step, mark in enumerate(line)
            if mark == "#"
        ]
    )
    return Recording.from_rows(
        name="scene",
        dt_s=0.4,
        start_time_s=0.0,
        ids=list(presence),
        types=["pedestrian"] * len(presence),
        step=rows[:, 0],
        agent=rows[:, 1],
        position=rows.astype(np.float64) + 1.0,
        num_steps=len(next(iter(presence.values()))),
    )


def test_streaming_judges_everyone_who_is_seen_again() -> None:
    recording = scene(
        {
            "whole": "#" * 20,
            "leaves": "##" + "." * 18,
            "returns": "#" + "." * 12 + "#" * 7,  # after 13 steps: beyond the horizon of 12
            "comes": "." * 17 + "###",
        }
    )
    windows = protocols.streaming(recording)
    assert [window.now for window in windows] == list(range(19))
    assert {window.first for window in windows} == {0}
    assert windows[0].ids == ("whole", "leaves")
    assert windows[1].ids == ("whole",)
    assert windows[13].ids == ("whole", "returns")
    assert windows[18].ids == ("whole", "returns", "comes")
    assert windows[18].observations().tolist() == [19, 6, 2]
    known = ~np.isnan(windows[10].future()[0, :, 0])
    assert known.tolist() == [True] * 9 + [False] * 3  # the recording ends


def judged(windows: list[Window]) -> dict[int, tuple[str, ...]]:
    return {window.now + 1: window.ids for window in windows}


def test_paper_judges_who_is_present_now_and_next_and_ranks_who_was_before() -> None:
    line = "#" * 29
    recording = scene(
        {
            "whole": line,
            "late": "." * 7 + "#" * 22,  # seen at 7, the newest observed step at t = 8
            "new": "." * 8 + "#" * 21,  # not seen yet at 7
            "leaves": "#" * 9 + "." * 20,  # its last step is t = 8
        }
    )
    windows = protocols.paper(recording)
    # L = 29: t = 8 and 16, both below L - 12 = 17.
    assert judged(windows) == {8: ("whole", "late", "leaves"), 16: ("whole", "late", "new")}
    assert [w.in_best_of.tolist() for w in windows if w.in_best_of is not None] == [
        [True, False, True],
        [True, True, True],
    ]
    assert windows[0].first == 0
    leaves = windows[0].future()[2]
    assert not np.isnan(leaves[0]).any()
    assert np.isnan(leaves[1:]).all()


def test_paper_cuts_chunks_of_a_hundred_steps() -> None:
    recording = scene({"walker": "#" * 160})
    windows = protocols.paper(recording)
    assert [window.first for window in windows if window.now < 100] == [0] * 10
    # t = 8, 16, ..., 80 < 88 in the whole chunk, 8, ..., 40 < 48 in the one of 60 steps.
    assert [window.now + 1 for window in windows[10:]] == [108, 116, 124, 132, 140]
    assert {window.first for window in windows[10:]} == {100}


def test_paper_shortens_a_chunk_by_its_trailing_empty_steps_only() -> None:
    def starts(line: str) -> list[int]:
        return [window.now + 1 for window in protocols.paper(scene({"walker": line}))]

    assert starts("#" * 29 + "." * 71) == [8, 16]
    assert starts("#" * 28 + "." * 72) == [8]
    assert starts("." * 20 + "#" * 20 + "." * 60) == [24]  # L = 40: t = 8, 16, 24; absent before


def test_paper_takes_a_coordinate_of_zero_for_absence() -> None:
    recording = scene({"whole": "#" * 29, "other": "#" * 29})
    position = recording.position.copy()
    position[(recording.agent == 1) & (recording.step == 7), 1] = 0.0
    windows = protocols.paper(replace(recording, position=position))
    assert judged(windows) == {8: ("whole",), 16: ("whole", "other")}
    assert windows[1].in_best_of is not None
    assert windows[1].in_best_of.tolist() == [True, True]  # absent at 7, asked for from 8 on


def test_thinning_takes_every_kth_window() -> None:
    windows = protocols.every(scene({"walker": "#" * 29}))
    assert len(windows) == 10
    kept, every_nth = protocols.thinned(windows, 4)
    assert (every_nth, [window.first for window in kept]) == (3, [0, 3, 6, 9])
    assert protocols.thinned(windows, 10) == (windows, 1)
    assert protocols.thinned(windows, None) == (windows, 1)


def test_jitter_moves_what_is_observed_and_not_the_truth() -> None:
    windows = protocols.every(scene({"walker": "#" * 200, "other": "#" * 200}))
    noisy = protocols.jittered(windows, 0.05, seed=3)
    off = noisy[20].history() - windows[20].history()
    assert 0.02 < off.std() < 0.1
    np.testing.assert_array_equal(noisy[20].future(), windows[20].future())
    # One noise for the recording: what two windows both see is the same.
    np.testing.assert_array_equal(noisy[20].history()[:, 1:], noisy[21].history()[:, :-1])
    again = protocols.jittered(windows, 0.05, seed=3)
    np.testing.assert_array_equal(again[20].history(), noisy[20].history())
    other = protocols.jittered(windows, 0.05, seed=4)
    assert not np.array_equal(other[20].history(), noisy[20].history())
    assert protocols.jittered(windows, 0.0, seed=3) == windows


def test_an_unknown_protocol_is_refused() -> None:
    with pytest.raises(PlanError, match="'own' is none of sgan, all, streaming, paper"):
        protocols.windows("own", [])


# Windows, judged agents; for `paper` those of best-of-N beside.
COUNTS = {
    ("sgan", "eth"): (70, 181),
    ("sgan", "hotel"): (301, 1053),
    ("sgan", "univ"): (947, 24334),
    ("sgan", "zara1"): (602, 2253),
    ("sgan", "zara2"): (921, 5833),
    ("all", "eth"): (253, 364),
    ("all", "hotel"): (445, 1197),
    ("all", "univ"): (947, 24334),
    ("all", "zara1"): (705, 2356),
    ("all", "zara2"): (998, 5910),
    ("streaming", "eth"): (860, 5132),
    ("streaming", "hotel"): (1137, 6154),
    ("streaming", "univ"): (983, 38917),
    ("streaming", "zara1"): (868, 5005),
    ("streaming", "zara2"): (1051, 9518),
    ("paper", "eth"): (84, 546, 67, 303),
    ("paper", "hotel"): (101, 568, 84, 346),
    ("paper", "univ"): (96, 3855, 96, 3330),
    ("paper", "zara1"): (87, 518, 82, 408),
    ("paper", "zara2"): (104, 980, 104, 837),
}


@pytest.mark.parametrize(("protocol", "test_set"), COUNTS)
def test_the_published_counts_are_met(eth_ucy: EthUcy, protocol: str, test_set: str) -> None:
    windows = protocols.windows(protocol, eth_ucy.test(test_set))
    counts = [len(windows), sum(len(window.judged) for window in windows)]
    if protocol == "paper":
        ranked = [int(w.in_best_of.sum()) for w in windows if w.in_best_of is not None]
        counts += [sum(n > 0 for n in ranked), sum(ranked)]
    assert tuple(counts) == COUNTS[protocol, test_set]


def test_streaming_judges_every_row_that_has_a_future(eth_ucy: EthUcy) -> None:
    (recording,) = eth_ucy.test("hotel")
    windows = protocols.streaming(recording)
    expected = 0
    for agent in range(len(recording.ids)):
        steps = recording.step[recording.agent == agent]
        expected += int((np.diff(steps) <= protocols.HORIZON).sum())
    assert sum(len(window.judged) for window in windows) == expected
    assert all(np.isfinite(window.history()[:, -1]).all() for window in windows[::50])
