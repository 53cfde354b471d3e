"""One contract for every store: memory, SQLite in a file, and a real Redis."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
import pytest_asyncio
from tests import redis_server

from trajectron_service import stores
from trajectron_service.metrics import Metrics
from trajectron_service.settings import Settings, SettingsError
from trajectron_service.stores import (
    Closure,
    Creation,
    Durability,
    Quota,
    SessionKey,
    SessionStore,
    StoredSession,
    StoreError,
    new_revision,
)
from trajectron_service.stores.guarded import GuardedStore
from trajectron_service.stores.memory import MemoryStore
from trajectron_service.stores.opening import open_store
from trajectron_service.stores.redis import RedisStore
from trajectron_service.stores.sqlite import SqliteStore

KEY = SessionKey("t", "a")
MANY = Quota(1000)
DATA = bytes(range(256)) * 3


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A Redis that writes every change to disk before it answers."""
    with redis_server.running(tmp_path_factory.mktemp("redis")) as url:
        yield url


@pytest_asyncio.fixture(params=["memory", "sqlite", "redis"])
async def store(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[SessionStore]:
    """Each store in turn, empty."""
    opened: SessionStore = MemoryStore()
    if request.param == "sqlite":
        opened = SqliteStore.open(tmp_path / "sessions.sqlite3")
    elif request.param == "redis":
        opened = redis = await RedisStore.open(request.getfixturevalue("redis_url"))
        await redis._client.flushdb()
    yield opened
    await opened.close()


def session(data: bytes = DATA, expires_at: float = 10.0) -> StoredSession:
    return StoredSession(new_revision(), expires_at, data)


def closure(reason: str = "deleted", at: float = 5.0) -> Closure:
    return Closure(reason, at, "a ünicode detail", new_revision())


async def test_what_is_written_is_read(store: SessionStore) -> None:
    first, second = session(), session(b"", 1e9 + 0.1)
    assert await store.read(KEY) is None
    assert await store.create(KEY, first, MANY) is Creation.CREATED
    assert await store.read(KEY) == first
    assert await store.write(KEY, second, first.revision)
    assert await store.read(KEY) == second


async def test_a_key_is_taken_once(store: SessionStore) -> None:
    first = session()
    assert await store.create(KEY, first, MANY) is Creation.CREATED
    assert await store.create(KEY, session(b"other"), MANY) is Creation.TAKEN
    assert await store.create(SessionKey("u", "a"), session(b"u"), MANY) is Creation.CREATED
    assert await store.read(KEY) == first


async def test_only_the_expected_revision_is_replaced(store: SessionStore) -> None:
    first, second = session(), session(b"2")
    await store.create(KEY, first, MANY)
    assert await store.write(KEY, second, first.revision)
    assert not await store.write(KEY, session(b"late"), first.revision)
    assert await store.read(KEY) == second
    # The same key again: the count of its frames would fit, its revision does not.
    await store.delete(KEY, closure())
    await store.create(KEY, session(b"new"), MANY)
    assert not await store.write(KEY, session(b"ghost"), second.revision)
    assert not await store.write(SessionKey("t", "none"), session(), second.revision)


async def test_of_writers_that_race_exactly_one_wins(store: SessionStore) -> None:
    base = session()
    await store.create(KEY, base, MANY)
    rivals = [session(str(k).encode()) for k in range(20)]
    won = await asyncio.gather(*(store.write(KEY, one, base.revision) for one in rivals))
    assert sum(won) == 1
    assert await store.read(KEY) == rivals[won.index(True)]


async def test_what_is_repeated_is_not_done_twice(store: SessionStore) -> None:
    first, second, why = session(), session(b"2"), closure()
    for _ in range(2):
        assert await store.create(KEY, first, MANY) is Creation.CREATED
    for _ in range(2):
        assert await store.write(KEY, second, first.revision)
    for _ in range(2):
        assert await store.delete(KEY, why)
    assert not await store.delete(KEY, closure())
    assert await store.count() == 0


async def test_the_quota_holds_for_all_who_come_at_once(store: SessionStore) -> None:
    keys = [SessionKey("t", str(k)) for k in range(12)]
    made = await asyncio.gather(*(store.create(key, session(), Quota(5)) for key in keys))
    assert (made.count(Creation.CREATED), made.count(Creation.FULL)) == (5, 7)
    assert await store.count() == 5
    other = SessionKey("u", "a")
    assert await store.create(other, session(), Quota(99, tenant=0)) is Creation.TENANT_FULL
    assert await store.create(other, session(), Quota(99, tenant=1)) is Creation.CREATED
    assert (await store.count("u"), await store.count("t"), await store.count("v")) == (1, 5, 0)


async def test_sessions_expire_when_they_say(store: SessionStore) -> None:
    await store.create(KEY, session(expires_at=10.0), MANY)
    assert await store.touch(KEY, 20.25)
    assert await store.expired(20.0, 10) == []
    assert await store.expired(20.25, 10) == [KEY]
    assert not await store.delete(KEY, closure("idle"), expired_by=20.0)
    assert await store.delete(KEY, closure("idle"), expired_by=20.25)
    assert not await store.touch(KEY, 30.0)
    assert await store.expired(99.0, 10) == []
    for k in range(5):
        await store.create(SessionKey("t", str(k)), session(expires_at=k), MANY)
    assert len(await store.expired(99.0, 3)) == 3


async def test_why_a_session_was_closed_is_kept(store: SessionStore) -> None:
    assert await store.closure(KEY) is None
    await store.create(KEY, session(), MANY)
    idle = closure("idle")
    assert await store.delete(KEY, idle)
    assert await store.closure(KEY) == idle
    assert await store.closure(SessionKey("u", "a")) is None


async def test_closures_are_kept_in_bounded_time_and_number(
    store: SessionStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("memory", "sqlite_statements", "redis"):
        __import__(f"trajectron_service.stores.{module}")
        monkeypatch.setattr(getattr(stores, module), "CLOSURES_KEPT", 3)
    keys = [SessionKey("t", str(k)) for k in range(6)]
    for at, key in enumerate(keys):
        await store.create(key, session(), MANY)
        await store.delete(key, closure(at=float(at)))
    assert [await store.closure(key) is not None for key in keys] == [False] * 3 + [True] * 3
    await store.create(KEY, session(), MANY)
    await store.delete(KEY, closure(at=5.0 + stores.CLOSURES_KEPT_S))
    if store.kind != "redis":  # which lets each go by its own clock
        assert await store.closure(keys[-1]) is None
    assert await store.closure(KEY) is not None


async def test_an_unreadable_session_is_set_aside_once(store: SessionStore) -> None:
    bad = session(b"\0damaged\xff")
    await store.create(KEY, bad, MANY)
    why = closure("damaged")
    assert not await store.quarantine(KEY, new_revision(), closure())
    assert await store.quarantine(KEY, bad.revision, why)
    assert await store.quarantine(KEY, bad.revision, why)
    assert not await store.quarantine(KEY, bad.revision, closure())
    assert (await store.count(), await store.quarantined()) == (0, 1)
    assert await store.read(KEY) is None
    assert await store.closure(KEY) == why
    assert await store.create(KEY, session(), MANY) is Creation.CREATED


async def test_pages_rise_and_leave_nobody_out(store: SessionStore) -> None:
    for name in ("b", "B", "a-1", "a.1", "9"):
        await store.create(SessionKey("t", name), session(), MANY)
    await store.create(SessionKey("u", "aa"), session(), MANY)
    assert await store.page("t", "", 3) == ["9", "B", "a-1"]
    assert await store.page("t", "a-1", 3) == ["a.1", "b"]
    assert await store.page("v", "", 3) == []


async def test_a_caller_who_goes_away_disturbs_nobody(store: SessionStore) -> None:
    await store.create(KEY, session(), MANY)
    gone = asyncio.create_task(store.touch(KEY, 11.0))
    await asyncio.sleep(0)
    gone.cancel()
    assert await asyncio.gather(*(store.touch(KEY, 12.0 + k) for k in range(4))) == [True] * 4


async def test_writes_that_wait_together_share_a_commit(tmp_path: Path, redis_url: str) -> None:
    groups: list[int] = []
    sqlite = SqliteStore.open(tmp_path / "s", on_commit=groups.append)
    await asyncio.gather(
        *(sqlite.create(SessionKey("t", str(k)), session(), MANY) for k in range(64))
    )
    await sqlite.close()
    assert sum(groups) == 64
    assert len(groups) < 40
    groups.clear()
    redis = await RedisStore.open(redis_url, on_commit=groups.append)
    await asyncio.gather(
        *(redis.create(SessionKey("w", str(k)), session(), MANY) for k in range(64))
    )
    await redis.close()
    assert sum(groups) == 64
    assert len(groups) < 40


async def test_sqlite_keeps_what_it_acknowledged(tmp_path: Path) -> None:
    path, first = tmp_path / "folder" / "sessions.sqlite3", session()
    store = SqliteStore.open(path)
    await store.create(KEY, first, MANY)
    # As another process sees it: nothing has been closed or flushed.
    with sqlite3.connect(path) as other:
        assert other.execute("SELECT data FROM sessions").fetchone() == (DATA,)
        assert other.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    assert store._connection.execute("PRAGMA synchronous").fetchone() == (2,)  # FULL
    with pytest.raises(StoreError, match="another process"):
        SqliteStore.open(path)
    await store.close()
    again = SqliteStore.open(path)
    assert await again.read(KEY) == first
    await again.close()


async def test_a_write_that_fails_takes_nobody_along(tmp_path: Path) -> None:
    store = SqliteStore.open(tmp_path / "s")
    store._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 10_000)
    results = await asyncio.gather(
        *(
            store.create(SessionKey("t", str(k)), session(bytes(20_000 if k == 3 else 10)), MANY)
            for k in range(6)
        ),
        return_exceptions=True,
    )
    assert [isinstance(one, StoreError) for one in results] == [k == 3 for k in range(6)]
    assert await store.count() == 5
    await store.close()
    with pytest.raises(StoreError, match="closed"):
        await store.count()


@pytest.mark.parametrize("content", [b"no database at all" * 100, None])
async def test_a_file_of_something_else_is_left_alone(
    tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "other.db"
    if content is None:
        with sqlite3.connect(path) as other:
            other.execute("CREATE TABLE mine (x)")
    else:
        path.write_bytes(content)
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"other\.db"):
        SqliteStore.open(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "given"),
    [
        (("--appendonly", "yes", "--appendfsync", "everysec"), Durability.OS),
        (("--appendonly", "no"), Durability.NONE),
        (
            (*redis_server.DURABLE, "--maxmemory", "100mb", "--maxmemory-policy", "allkeys-lru"),
            Durability.NONE,
        ),
    ],
)
async def test_a_redis_that_keeps_less_is_refused_unless_that_is_named(
    options: tuple[str, ...], given: Durability, tmp_path: Path
) -> None:
    with redis_server.running(tmp_path, *options) as url:
        with pytest.raises(StoreError, match="store_durability"):
            await RedisStore.open(url)
        metrics = Metrics()
        store = await open_store(Settings(store=url, store_durability=given.value), metrics)
        assert store.durability is given
        assert b'store_info{durability="' + given.value.encode() in metrics.render()
        await store.close()


