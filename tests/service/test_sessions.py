"""The life of sessions: order, races, expiry, caps, parking, replicas. No model is needed here."""

from __future__ import annotations

import asyncio
import dataclasses
import random
from collections.abc import Awaitable, Callable

import pytest
from tests.service.building import DT_S, Clock, observation, turns

from trajectron_service import records
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.messages import SessionConfig
from trajectron_service.metrics import Metrics
from trajectron_service.quotas import unlimited
from trajectron_service.records import SceneRecord
from trajectron_service.scenes import State
from trajectron_service.sessions import Change, Sessions
from trajectron_service.stores import Closure, Creation, Quota, SessionKey, StoredSession
from trajectron_service.stores.memory import MemoryStore
from trajectron_service.timebase import Grid, Timeline, advance

IDLE_S = 60.0
PARK_S = 10.0
KEY = SessionKey("default", "a")


def record(idle_timeout_s: float = IDLE_S) -> SceneRecord:
    config = SessionConfig("m", DT_S, 2.0, idle_timeout_s)
    return SceneRecord(config, "hash", 0.0, Timeline(Grid.of(DT_S, None, 2.0)))


def following(before: SceneRecord) -> SceneRecord:
    """The record after one more frame; its state is a word that tells the version."""
    version = before.version + 1
    timeline = advance(before.timeline, observation(version * DT_S, ann=(0.0, 0.0))).timeline
    states = tuple(State(f"state {s.serial}") for s in timeline.committed)
    return dataclasses.replace(before, version=version, timeline=timeline, states=states)


async def pack(one: SceneRecord) -> bytes:
    if isinstance(one.states, bytes):
        return one.states
    return "|".join(map(str, one.states)).encode()


class DistantStore(MemoryStore):
    """A store like one over a network: others get their turn before and after each call."""

    async def create(self, key: SessionKey, session: StoredSession, quota: Quota) -> Creation:
        await turns(2)
        done = await super().create(key, session, quota)
        await turns(3)
        return done

    async def read(self, key: SessionKey) -> StoredSession | None:
        await turns(1)
        found = await super().read(key)
        await turns(3)
        return found

    async def write(self, key: SessionKey, session: StoredSession, expected: str) -> bool:
        await turns(2)
        done = await super().write(key, session, expected)
        await turns(2)
        return done

    async def touch(self, key: SessionKey, expires_at: float) -> bool:
        await turns(2)
        done = await super().touch(key, expires_at)
        await turns(2)
        return done

    async def delete(
        self, key: SessionKey, closure: Closure, *, expired_by: float | None = None
    ) -> bool:
        await turns(1)
        done = await super().delete(key, closure, expired_by=expired_by)
        await turns(4)
        return done


class House:
    """Sessions with everything that they are made of."""

    def __init__(
        self, store: MemoryStore | None = None, clock: Clock | None = None, max_sessions: int = 100
    ) -> None:
        self.clock = clock or Clock()
        self.store = store or MemoryStore()
        self.metrics = Metrics()
        self.sessions = Sessions(
            self.store,
            pack,
            clock=self.clock,
            metrics=self.metrics,
            max_sessions=max_sessions,
            park_after_s=PARK_S,
            usage=unlimited(self.metrics),
        )

    async def observe(self, key: SessionKey = KEY, wait: asyncio.Event | None = None) -> int:
        """One accepted frame; the version after it."""

        async def work(before: SceneRecord) -> tuple[Change, int]:
            if wait is not None:
                await wait.wait()
            after = following(before)
            return Change(after), after.version

        return await self.sessions.change(key, work)

    def closed(self, reason: str) -> float:
        return (
            self.metrics.registry.get_sample_value(
                "trajectron_sessions_closed_total", {"reason": reason}
            )
            or 0.0
        )

    def open(self) -> float | None:
        return self.metrics.registry.get_sample_value("trajectron_sessions")


def kind(caught: pytest.ExceptionInfo[ServiceError]) -> ErrorKind:
    return caught.value.kind


