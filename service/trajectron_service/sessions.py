"""The life of sessions: opened, used one request at a time, closed by their owner or by time.

**Where a session is.** The store says which sessions exist and when they expire. A session in
use is also *live*: its record stands in this process with the model's states as tensors. Bytes
are made in two cases only: with every accepted frame when the store is durable, before the
frame is acknowledged; and when a session has been unused for a while and is *parked*. A
parked session becomes live again on its next use.

**Order.** Requests of one session run one after the other, in the order they came. A record
is replaced only after all its work succeeded, by compare-and-set on the stored revision; the loser
of a race between replicas reads the winner's record and does its work again on that.

**Races.** Removal from the store is atomic and has one winner, who alone counts it. A live
session that has been removed is *closed*: work in flight on it comes to nothing, and a new
session under its name is another object that shares nothing with it.

**Expiry.** A durable store is told of a session's use with its frames, and otherwise only now and
then: what it has may be late by a twentieth of the idle timeout (``_slack_s``), never early. A
stream holds its session open, however long it is silent.

**Faults of the store.** What changes a session fails, and nothing has changed in memory; what
only looks at a session in memory goes on.
"""

from __future__ import annotations

import asyncio
import weakref
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.kept_records import KeptRecords
from trajectron_service.messages import SessionInfo
from trajectron_service.metrics import Metrics
from trajectron_service.quotas import Limit, Usage
from trajectron_service.records import SceneRecord
from trajectron_service.session_errors import DELETED, store_faults
from trajectron_service.stores import (
    Closure,
    Creation,
    Quota,
    SessionKey,
    SessionStore,
    StoredSession,
    StoreError,
)
from trajectron_service.validation import quoted

ResultT = TypeVar("ResultT")

_WRITE_ATTEMPTS = 5
_REAP_AT_ONCE = 1000
_RETRY_AFTER_FULL_S = 5.0
# A session that a stream holds is kept open for at least so long at a time.
_HELD_S = 5.0


class Change(NamedTuple):
    """A record to put in place of the one given, and its packed states where they were made."""

    record: SceneRecord
    packed: bytes | None = None


@dataclass(eq=False)
class _Live:
    """A session in use. ``record`` is None until it is read from the store.

    ``revision`` is the store's, as far as known here; ``stored_expiry`` is when it closes there;
    ``idle_timeout_s`` is known once a record was.
    """

    key: SessionKey
    expires_at: float
    record: SceneRecord | None = None
    revision: str = ""
    stored_expiry: float = 0.0
    idle_timeout_s: float = 0.0
    users: int = 0
    holds: int = 0
    closed: bool = False
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)


