"""Sessions in this process's memory: gone when it ends."""

from __future__ import annotations

import dataclasses
import heapq

from trajectron_service.stores import SessionKey, StoredSession


class MemoryStore:
    """Implements ``SessionStore``; atomic because it never awaits.

    Args:
        durable: pretend that what is written outlives the process, so that every accepted
            frame is written (what a durable store costs and does, without its disk).
    """

    def __init__(self, *, durable: bool = False) -> None:
        self._durable = durable
        self._sessions: dict[SessionKey, StoredSession] = {}

    @property
    def durable(self) -> bool:
        """See ``SessionStore``."""
        return self._durable

    async def create(self, key: SessionKey, session: StoredSession) -> bool:
        """See ``SessionStore``."""
        if key in self._sessions:
            return False
        self._sessions[key] = session
        return True

    async def read(self, key: SessionKey) -> StoredSession | None:
        """See ``SessionStore``."""
        return self._sessions.get(key)

    async def write(self, key: SessionKey, session: StoredSession, expected_version: int) -> bool:
        """See ``SessionStore``."""
        stored = self._sessions.get(key)
        if stored is None or stored.version != expected_version:
            return False
        self._sessions[key] = session
        return True

    async def touch(self, key: SessionKey, expires_at: float) -> bool:
        """See ``SessionStore``."""
        stored = self._sessions.get(key)
        if stored is None:
            return False
        self._sessions[key] = dataclasses.replace(stored, expires_at=expires_at)
        return True

    async def delete(self, key: SessionKey, *, expired_by: float | None = None) -> bool:
        """See ``SessionStore``."""
        stored = self._sessions.get(key)
        if stored is None or (expired_by is not None and stored.expires_at > expired_by):
            return False
        del self._sessions[key]
        return True

    async def count(self) -> int:
        """See ``SessionStore``."""
        return len(self._sessions)

    async def page(self, tenant: str, after: str, limit: int) -> list[str]:
        """See ``SessionStore``."""
        ids = (key.id for key in self._sessions if key.tenant == tenant and key.id > after)
        return heapq.nsmallest(limit, ids)

    async def expired(self, now: float, limit: int) -> list[SessionKey]:
        """See ``SessionStore``."""
        due = [key for key, stored in self._sessions.items() if stored.expires_at <= now]
        return due[:limit]
