"""Sessions in an SQLite file: durable, of one process at a time.

**Group commit.** One thread owns the connection. It takes everything that waits as one
transaction: while a commit is on its way to the disk, the writes of other sessions gather and
share the next one. Nothing is answered before its commit has returned.
"""

from __future__ import annotations

import asyncio
import fcntl
import queue
import sqlite3
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeVar

from trajectron_service.stores import (
    Closure,
    Creation,
    Durability,
    Quota,
    SessionKey,
    StoredSession,
    StoreError,
    sqlite_statements,
)

T = TypeVar("T")
Work = Callable[[sqlite3.Connection], Any]

# Transactions of more would make the first of them wait too long.
_GROUP = 512
# Others only look at the file, as a backup does.
_BUSY_TIMEOUT_S = 5.0
_CHECKPOINT_PAGES = 4000
_JOURNAL_BYTES = 64 * 2**20
_SYNCHRONOUS = {Durability.DISK: "FULL", Durability.OS: "NORMAL", Durability.NONE: "OFF"}


@dataclass(frozen=True, eq=False, slots=True)
class _Request:
    """Work for the thread, and who waits for it."""

    work: Work
    writes: bool
    loop: asyncio.AbstractEventLoop
    answer: asyncio.Future[Any]


class SqliteStore:
    """Implements ``SessionStore``. Use ``open``.

    Args:
        connection: to the prepared file; this store's own from now on.
        lock: an open file that is locked as long as this process uses the database.
        durability: what a commit waits for.
        on_commit: told how many operations one transaction took together, on the thread.
    """

    kind = "sqlite"
    shared = False
    durable = True

    def __init__(
        self,
        connection: sqlite3.Connection,
        lock: IO[bytes],
        durability: Durability,
        on_commit: Callable[[int], None] = lambda _operations: None,
    ) -> None:
        self.durability = durability
        self._connection = connection
        self._lock = lock
        self._on_commit = on_commit
        self._requests: queue.SimpleQueue[_Request | None] = queue.SimpleQueue()
        self._closed = False
        self._thread = threading.Thread(target=self._serve, name="sqlite-store", daemon=True)
        self._thread.start()

    @staticmethod
    def open(
        path: Path,
        durability: Durability = Durability.DISK,
        on_commit: Callable[[int], None] = lambda _operations: None,
    ) -> SqliteStore:
        """The store in a file, made where there is none.

        Raises:
            StoreError: it cannot be opened, is no database, or of a version not known here.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = _locked(path.with_name(f"{path.name}-lock"))
            try:
                connection = _connected(path, durability)
            except BaseException:
                lock.close()
                raise
        except (OSError, sqlite3.Error, StoreError) as error:
            raise StoreError(f"{path}: {error}") from error
        return SqliteStore(connection, lock, durability, on_commit)

    async def create(self, key: SessionKey, session: StoredSession, quota: Quota) -> Creation:
        """See ``SessionStore``."""
        return await self._run(lambda db: sqlite_statements.create(db, key, session, quota))

    async def read(self, key: SessionKey) -> StoredSession | None:
        """See ``SessionStore``."""
        return await self._run(lambda db: sqlite_statements.read(db, key), writes=False)

    async def write(self, key: SessionKey, session: StoredSession, expected: str) -> bool:
        """See ``SessionStore``."""
        return await self._run(lambda db: sqlite_statements.write(db, key, session, expected))

    async def touch(self, key: SessionKey, expires_at: float) -> bool:
        """See ``SessionStore``."""
        return await self._run(lambda db: sqlite_statements.touch(db, key, expires_at))

    async def delete(
        self, key: SessionKey, closure: Closure, *, expired_by: float | None = None
    ) -> bool:
        """See ``SessionStore``."""
        return await self._run(lambda db: sqlite_statements.delete(db, key, closure, expired_by))

    async def quarantine(self, key: SessionKey, revision: str, closure: Closure) -> bool:
        """See ``SessionStore``."""
        return await self._run(lambda db: sqlite_statements.quarantine(db, key, revision, closure))

    async def closure(self, key: SessionKey) -> Closure | None:
        """See ``SessionStore``."""
        return await self._run(lambda db: sqlite_statements.closure(db, key), writes=False)

    async def count(self, tenant: str | None = None) -> int:
        """See ``SessionStore``."""
        return await self._run(lambda db: sqlite_statements.count(db, tenant), writes=False)

    async def quarantined(self) -> int:
        """See ``SessionStore``."""
        return await self._run(sqlite_statements.quarantined, writes=False)

    async def page(self, tenant: str, after: str, limit: int) -> list[str]:
        """See ``SessionStore``."""
        return await self._run(
            lambda db: sqlite_statements.page(db, tenant, after, limit), writes=False
        )

    async def expired(self, now: float, limit: int) -> list[SessionKey]:
        """See ``SessionStore``."""
        return await self._run(lambda db: sqlite_statements.expired(db, now, limit), writes=False)

    async def close(self) -> None:
        """See ``SessionStore``; what was asked before is still done."""
        if self._closed:
            return
        self._closed = True
        self._requests.put(None)
        await asyncio.to_thread(self._thread.join)

    async def _run(self, work: Callable[[sqlite3.Connection], T], *, writes: bool = True) -> T:
        if self._closed:
            raise StoreError("the store is closed")
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[T] = loop.create_future()
        self._requests.put(_Request(work, writes, loop, answer))
        return await answer

    def _serve(self) -> None:
        """The thread: transactions of whatever waits, until the store is closed."""
        closing = False
        while not closing:
            request = self._requests.get()
            group: list[_Request] = []
            while True:
                if request is None:
                    closing = True
                    break
                group.append(request)
                if len(group) == _GROUP or self._requests.empty():
                    break
                request = self._requests.get()
            if group:
                self._answer(group)
        self._connection.close()
        self._lock.close()

    def _answer(self, group: list[_Request]) -> None:
        """Does a group as one transaction; one by one where that failed, for the others' sake."""
        try:
            results = self._transact(group)
        except Exception as error:  # noqa: BLE001  whatever it is, somebody waits for it
            if len(group) > 1:
                for request in group:
                    self._answer([request])
                return
            _tell(group, [_as_store_error(error)])
            return
        _tell(group, results)

    def _transact(self, group: list[_Request]) -> list[Any]:
        db = self._connection
        writes = any(request.writes for request in group)
        db.execute("BEGIN IMMEDIATE" if writes else "BEGIN")
        try:
            results = [request.work(db) for request in group]
            db.execute("COMMIT")
        except BaseException:
            # A full disk may have ended the transaction already.
            if db.in_transaction:
                db.execute("ROLLBACK")
            raise
        if writes:
            self._on_commit(len(group))
        return results