async def test_redis_comes_back_by_itself_and_its_promise_is_asked_again(tmp_path: Path) -> None:
    port, first = redis_server.free_port(), session()
    process = redis_server.start(tmp_path, port)
    store = await RedisStore.open(f"redis://127.0.0.1:{port}/0", timeout_s=2.0)
    try:
        await store.create(KEY, first, MANY)
        process.kill()
        process.wait()
        for _ in range(2):
            with pytest.raises(StoreError):
                await store.write(KEY, session(b"2"), first.revision)
            with pytest.raises(StoreError):
                await store.read(KEY)
        process = redis_server.start(tmp_path, port)
        assert await store.read(KEY) == first
        assert await store.write(KEY, session(b"2"), first.revision)
        process.kill()
        process.wait()
        process = redis_server.start(tmp_path, port, "--appendonly", "no")
        with pytest.raises(StoreError, match="appendonly"):
            await store.read(KEY)
    finally:
        process.kill()
        process.wait()
        await store.close()


async def test_the_settings_name_the_store(tmp_path: Path, redis_url: str) -> None:
    async def kind(**settings: object) -> str:
        opened = await open_store(Settings(**settings), Metrics())  # type: ignore[arg-type]
        await opened.close()
        return opened.kind

    assert await kind() == "memory"
    assert await kind(state_dir=tmp_path) == "sqlite"
    assert (tmp_path / "sessions.sqlite3").exists()
    assert await kind(state_dir=tmp_path, store="memory") == "memory"
    assert await kind(store=f"sqlite:{tmp_path / 'other'}") == "sqlite"
    assert await kind(store=redis_url) == "redis"
    with pytest.raises(SettingsError, match="path"):
        await kind(store="sqlite")
    with pytest.raises(SettingsError, match="store"):
        await kind(store=f"redis://127.0.0.1:{redis_server.free_port()}/0")


async def test_a_store_that_does_not_answer_is_given_up_and_counted() -> None:
    class Stuck(MemoryStore):
        async def read(self, key: SessionKey) -> StoredSession | None:
            await asyncio.Event().wait()
            return await super().read(key)

    metrics = Metrics()
    store = GuardedStore(Stuck(), metrics, timeout_s=0.01)
    with pytest.raises(StoreError, match="read"):
        await store.read(KEY)
    assert metrics.registry.get_sample_value("trajectron_store_up") == 0.0
    errors = metrics.registry.get_sample_value(
        "trajectron_store_errors_total", {"operation": "read"}
    )
    assert errors == 1.0
    assert await store.count() == 0
    assert metrics.registry.get_sample_value("trajectron_store_up") == 1.0
