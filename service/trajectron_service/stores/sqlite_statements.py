"""The statements of the SQLite store: each works inside a transaction that is open already."""

from __future__ import annotations

import sqlite3

from trajectron_service.stores import (
    CLOSURES_KEPT,
    CLOSURES_KEPT_S,
    QUARANTINED_KEPT,
    Closure,
    Creation,
    Quota,
    SessionKey,
    StoredSession,
    StoreError,
)

# What PRAGMA application_id marks as ours: "TJSS" in ASCII.
_APPLICATION = 0x544A5353
_VERSION = 1
_TABLES = """
CREATE TABLE sessions (
    tenant TEXT NOT NULL,
    id TEXT NOT NULL,
    revision TEXT NOT NULL,
    expires_at REAL NOT NULL,
    data BLOB NOT NULL,
    PRIMARY KEY (tenant, id)
);
CREATE INDEX sessions_by_expiry ON sessions (expires_at);
CREATE TABLE closures (
    tenant TEXT NOT NULL,
    id TEXT NOT NULL,
    at REAL NOT NULL,
    reason TEXT NOT NULL,
    detail TEXT NOT NULL,
    token TEXT NOT NULL,
    PRIMARY KEY (tenant, id)
);
CREATE INDEX closures_by_time ON closures (at);
CREATE TABLE quarantined (
    tenant TEXT NOT NULL,
    id TEXT NOT NULL,
    revision TEXT NOT NULL,
    at REAL NOT NULL,
    detail TEXT NOT NULL,
    data BLOB NOT NULL,
    PRIMARY KEY (tenant, id, revision)
);
"""


def prepare(db: sqlite3.Connection) -> None:
    """Makes the tables in a new file; raises ``StoreError`` for a file that is another's."""
    db.execute("BEGIN IMMEDIATE")
    try:
        application = db.execute("PRAGMA application_id").fetchone()[0]
        version = db.execute("PRAGMA user_version").fetchone()[0]
        empty = db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        if empty:
            for statement in _TABLES.split(";")[:-1]:
                db.execute(statement)
            db.execute(f"PRAGMA application_id = {_APPLICATION}")
            db.execute(f"PRAGMA user_version = {_VERSION}")
        elif application != _APPLICATION:
            raise StoreError("this database is not one of sessions; name another file")
        elif version != _VERSION:
            raise StoreError(
                f"this database has version {version}, and this server knows {_VERSION} only"
            )
        db.execute("COMMIT")
    except BaseException:
        if db.in_transaction:
            db.execute("ROLLBACK")
        raise


def create(
    db: sqlite3.Connection, key: SessionKey, session: StoredSession, quota: Quota
) -> Creation:
    """See ``SessionStore.create``."""
    stored = _revision(db, key)
    if stored is not None:
        return Creation.CREATED if stored == session.revision else Creation.TAKEN
    if count(db) >= quota.total:
        return Creation.FULL
    if quota.tenant is not None and count(db, key.tenant) >= quota.tenant:
        return Creation.TENANT_FULL
    db.execute(
        "INSERT INTO sessions VALUES (?, ?, ?, ?, ?)",
        (*key, session.revision, session.expires_at, session.data),
    )
    return Creation.CREATED


def read(db: sqlite3.Connection, key: SessionKey) -> StoredSession | None:
    """See ``SessionStore.read``."""
    row = db.execute(
        "SELECT revision, expires_at, data FROM sessions WHERE tenant = ? AND id = ?", key
    ).fetchone()
    return None if row is None else StoredSession(*row)


def write(db: sqlite3.Connection, key: SessionKey, session: StoredSession, expected: str) -> bool:
    """See ``SessionStore.write``."""
    changed = db.execute(
        "UPDATE sessions SET revision = ?, expires_at = ?, data = ?"
        " WHERE tenant = ? AND id = ? AND revision IN (?, ?)",
        (session.revision, session.expires_at, session.data, *key, expected, session.revision),
    )
    return changed.rowcount == 1


