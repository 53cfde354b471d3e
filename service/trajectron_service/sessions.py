"""The life of sessions: opened, used one request at a time, closed by their owner or by time.

**Where a session is.** The store says which sessions exist and when they expire. A session in
use is also *live*: its record stands in this process with the model's states as tensors. Bytes
are made in two cases only: with every accepted frame when the store is durable, before the
frame is acknowledged; and when a session has been unused for a while and is *parked*. A
parked session becomes live again on its next use.

**Order.** Requests of one session run one after the other, in the order they came. A record
is replaced only after all its work succeeded, by compare-and-set on the version; the loser of
a race between replicas reads the winner's record and does its work again on that.

**Races.** Removal from the store is atomic and has one winner, who alone counts it. A live
session that has been removed is *closed*: work in flight on it comes to nothing, and a new
session under its name is another object that shares nothing with it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

from trajectron_service import records
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.messages import SessionInfo
from trajectron_service.metrics import Metrics
from trajectron_service.records import SceneRecord
from trajectron_service.stores import SessionKey, SessionStore, StoredSession
from trajectron_service.validation import quoted

ResultT = TypeVar("ResultT")

_WRITE_ATTEMPTS = 5
_REAP_AT_ONCE = 1000
_RETRY_AFTER_FULL_S = 5.0


class Change(NamedTuple):
    """A record to put in place of the one given, and its packed states where they were made."""

    record: SceneRecord
    packed: bytes | None = None


@dataclass(eq=False)
class _Live:
    """A session in use. ``record`` is None until it is read from the store."""

    key: SessionKey
    expires_at: float
    record: SceneRecord | None = None
    stored_version: int = 0
    users: int = 0
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
        on_close: Callable[[SessionKey], None] = lambda _: None,
    ) -> None:
        self._store = store
        self._pack = pack
        self._clock = clock
        self._metrics = metrics
        self._max_sessions = max_sessions
        self._park_after_s = park_after_s
        self._on_close = on_close
        self._live: dict[SessionKey, _Live] = {}
        self._creating = asyncio.Lock()

    @property
    def durable(self) -> bool:
        """Whether packed states must come with every change."""
        return self._store.durable

    async def create(self, key: SessionKey, record: SceneRecord) -> SessionInfo:
        """Opens a session.

        Raises:
            ServiceError: SESSION_EXISTS, TOO_MANY_SESSIONS.
        """
        async with self._creating:
            now = self._clock()
            if await self._store.count() >= self._max_sessions:
                await self.reap()
                if await self._store.count() >= self._max_sessions:
                    raise ServiceError(
                        ErrorKind.TOO_MANY_SESSIONS,
                        f"{self._max_sessions} sessions are open, as many as this server takes; "
                        "close one or try again later",
                        retry_after_s=_RETRY_AFTER_FULL_S,
                    )
            expires_at = now + record.idle_timeout_s
            stored = StoredSession(record.version, expires_at, records.encode(record, b""))
            if not await self._store.create(key, stored):
                await self._evict(key, "idle", expired_by=now)
                if not await self._store.create(key, stored):
                    raise ServiceError(
                        ErrorKind.SESSION_EXISTS, f"session_id: {quoted(key.id)} is open already"
                    )
            self._replace_live(_Live(key, expires_at, record, record.version))
            await self._count()
        return record.info(key.id, expires_at)

    async def change(
        self, key: SessionKey, work: Callable[[SceneRecord], Awaitable[tuple[Change, ResultT]]]
    ) -> ResultT:
        """Runs ``work`` on the session's record, alone, and puts the record it gives in place.

        ``work`` may run again on a newer record when another replica was faster. When it
        raises, nothing has changed. Using a session keeps it open.

        Raises:
            ServiceError: UNKNOWN_SESSION, also when it is closed meanwhile.
            Exception: whatever ``work`` raises.
        """
        live = self._enter(key)
        try:
            async with live.lock:
                for _ in range(_WRITE_ATTEMPTS):
                    record = await self._read(live)
                    change, result = await work(record)
                    if await self._put(live, record, change):
                        return result
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
        stored = await self._store.read(key)
        if stored is None or (stored.expires_at <= self._clock() and not (live and live.users)):
            raise unknown_session(key)
        if live is not None and live.record is not None and not live.closed:
            return live.record.info(key.id, live.expires_at)
        return records.decode(stored.data).info(key.id, stored.expires_at)

    async def page(
        self, tenant: str, after: str, limit: int
    ) -> tuple[tuple[SessionInfo, ...], bool]:
        """Up to ``limit`` sessions with ids greater than ``after``, rising; whether more follow."""
        ids = await self._store.page(tenant, after, limit + 1)
        infos = []
        for session_id in ids[:limit]:
            try:
                infos.append(await self.info(SessionKey(tenant, session_id)))
            except ServiceError as error:
                # Gone since the page was read.
                if error.kind is not ErrorKind.UNKNOWN_SESSION:
                    raise
        return tuple(infos), len(ids) > limit

    async def delete(self, key: SessionKey, reason: str = "deleted") -> None:
        """Closes a session; work in flight on it comes to nothing.

        Raises:
            ServiceError: UNKNOWN_SESSION, also for the later of two deletions.
        """
        live = self._live.get(key)
        busy = live is not None and live.users > 0
        if not busy and await self._evict(key, "idle", expired_by=self._clock()):
            raise unknown_session(key)
        if not await self._evict(key, reason):
            raise unknown_session(key)

    async def reap(self) -> int:
        """Closes the sessions that have expired; how many. One in use is left alone."""
        now = self._clock()
        closed = 0
        for key in await self._store.expired(now, _REAP_AT_ONCE):
            live = self._live.get(key)
            if live is None or not live.users:
                closed += await self._evict(key, "idle", expired_by=now)
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

    def _enter(self, key: SessionKey) -> _Live:
        live = self._live.get(key)
        if live is None:
            live = self._live[key] = _Live(key, expires_at=0.0)
        live.users += 1
        return live

    def _leave(self, live: _Live) -> None:
        live.users -= 1
        if live.record is None and not live.users and self._live.get(live.key) is live:
            del self._live[live.key]

    async def _read(self, live: _Live) -> SceneRecord:
        """The session's record; from the store where it is not live, or may have expired."""
        if live.closed:
            raise unknown_session(live.key)
        now = self._clock()
        # Whoever came before expiry holds the session open for those in line behind.
        expired = live.users == 1 and live.expires_at <= now
        if live.record is None or expired:
            stored = await self._store.read(live.key)
            if stored is None or live.closed:
                self._close(live)
                raise unknown_session(live.key)
            if expired and stored.expires_at <= now:
                await self._evict(live.key, "idle", expired_by=now)
                self._close(live)
                raise unknown_session(live.key)
            if live.record is None or stored.version != live.stored_version:
                self._show(live, records.decode(stored.data))
            live.stored_version = stored.version
        assert live.record is not None  # shown above
        return live.record

    async def _put(self, live: _Live, before: SceneRecord, change: Change) -> bool:
        """Puts a record in place; False when another replica has put one."""
        after = change.record
        if live.closed:
            raise unknown_session(live.key)
        expires_at = self._clock() + after.idle_timeout_s
        changed = (after.version, after.last_sequence) != (before.version, before.last_sequence)
        if self._store.durable and changed:
            packed = await self._pack(after) if change.packed is None else change.packed
            if not await self._write(live, after, packed, expires_at):
                self._show(live, None)
                return False
        elif not await self._store.touch(live.key, expires_at):
            self._close(live)
        if live.closed:
            raise unknown_session(live.key)
        live.expires_at = expires_at
        self._show(live, after)
        return True

    async def _write(
        self, live: _Live, record: SceneRecord, packed: bytes, expires_at: float
    ) -> bool:
        with self._metrics.stage("store"):
            stored = StoredSession(record.version, expires_at, records.encode(record, packed))
            if not await self._store.write(live.key, stored, live.stored_version):
                return False
        live.stored_version = record.version
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

    async def _evict(self, key: SessionKey, reason: str, expired_by: float | None = None) -> bool:
        """Removes a session for good; whether this call was the one that did."""
        live = self._live.get(key)
        if not await self._store.delete(key, expired_by=expired_by):
            return False
        if live is not None:
            self._close(live)
        self._metrics.evictions.labels(reason).inc()
        self._on_close(key)
        await self._count()
        return True

    def _replace_live(self, live: _Live) -> None:
        """Makes a new session the one that its key finds."""
        old = self._live.get(live.key)
        if old is not None:
            self._close(old)
        self._live[live.key] = live

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

    async def _count(self) -> None:
        self._metrics.sessions.set(await self._store.count())


def unknown_session(key: SessionKey) -> ServiceError:
    """The error for a session that does not exist, or not any more."""
    return ServiceError(
        ErrorKind.UNKNOWN_SESSION,
        f"session_id: {quoted(key.id)} is unknown: it was never opened, was closed, or has expired",
    )
