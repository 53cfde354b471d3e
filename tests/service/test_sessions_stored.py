"""What sessions make of their store: closures, damage, faults, replicas. No model is needed."""

from __future__ import annotations

import dataclasses

import pytest
from tests.service.building import Clock
from tests.service.test_sessions import IDLE_S, KEY, House, kind, record

from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.records import SceneRecord
from trajectron_service.sessions import Change
from trajectron_service.stores import Creation, Quota, SessionKey, StoredSession, StoreError
from trajectron_service.stores.memory import MemoryStore


async def look(one: SceneRecord) -> tuple[Change, int]:
    return Change(one), one.version


async def test_a_client_is_told_what_became_of_its_session_and_when() -> None:
    house = House()
    idle, deleted = SessionKey("default", "idle"), SessionKey("default", "deleted")
    await house.sessions.create(idle, record())
    house.clock.now += IDLE_S
    assert await house.sessions.reap() == 1
    await house.sessions.create(deleted, record())
    await house.sessions.delete(deleted)
    house.clock.now += 100.0
    for key, words in ((idle, r"for want of use at 1970-01-12T.* \(60 s unused\)"),
                       (deleted, r"it was deleted at 1970-01-12T")):  # fmt: skip
        for use in (house.sessions.info, house.sessions.delete, house.observe):
            with pytest.raises(ServiceError, match=words) as refusal:
                await use(key)
            assert kind(refusal) is ErrorKind.UNKNOWN_SESSION
    for nobody in (SessionKey("default", "nobody"), SessionKey("another tenant", "idle")):
        with pytest.raises(ServiceError, match="never opened"):
            await house.sessions.info(nobody)


async def test_a_session_that_is_held_stays_open_however_long_it_is_unused() -> None:
    store, clock = MemoryStore(durable=True), Clock()
    here, there = House(store, clock), House(store, clock)
    await here.sessions.create(KEY, record())
    with here.sessions.held(KEY):
        for _ in range(40):
            clock.now += IDLE_S / 4
            await here.sessions.renew()
            await here.sessions.park()
            # The other replica knows of the hold by the store alone.
            assert await there.sessions.reap() + await here.sessions.reap() == 0
        assert await here.observe() == 1
    clock.now += 1.05 * IDLE_S
    assert await there.sessions.reap() == 1


async def test_what_is_unreadable_is_set_aside_and_said_so() -> None:
    store = MemoryStore(durable=True)
    house = House(store)
    await house.sessions.create(KEY, record())
    stored = store._sessions[KEY]
    broken = dataclasses.replace(stored, data=stored.data[:-1] + b"?")
    store._sessions[KEY] = broken
    again = House(store, house.clock)
    for use in (again.observe, again.sessions.info, again.sessions.delete):
        with pytest.raises(ServiceError, match="set aside at") as refusal:
            await use(KEY)
        assert kind(refusal) is ErrorKind.SESSION_DAMAGED
    assert again.closed("damaged") == 1.0
    assert again.metrics.registry.get_sample_value("trajectron_sessions_quarantined") == 1.0
    assert list(store._aside.values()) == [broken.data]
    assert (await again.sessions.create(KEY, record())).version == 0


async def test_what_another_version_wrote_is_left_for_it() -> None:
    store = MemoryStore(durable=True)
    house = House(store)
    await house.sessions.create(KEY, record())
    stored = store._sessions[KEY]
    newer = stored.data[:3] + b"\x7f" + stored.data[4:]
    store._sessions[KEY] = dataclasses.replace(stored, data=newer)
    with pytest.raises(ServiceError, match="another version") as refusal:
        await House(store, house.clock).observe()
    assert kind(refusal) is ErrorKind.STORE_UNAVAILABLE
    assert store._sessions[KEY].data == newer
    assert await store.quarantined() == 0


class Faulty(MemoryStore):
    """A durable store that is away while ``down``."""

    down = False

    async def read(self, key: SessionKey) -> StoredSession | None:
        self._must_be_up()
        return await super().read(key)

    async def create(self, key: SessionKey, session: StoredSession, quota: Quota) -> Creation:
        self._must_be_up()
        return await super().create(key, session, quota)

    async def write(self, key: SessionKey, session: StoredSession, expected: str) -> bool:
        self._must_be_up()
        return await super().write(key, session, expected)

    async def touch(self, key: SessionKey, expires_at: float) -> bool:
        self._must_be_up()
        return await super().touch(key, expires_at)

    def _must_be_up(self) -> None:
        if self.down:
            raise StoreError("away")


@pytest.mark.parametrize("shared", [False, True])
async def test_without_its_store_it_reads_what_is_in_memory_and_refuses_to_write(
    shared: bool,
) -> None:
    store = Faulty(durable=True)
    store.shared = shared
    house = House(store)
    await house.sessions.create(KEY, record())
    assert await house.observe() == 1
    store.down = True
    house.clock.now += IDLE_S / 2  # the store would be told of the use
    for write in (house.observe(), house.sessions.create(SessionKey("default", "b"), record())):
        with pytest.raises(ServiceError) as refusal:
            await write
        assert kind(refusal) is ErrorKind.STORE_UNAVAILABLE
        assert refusal.value.retry_after_s
    assert await house.sessions.change(KEY, look) == 1
    assert (await house.sessions.info(KEY)).version == 1
    store.down = False
    assert await house.observe() == 2


async def test_a_session_that_the_store_lost_is_said_to_be_lost() -> None:
    store = MemoryStore(durable=True)
    house = House(store)
    await house.sessions.create(KEY, record())
    await house.observe()
    store._sessions.clear()
    with pytest.raises(ServiceError, match="the store had lost it") as refusal:
        await house.observe()
    assert kind(refusal) is ErrorKind.UNKNOWN_SESSION
    assert house.closed("lost") == 1.0


async def test_a_shared_store_is_asked_before_a_session_is_shown() -> None:
    store, clock = MemoryStore(durable=True), Clock()
    store.shared = True
    here, there = House(store, clock), House(store, clock)
    await here.sessions.create(KEY, record())
    assert await here.observe() == 1
    assert await there.observe() == 2
    assert await here.sessions.change(KEY, look) == 2


async def test_a_replica_that_holds_an_old_session_cannot_write_to_a_new_one() -> None:
    store, clock = MemoryStore(durable=True), Clock()
    here, there = House(store, clock), House(store, clock)
    await here.sessions.create(KEY, record())
    await here.observe()
    await there.sessions.delete(KEY)
    await there.sessions.create(KEY, record())
    await there.observe()
    # Both have counted one frame; what `here` makes has to follow the new session's.
    assert await here.observe() == 2
    assert await there.observe() == 3
    assert here.metrics.registry.get_sample_value("trajectron_session_conflicts_total") == 1.0