def touch(db: sqlite3.Connection, key: SessionKey, expires_at: float) -> bool:
    """See ``SessionStore.touch``."""
    changed = db.execute(
        "UPDATE sessions SET expires_at = ? WHERE tenant = ? AND id = ?", (expires_at, *key)
    )
    return changed.rowcount == 1


def delete(db: sqlite3.Connection, key: SessionKey, why: Closure, expired_by: float | None) -> bool:
    """See ``SessionStore.delete``."""
    if _revision(db, key) is None:
        return closure(db, key) == why
    limit = float("inf") if expired_by is None else expired_by
    removed = db.execute(
        "DELETE FROM sessions WHERE tenant = ? AND id = ? AND expires_at <= ?", (*key, limit)
    )
    if removed.rowcount == 1:
        _note(db, key, why)
        return True
    return False


def quarantine(db: sqlite3.Connection, key: SessionKey, revision: str, why: Closure) -> bool:
    """See ``SessionStore.quarantine``."""
    if _revision(db, key) != revision:
        return closure(db, key) == why
    db.execute(
        "INSERT OR REPLACE INTO quarantined SELECT tenant, id, revision, ?, ?, data"
        " FROM sessions WHERE tenant = ? AND id = ?",
        (why.at, why.detail, *key),
    )
    db.execute(
        "DELETE FROM quarantined WHERE rowid NOT IN"
        " (SELECT rowid FROM quarantined ORDER BY at DESC LIMIT ?)",
        (QUARANTINED_KEPT,),
    )
    db.execute("DELETE FROM sessions WHERE tenant = ? AND id = ?", key)
    _note(db, key, why)
    return True


def closure(db: sqlite3.Connection, key: SessionKey) -> Closure | None:
    """See ``SessionStore.closure``."""
    row = db.execute(
        "SELECT reason, at, detail, token FROM closures WHERE tenant = ? AND id = ?", key
    ).fetchone()
    return None if row is None else Closure(*row)


def count(db: sqlite3.Connection, tenant: str | None = None) -> int:
    """See ``SessionStore.count``."""
    found: int
    if tenant is None:
        found = db.execute("SELECT count(*) FROM sessions").fetchone()[0]
    else:
        query = "SELECT count(*) FROM sessions WHERE tenant = ?"
        found = db.execute(query, (tenant,)).fetchone()[0]
    return found


def quarantined(db: sqlite3.Connection) -> int:
    """See ``SessionStore.quarantined``."""
    found: int = db.execute("SELECT count(*) FROM quarantined").fetchone()[0]
    return found


def page(db: sqlite3.Connection, tenant: str, after: str, limit: int) -> list[str]:
    """See ``SessionStore.page``."""
    rows = db.execute(
        "SELECT id FROM sessions WHERE tenant = ? AND id > ? ORDER BY id LIMIT ?",
        (tenant, after, limit),
    )
    return [row[0] for row in rows]


def expired(db: sqlite3.Connection, now: float, limit: int) -> list[SessionKey]:
    """See ``SessionStore.expired``."""
    rows = db.execute("SELECT tenant, id FROM sessions WHERE expires_at <= ? LIMIT ?", (now, limit))
    return [SessionKey(*row) for row in rows]


def _revision(db: sqlite3.Connection, key: SessionKey) -> str | None:
    query = "SELECT revision FROM sessions WHERE tenant = ? AND id = ?"
    row = db.execute(query, key).fetchone()
    return None if row is None else row[0]


def _note(db: sqlite3.Connection, key: SessionKey, why: Closure) -> None:
    """Notes why a session was closed, and forgets what is too old or too much."""
    db.execute(
        "INSERT OR REPLACE INTO closures VALUES (?, ?, ?, ?, ?, ?)",
        (*key, why.at, why.reason, why.detail, why.token),
    )
    db.execute("DELETE FROM closures WHERE at <= ?", (why.at - CLOSURES_KEPT_S,))
    db.execute(
        "DELETE FROM closures WHERE rowid IN"
        " (SELECT rowid FROM closures ORDER BY at DESC LIMIT -1 OFFSET ?)",
        (CLOSURES_KEPT,),
    )