async def test_a_session_counts_its_frames() -> None:
    house = House()
    info = await house.sessions.create(KEY, record())
    assert (info.version, info.last_frame_time) == (0, None)
    assert [await house.observe() for _ in range(3)] == [1, 2, 3]
    info = await house.sessions.info(KEY)
    assert (info.version, info.agent_count) == (3, 1)
    assert info.last_frame_time == pytest.approx(3 * DT_S)


async def test_an_id_is_taken_until_it_is_closed() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    with pytest.raises(ServiceError) as refusal:
        await house.sessions.create(KEY, record())
    assert kind(refusal) is ErrorKind.SESSION_EXISTS
    await house.sessions.delete(KEY)
    assert (await house.sessions.create(KEY, record())).version == 0


async def test_tenants_do_not_see_each_other() -> None:
    house = House()
    other = SessionKey("other", KEY.id)
    await house.sessions.create(KEY, record())
    await house.observe()
    await house.sessions.create(other, record())
    assert (await house.sessions.info(other)).version == 0
    infos, _ = await house.sessions.page("other", "", 10)
    assert len(infos) == 1


@pytest.mark.parametrize("use", ["change", "info", "delete"])
async def test_what_is_not_open_is_unknown(use: str) -> None:
    house = House()
    calls: dict[str, Callable[[], Awaitable[object]]] = {
        "change": house.observe,
        "info": lambda: house.sessions.info(KEY),
        "delete": lambda: house.sessions.delete(KEY),
    }
    with pytest.raises(ServiceError) as refusal:
        await calls[use]()
    assert kind(refusal) is ErrorKind.UNKNOWN_SESSION
    assert not house.sessions._live


async def test_requests_of_a_session_run_in_the_order_they_came() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    order: list[int] = []

    async def one(number: int) -> None:
        async def work(before: SceneRecord) -> tuple[Change, None]:
            await turns(3 - number)  # the first takes longest
            order.append(number)
            return Change(following(before)), None

        await house.sessions.change(KEY, work)

    await asyncio.gather(*map(one, range(3)))
    assert order == [0, 1, 2]
    assert (await house.sessions.info(KEY)).version == 3


async def test_work_that_fails_or_is_cancelled_changes_nothing() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    await house.observe()

    async def fail(before: SceneRecord) -> tuple[Change, None]:
        following(before)
        raise ValueError("the engine failed")

    with pytest.raises(ValueError, match="engine"):
        await house.sessions.change(KEY, fail)
    slow = asyncio.create_task(house.observe(wait=asyncio.Event()))
    await turns()
    slow.cancel()
    with pytest.raises(asyncio.CancelledError):
        await slow
    assert (await house.sessions.info(KEY)).version == 1
    assert await house.observe() == 2


async def test_deleting_while_a_frame_is_in_flight_shares_nothing_with_the_next_session() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    go = asyncio.Event()
    flight = asyncio.create_task(house.observe(wait=go))
    await turns()
    await house.sessions.delete(KEY)
    await house.sessions.create(KEY, record())
    assert await house.observe() == 1
    go.set()
    with pytest.raises(ServiceError) as refusal:
        await flight
    assert kind(refusal) is ErrorKind.UNKNOWN_SESSION
    assert (await house.sessions.info(KEY)).version == 1
    assert house.open() == 1.0


async def test_requests_in_line_behind_a_deletion_are_told() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    go = asyncio.Event()
    line = [asyncio.create_task(house.observe(wait=go)) for _ in range(3)]
    await turns()
    await house.sessions.delete(KEY)
    go.set()
    results = await asyncio.gather(*line, return_exceptions=True)
    assert [r.kind for r in results if isinstance(r, ServiceError)] == [
        ErrorKind.UNKNOWN_SESSION
    ] * 3
    assert not house.sessions._live


async def test_of_two_deletions_one_is_told_that_there_was_nothing() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    both = await asyncio.gather(
        house.sessions.delete(KEY), house.sessions.delete(KEY), return_exceptions=True
    )
    assert sum(isinstance(one, ServiceError) for one in both) == 1
    assert (house.closed("deleted"), house.open()) == (1.0, 0.0)