def _connected(path: Path, durability: Durability) -> sqlite3.Connection:
    connection = sqlite3.connect(
        path, timeout=_BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False
    )
    try:
        # First of all: a file of somebody else's is not changed.
        sqlite_statements.prepare(connection)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute(f"PRAGMA synchronous = {_SYNCHRONOUS[durability]}")
        connection.execute(f"PRAGMA wal_autocheckpoint = {_CHECKPOINT_PAGES}")
        connection.execute(f"PRAGMA journal_size_limit = {_JOURNAL_BYTES}")
    except BaseException:
        connection.close()
        raise
    return connection


def _locked(path: Path) -> IO[bytes]:
    """An open file that no other process has locked; the system unlocks it if this one dies."""
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise StoreError(
            "another process uses this database; replicas share a Redis instead"
        ) from error
    return file


def _as_store_error(error: Exception) -> Exception:
    if isinstance(error, sqlite3.Error):
        told = StoreError(f"SQLite: {error}")
        told.__cause__ = error
        return told
    return error


def _tell(group: list[_Request], results: list[Any]) -> None:
    """Hands results to those who wait, in one turn of their loop each."""
    by_loop: dict[asyncio.AbstractEventLoop, list[tuple[asyncio.Future[Any], Any]]] = {}
    for request, result in zip(group, results, strict=True):
        by_loop.setdefault(request.loop, []).append((request.answer, result))
    for loop, answers in by_loop.items():
        if not loop.is_closed():
            loop.call_soon_threadsafe(_settle, answers)


def _settle(answers: list[tuple[asyncio.Future[Any], Any]]) -> None:
    for answer, result in answers:
        if answer.done():  # cancelled: nobody waits any more
            continue
        if isinstance(result, Exception):
            answer.set_exception(result)
        else:
            answer.set_result(result)
