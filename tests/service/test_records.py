"""A session as bytes is the session; anything else is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tests.service.building import observation

from trajectron_service import records
from trajectron_service.messages import SessionConfig, UnknownTypes
from trajectron_service.records import RecordError, SceneRecord
from trajectron_service.stores import SessionKey, StoredSession
from trajectron_service.stores.memory import MemoryStore
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


@pytest.mark.parametrize("cut", [0, 3, 8, 40, 200])
def test_damaged_bytes_are_refused(cut: int) -> None:
    with pytest.raises(RecordError):
        records.decode(records.encode(lively(), b"")[:cut])
    with pytest.raises(RecordError):
        records.decode(b"PK\x03\x04" + b"\0" * 50)


async def test_the_store_compares_versions_before_it_sets() -> None:
    store, key = MemoryStore(), SessionKey("t", "a")
    assert await store.create(key, StoredSession(0, 10.0, b"0"))
    assert not await store.create(key, StoredSession(0, 10.0, b"other"))
    assert await store.write(key, StoredSession(1, 10.0, b"1"), expected_version=0)
    assert not await store.write(key, StoredSession(1, 10.0, b"late"), expected_version=0)
    assert await store.read(key) == StoredSession(1, 10.0, b"1")
    assert await store.touch(key, 20.0)
    assert await store.expired(19.9, 10) == []
    assert await store.expired(20.0, 10) == [key]
    assert not await store.delete(key, expired_by=19.9)
    assert await store.delete(key, expired_by=20.0)
    assert not await store.delete(key)
    assert not await store.touch(key, 30.0)
    assert not await store.write(key, StoredSession(2, 10.0, b"2"), expected_version=1)