async def test_expiry_and_deletion_at_once_free_a_session_once() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    await house.sessions.create(SessionKey("default", "b"), record(10 * IDLE_S))
    house.clock.now += IDLE_S
    results = await asyncio.gather(
        house.sessions.reap(),
        house.sessions.delete(KEY),
        house.sessions.reap(),
        return_exceptions=True,
    )
    assert house.closed("idle") + house.closed("deleted") == 1.0
    assert house.open() == 1.0
    assert any(isinstance(one, ServiceError) for one in results)


async def test_a_session_expires_exactly_then_whether_or_not_it_was_reaped() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    house.clock.now += IDLE_S - 0.001
    assert await house.observe() == 1  # which keeps it open
    house.clock.now += IDLE_S
    with pytest.raises(ServiceError) as refusal:
        await house.observe()
    assert kind(refusal) is ErrorKind.UNKNOWN_SESSION
    assert (house.closed("idle"), house.open()) == (1.0, 0.0)
    assert (await house.sessions.create(KEY, record())).version == 0


async def test_an_expired_session_cannot_be_deleted_and_its_id_is_free() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    house.clock.now += IDLE_S
    with pytest.raises(ServiceError):
        await house.sessions.delete(KEY)
    await house.sessions.create(KEY, record())
    house.clock.now += IDLE_S
    await house.sessions.create(KEY, record())
    assert house.closed("idle") == 2.0


async def test_a_session_in_use_does_not_expire() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    go = asyncio.Event()
    flight = asyncio.create_task(house.observe(wait=go))
    await turns()
    house.clock.now += 10 * IDLE_S
    assert await house.sessions.reap() == 0
    go.set()
    assert await flight == 1
    assert await house.sessions.reap() == 0
    house.clock.now += IDLE_S
    assert await house.sessions.reap() == 1


async def test_the_cap_refuses_and_says_to_come_back_until_one_is_closed_or_expires() -> None:
    house = House(max_sessions=2)
    keys = [SessionKey("default", name) for name in "abc"]
    await house.sessions.create(keys[0], record())
    await house.sessions.create(keys[1], record(10 * IDLE_S))
    with pytest.raises(ServiceError) as refusal:
        await house.sessions.create(keys[2], record())
    assert kind(refusal) is ErrorKind.TOO_MANY_SESSIONS
    assert refusal.value.codes.retryable
    assert refusal.value.retry_after_s
    house.clock.now += IDLE_S
    await house.sessions.create(keys[2], record())
    await house.sessions.delete(keys[2])
    await house.sessions.create(keys[0], record())


async def test_creating_at_once_does_not_pass_the_cap() -> None:
    house = House(max_sessions=3)
    keys = [SessionKey("default", str(k)) for k in range(10)]
    made = await asyncio.gather(
        *(house.sessions.create(key, record()) for key in keys), return_exceptions=True
    )
    assert sum(isinstance(one, ServiceError) for one in made) == 7
    assert await house.store.count() == 3


async def test_an_unused_session_becomes_bytes_and_wakes_as_it_was() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    await house.observe()
    before = await house.sessions.info(KEY)
    house.clock.now += PARK_S - 1.0
    assert await house.sessions.park() == 0
    house.clock.now += 1.0
    assert await house.sessions.park() == 1
    assert not house.sessions._live
    assert house.metrics.registry.get_sample_value("trajectron_agents") == 0.0
    assert await house.sessions.info(KEY) == before
    seen: list[SceneRecord] = []

    async def look(one: SceneRecord) -> tuple[Change, None]:
        seen.append(one)
        return Change(one), None

    await house.sessions.change(KEY, look)
    assert seen[0].states == b"state 0"
    assert await house.observe() == 2


async def test_parking_lets_go_when_the_session_is_used_meanwhile() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    await house.observe()
    house.clock.now += PARK_S
    parked, version = await asyncio.gather(house.sessions.park(), house.observe())
    assert version == 2
    assert (await house.sessions.info(KEY)).version == 2
    assert parked <= 1
    assert await house.observe() == 3


async def test_waking_a_parked_session_twice_at_once_gives_one_session() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    house.clock.now += PARK_S
    assert await house.sessions.park() == 1
    versions = await asyncio.gather(*(house.observe() for _ in range(4)))
    assert sorted(versions) == [1, 2, 3, 4]


