"""A session as bytes is the session; anything else is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tests.service.building import observation

from trajectron_service import records
from trajectron_service.messages import SessionConfig, UnknownTypes
from trajectron_service.records import RecordError, SceneRecord, UnknownFormatError
from trajectron_service.timebase import Grid, Timeline, advance


def lively() -> SceneRecord:
    """A session in which agents have come, gone and been dropped."""
    timeline = Timeline(Grid.of(0.4, 0.1, 0.3))
    for k in range(9):
        places = {"ann": (0.1 * k, 1e6 + 0.1)} | ({"böb 🙂": (1.0, 2.0)} if k < 3 else {})
        timeline = advance(timeline, observation(1.7e9 + 0.1 * k, **places)).timeline
    assert timeline.departed
    assert any(state.pending for state in timeline.committed)
    config = SessionConfig("m", 0.1, 0.3, 60.0, UnknownTypes.MAP, {"car": "pedestrian"})
    return SceneRecord(config, "hash", 12.5, timeline, 9, 41, b"", 2)


def test_bytes_give_the_session_back() -> None:
    before = lively()
    after = records.decode(records.encode(before, b"packed"))
    assert after.states == b"packed"
    assert after.info("a", 1.0) == before.info("a", 1.0)
    assert (after.model_hash, after.edge_count) == (before.model_hash, before.edge_count)
    for field in ("grid", "seen", "departed", "committed", "next_serial"):
        assert getattr(after.timeline, field) == getattr(before.timeline, field)
    newest, wanted = after.timeline.newest, before.timeline.newest
    assert newest is not None
    assert wanted is not None
    assert (newest.time_s, newest.ids, newest.types) == (wanted.time_s, wanted.ids, wanted.types)
    np.testing.assert_array_equal(newest.positions, wanted.positions)


def test_a_session_without_frames_has_bytes_too() -> None:
    blank = dataclasses.replace(lively(), timeline=Timeline(Grid.of(0.4, None, 2.0)), version=0)
    after = records.decode(records.encode(blank, b""))
    assert (after.timeline.newest, after.states) == (None, ())


@pytest.mark.parametrize("cut", [0, 3, 4, 8, 13, 40, 200, -1])
def test_bytes_cut_short_are_refused(cut: int) -> None:
    with pytest.raises(RecordError):
        records.decode(records.encode(lively(), b"packed")[:cut])


def test_a_single_wrong_bit_anywhere_is_refused() -> None:
    data = records.encode(lively(), b"packed states")
    for place in range(len(data)):
        wrong = bytearray(data)
        wrong[place] ^= 1 << (place % 8)
        with pytest.raises(RecordError):
            records.decode(bytes(wrong))


def test_another_format_is_told_apart_from_damage() -> None:
    data = records.encode(lively(), b"")
    with pytest.raises(UnknownFormatError, match="version 3"):
        records.decode(data[:3] + b"\x03" + data[4:])
    with pytest.raises(RecordError) as refusal:
        records.decode(b"PK\x03\x04" + b"\0" * 50)
    assert not isinstance(refusal.value, UnknownFormatError)


def test_each_agents_name_is_written_once() -> None:
    timeline = Timeline(Grid.of(0.4, None, 2.0))
    names = [f"agent-with-a-long-name-{k:04}" for k in range(40)]
    for step in range(3):
        places = {name: (step + 0.1, k + 0.2) for k, name in enumerate(names)}
        timeline = advance(timeline, observation(step * 0.4, **places)).timeline
    record = dataclasses.replace(lively(), timeline=timeline)
    # Time, place, and what is left of the name after compression.
    assert len(records.encode(record, b"")) < 40 * 50