class Sessions:
    """All sessions of this process. Use from one event loop.

    Args:
        store: says which sessions exist.
        pack: makes bytes of a record's states.
        clock: Unix seconds that never go back.
        metrics: told about sessions, agents and edges.
        max_sessions: more are refused.
        park_after_s: unused for longer, a session is kept as bytes only.
        usage: how many a tenant may have.
        on_close: told which session has been closed for good.
    """

    def __init__(
        self,
        store: SessionStore,
        pack: Callable[[SceneRecord], Awaitable[bytes]],
        *,
        clock: Callable[[], float],
        metrics: Metrics,
        max_sessions: int,
        park_after_s: float,
        usage: Usage,
        on_close: Callable[[SessionKey], None] = lambda _: None,
    ) -> None:
        self._store = store
        self._pack = pack
        self._clock = clock
        self._metrics = metrics
        self._kept = KeptRecords(store, clock, metrics)
        self._max_sessions = max_sessions
        self._usage = usage
        self._park_after_s = park_after_s
        self._on_close = on_close
        self._live: dict[SessionKey, _Live] = {}
        self._locks: weakref.WeakValueDictionary[SessionKey, asyncio.Lock] = (
            weakref.WeakValueDictionary()
        )

    @property
    def durable(self) -> bool:
        """Whether packed states must come with every change."""
        return self._store.durable

    async def create(self, key: SessionKey, record: SceneRecord) -> SessionInfo:
        """Opens a session.

        Raises:
            ServiceError: SESSION_EXISTS, TOO_MANY_SESSIONS.
        """
        now = self._clock()
        expires_at = now + record.idle_timeout_s
        stored = self._kept.stored(record, b"", expires_at)
        with store_faults():
            made = await self._create(_Live(key, expires_at, record), stored)
            if made in (Creation.FULL, Creation.TENANT_FULL):
                await self.reap()
                made = await self._create(_Live(key, expires_at, record), stored)
            if made is Creation.TAKEN:
                raise ServiceError(
                    ErrorKind.SESSION_EXISTS, f"session_id: {quoted(key.id)} is open already"
                )
            if made is Creation.TENANT_FULL:
                raise self._usage.too_many(Limit.SESSIONS)
            if made is not Creation.CREATED:
                raise ServiceError(
                    ErrorKind.TOO_MANY_SESSIONS,
                    f"{self._max_sessions} sessions are open, as many as this server takes; "
                    "close one or try again later",
                    retry_after_s=_RETRY_AFTER_FULL_S,
                )
            await self._kept.count()
        return record.info(key.id, expires_at)

    async def change(
        self,
        key: SessionKey,
        work: Callable[[SceneRecord], Awaitable[tuple[Change, ResultT]]],
        *,
        extends: bool = False,
    ) -> ResultT:
        """Runs ``work`` on the session's record, alone, and puts the record it gives in place.

        ``work`` may run again on a newer record when another replica was faster. When it
        raises, nothing has changed. Using a session keeps it open.

        Args:
            key: the session.
            work: see above.
            extends: the work adds frames: what it starts from is checked when it is stored, so
                it need not be checked before.

        Raises:
            ServiceError: UNKNOWN_SESSION, also when it is closed meanwhile; SESSION_DAMAGED,
                STORE_UNAVAILABLE.
            Exception: whatever ``work`` raises.
        """
        live = self._enter(key)
        try:
            async with live.lock:
                for _ in range(_WRITE_ATTEMPTS):
                    with store_faults():
                        record = await self._read(live, fresh=not extends)
                    change, result = await work(record)
                    with store_faults():
                        if await self._put(live, record, change):
                            return result
                    self._metrics.conflicts.inc()
            raise ServiceError(
                ErrorKind.OVERLOADED,
                "other replicas keep changing this session; send its frames to one of them",
                retry_after_s=1.0,
            )
        finally:
            self._leave(live)

    async def info(self, key: SessionKey) -> SessionInfo:
        """The session as it stands, without waiting for work on it; does not keep it open.

        Raises:
            ServiceError: UNKNOWN_SESSION.
        """
        live = self._live.get(key)
        known = live is not None and live.record is not None and not live.closed
        try:
            stored = await self._store.read(key)
        except StoreError:
            if not known:
                with store_faults():
                    raise
        else:
            in_use = live is not None and (live.users or live.holds)
            now = self._clock()
            if stored is not None and stored.expires_at <= now and not in_use:
                await self._evict(key, self._kept.idle(), expired_by=now)
                stored = None
            if stored is None:
                raise await self._kept.gone(key)
            if not known or (live and live.revision != stored.revision and not live.users):
                record = await self._kept.decoded(key, stored)
                return record.info(key.id, stored.expires_at)
        assert live is not None  # known
        assert live.record is not None
        return live.record.info(key.id, live.expires_at)

    async def page(
        self, tenant: str, after: str, limit: int
    ) -> tuple[tuple[SessionInfo, ...], bool]:
        """Up to ``limit`` sessions with ids greater than ``after``, rising; whether more follow."""
        with store_faults():
            ids = await self._store.page(tenant, after, limit + 1)
        infos = []
        for session_id in ids[:limit]:
            try:
                infos.append(await self.info(SessionKey(tenant, session_id)))
            except ServiceError as error:
                # Gone since the page was read, or found to be unreadable by that.
                if error.kind not in (ErrorKind.UNKNOWN_SESSION, ErrorKind.SESSION_DAMAGED):
                    raise
        return tuple(infos), len(ids) > limit

    async def delete(self, key: SessionKey, reason: str = DELETED) -> None:
        """Closes a session; work in flight on it comes to nothing.

        Raises:
            ServiceError: UNKNOWN_SESSION, also for the later of two deletions.
        """
        live = self._live.get(key)
        busy = live is not None and (live.users > 0 or live.holds > 0)
        with store_faults():
            if not busy and await self._evict(key, self._kept.idle(), expired_by=self._clock()):
                raise await self._kept.gone(key)
            if not await self._evict(key, self._kept.closure(reason)):
                raise await self._kept.gone(key)

    @contextmanager
    def held(self, key: SessionKey) -> Iterator[None]:
        """Holds the session open, used or not, for the length of the block."""
        live = self._live.get(key)
        if live is None:
            live = self._live[key] = _Live(key, expires_at=0.0)
        live.holds += 1
        try:
            yield
        finally:
            live.holds -= 1
            self._let_go(live)

    async def renew(self) -> None:
        """Keeps the sessions open that are held."""
        now = self._clock()
        for live in [live for live in self._live.values() if live.holds]:
            idle_s = live.idle_timeout_s
            # A busy one is kept open by what it does.
            if live.users or live.stored_expiry > now + max(idle_s / 2, _HELD_S):
                continue
            if not idle_s:
                with suppress(ServiceError):  # gone: whoever holds it is told when it is used
                    await self.change(live.key, _looked_at)
                continue
            live.expires_at = now + idle_s
            if not await self._touch(live, live.expires_at, self._kept.slack_s(idle_s)):
                self._close(live)

    async def reap(self) -> int:
        """Closes the sessions that have expired; how many. One in use is left alone."""
        now = self._clock()
        closed = 0
        for key in await self._store.expired(now, _REAP_AT_ONCE):
            live = self._live.get(key)
            if live is None or not (live.users or live.holds):
                idle_s = live.record.idle_timeout_s if live and live.record else None
                closed += await self._evict(key, self._kept.idle(idle_s), expired_by=now)
        return closed

    async def park(self) -> int:
        """Turns sessions unused for a while into bytes in the store; how many."""
        limit = self._clock() - self._park_after_s
        idle = [
            live
            for live in self._live.values()
            if not live.users
            and live.record is not None
            and live.expires_at - live.record.idle_timeout_s <= limit
        ]
        parked = 0
        for live in idle:
            parked += await self._park(live)
        return parked

    async def _create(self, live: _Live, stored: StoredSession) -> Creation:
        """Adds a session to the store, and makes it the live one where that went well."""
        quota = Quota(self._max_sessions, self._usage.limit(Limit.SESSIONS))
        async with self._lock(live.key):
            made = await self._store.create(live.key, stored, quota)
            if made is Creation.TAKEN:
                idle = self._kept.idle()
                if await self._remove(live.key, idle, expired_by=idle.at):
                    made = await self._store.create(live.key, stored, quota)
            if made is Creation.CREATED:
                live.revision, live.stored_expiry = stored.revision, stored.expires_at
                old = self._live.get(live.key)
                if old is not None:
                    self._close(old)
                self._live[live.key] = live
        return made

    def _lock(self, key: SessionKey) -> asyncio.Lock:
        """Held while a session of this key comes to be or ceases, here and in the store."""
        return self._locks.setdefault(key, asyncio.Lock())

    def _enter(self, key: SessionKey) -> _Live:
        live = self._live.get(key)
        if live is None:
            live = self._live[key] = _Live(key, expires_at=0.0)
        live.users += 1
        return live

    def _leave(self, live: _Live) -> None:
        live.users -= 1
        self._let_go(live)

    def _let_go(self, live: _Live) -> None:
        unused = live.record is None and not live.users and not live.holds
        if unused and self._live.get(live.key) is live:
            del self._live[live.key]

    async def _read(self, live: _Live, *, fresh: bool) -> SceneRecord:
        """The session's record; from the store where it is not live, may have expired or changed.

        With ``fresh`` a store that other replicas use is asked whether the record is the newest.
        """
        if live.closed:
            raise await self._kept.gone(live.key)
        now = self._clock()
        # Whoever came before expiry holds the session open for those in line behind.
        expired = live.users == 1 and not live.holds and live.expires_at <= now
        if live.record is not None and not expired and not (fresh and self._store.shared):
            return live.record
        try:
            stored = await self._store.read(live.key)
        except StoreError:
            if live.record is None or expired:
                raise
            return live.record  # as far as is known here
        if stored is None or live.closed:
            self._close(live)
            raise await self._kept.gone(live.key, lost=bool(live.revision) and stored is None)
        if expired and stored.expires_at <= now:
            idle_s = None if live.record is None else live.record.idle_timeout_s
            await self._evict(live.key, self._kept.idle(idle_s), expired_by=now)
            self._close(live)
            raise await self._kept.gone(live.key)
        if live.record is None or stored.revision != live.revision:
            self._show(live, await self._kept.decoded(live.key, stored))
        live.revision, live.stored_expiry = stored.revision, stored.expires_at
        assert live.record is not None  # shown above
        return live.record

    async def _put(self, live: _Live, before: SceneRecord, change: Change) -> bool:
        """Puts a record in place; False when another replica has put one."""
        after = change.record
        if live.closed:
            raise await self._kept.gone(live.key)
        expires_at = self._clock() + after.idle_timeout_s
        changed = (after.version, after.last_sequence) != (before.version, before.last_sequence)
        if self._store.durable and changed:
            packed = await self._pack(after) if change.packed is None else change.packed
            if not await self._write(live, after, packed, expires_at):
                self._show(live, None)
                return False
        elif not await self._touch(live, expires_at, self._kept.slack_s(after.idle_timeout_s)):
            self._close(live)
        if live.closed:
            raise await self._kept.gone(live.key)
        live.expires_at = expires_at
        self._show(live, after)
        return True

    async def _touch(self, live: _Live, expires_at: float, slack_s: float) -> bool:
        """Tells the store that the session is used, unless it knows well enough."""
        if live.stored_expiry >= expires_at:
            return True
        try:
            open_still = await self._store.touch(live.key, expires_at + slack_s)
        except StoreError:
            return True  # nothing is lost by that; the next use tells it
        live.stored_expiry = expires_at + slack_s
        return open_still

    async def _write(
        self, live: _Live, record: SceneRecord, packed: bytes, expires_at: float
    ) -> bool:
        with self._metrics.stage("store"):
            stored = self._kept.stored(record, packed, expires_at)
            if not await self._store.write(live.key, stored, live.revision):
                return False
        live.revision, live.stored_expiry = stored.revision, stored.expires_at
        return True

    async def _park(self, live: _Live) -> bool:
        if live.users or live.closed:
            return False
        live.users += 1
        try:
            async with live.lock:
                record = live.record
                if record is None or live.closed:
                    return False
                if not self._store.durable:
                    packed = await self._pack(record)
                    if not await self._write(live, record, packed, live.expires_at):
                        return False
                self._show(live, None)
        finally:
            self._leave(live)
        self._metrics.parked.inc()
        return True

    async def _evict(
        self, key: SessionKey, closure: Closure, expired_by: float | None = None
    ) -> bool:
        """Removes a session for good; whether this call was the one that did."""
        async with self._lock(key):
            return await self._remove(key, closure, expired_by)

    async def _remove(self, key: SessionKey, closure: Closure, expired_by: float | None) -> bool:
        """``_evict``, under the key's lock."""
        before = self._live.get(key)
        if not await self._store.delete(key, closure, expired_by=expired_by):
            return False
        # Whoever came meanwhile may have read it before it went.
        for live in (before, self._live.get(key)):
            if live is not None:
                self._close(live)
        self._metrics.evictions.labels(closure.reason).inc()
        self._on_close(key)
        await self._kept.count()
        return True

    def _close(self, live: _Live) -> None:
        live.closed = True
        self._show(live, None)
        if self._live.get(live.key) is live:
            del self._live[live.key]

    def _show(self, live: _Live, record: SceneRecord | None) -> None:
        """Sets the record, and moves the gauges by the difference."""
        before = live.record
        agents = (record.agent_count if record else 0) - (before.agent_count if before else 0)
        edges = (record.edge_count if record else 0) - (before.edge_count if before else 0)
        self._metrics.agents.inc(agents)
        self._metrics.edges.inc(edges)
        live.record = record
        if record is not None:
            live.idle_timeout_s = record.idle_timeout_s


async def _looked_at(record: SceneRecord) -> tuple[Change, None]:
    return Change(record), None