async def test_pages_are_in_order_of_id_and_leave_nobody_out() -> None:
    house = House()
    for name in ("d", "b", "a", "c"):
        await house.sessions.create(SessionKey("default", name), record())
    first, more = await house.sessions.page("default", "", 3)
    assert ([info.id for info in first], more) == (["a", "b", "c"], True)
    rest, more = await house.sessions.page("default", "c", 3)
    assert ([info.id for info in rest], more) == (["d"], False)


async def test_two_replicas_never_both_extend_a_session() -> None:
    store, clock = MemoryStore(durable=True), Clock()
    here, there = House(store, clock), House(store, clock)
    await here.sessions.create(KEY, record())
    assert await here.observe() == 1
    assert await there.observe() == 2
    # `here` still holds version 1: it loses, reads version 2, and goes on from that.
    assert await here.observe() == 3
    stored = await store.read(KEY)
    assert stored is not None
    assert records.decode(stored.data).version == 3


async def test_with_a_durable_store_an_acknowledged_frame_outlives_the_process() -> None:
    store, clock = MemoryStore(durable=True), Clock()
    house = House(store, clock)
    await house.sessions.create(KEY, record())
    await house.observe()
    await house.observe()
    again = House(store, clock)
    assert (await again.sessions.info(KEY)).version == 2
    assert await again.observe() == 3


async def test_without_a_durable_store_no_bytes_are_made_frame_by_frame() -> None:
    house = House()
    await house.sessions.create(KEY, record())
    created = await house.store.read(KEY)
    assert created is not None
    for _ in range(3):
        await house.observe()
    stored = await house.store.read(KEY)
    assert stored is not None
    assert stored.data is created.data


class Mix:
    """Clients that open, feed, close and let expire sessions of few names, all at once."""

    def __init__(self, seed: int, durable: bool) -> None:
        self.random = random.Random(seed)
        self.house = House(DistantStore(durable=durable), max_sessions=3)
        self.opened = 0
        self.ended: list[ErrorKind] = []

    async def client(self) -> None:
        for _ in range(12):
            key = SessionKey("default", self.random.choice("ab"))
            use = self.random.choice([self._open, self._feed, self._feed, self._close, self._time])
            try:
                await use(key)
            except ServiceError as error:
                self.ended.append(error.kind)
            await turns(self.random.randrange(4))

    async def _open(self, key: SessionKey) -> None:
        info = await self.house.sessions.create(key, record())
        assert info.version == 0
        self.opened += 1

    async def _feed(self, key: SessionKey) -> None:
        async def work(before: SceneRecord) -> tuple[Change, None]:
            await turns(self.random.randrange(4))
            after = following(before)
            # Whatever state is given is the one that this version made: nobody else's.
            assert len(before.timeline.seen) == min(before.version, 1)
            return Change(after), None

        await self.house.sessions.change(key, work)

    async def _close(self, key: SessionKey) -> None:
        await self.house.sessions.delete(key)

    async def _time(self, _: SessionKey) -> None:
        self.house.clock.now += self.random.choice([PARK_S, IDLE_S])
        await self.house.sessions.park()
        await self.house.sessions.reap()


@pytest.mark.parametrize("durable", [False, True])
@pytest.mark.parametrize("seed", range(12))
async def test_whatever_races_sessions_are_freed_once_and_nothing_is_left(
    seed: int, durable: bool
) -> None:
    mix = Mix(seed, durable)
    await asyncio.gather(*(mix.client() for _ in range(6)))
    house = mix.house
    left = await house.store.count()
    assert mix.opened == left + house.closed("idle") + house.closed("deleted")
    assert house.open() == left
    house.clock.now += 1.05 * IDLE_S  # a durable store may be late by a twentieth
    assert await house.sessions.reap() == left
    assert not house.sessions._live
    assert house.metrics.registry.get_sample_value("trajectron_agents") == 0.0
    allowed = {ErrorKind.UNKNOWN_SESSION, ErrorKind.SESSION_EXISTS, ErrorKind.OVERLOADED}
    assert set(mix.ended) <= allowed
