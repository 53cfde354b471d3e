"""Sessions in this process's memory: gone when it ends."""

from __future__ import annotations

import dataclasses
import heapq
from collections import Counter, OrderedDict

from trajectron_service.stores import (
    CLOSURES_KEPT,
    CLOSURES_KEPT_S,
    QUARANTINED_KEPT,
    Closure,
    Creation,
    Durability,
    Quota,
    SessionKey,
    StoredSession,
)


class MemoryStore:
    """Implements ``SessionStore``; atomic because it never awaits.

    Args:
        durable: pretend that what is written outlives the process, so that every accepted
            frame is written (what a durable store costs and does, without its disk).
    """

    kind = "memory"
    shared = False
    durability = Durability.NONE

    def __init__(self, *, durable: bool = False) -> None:
        self._durable = durable
        self._sessions: dict[SessionKey, StoredSession] = {}
        self._of_tenant: Counter[str] = Counter()
        self._closures: OrderedDict[SessionKey, Closure] = OrderedDict()
        self._aside: OrderedDict[tuple[SessionKey, str], bytes] = OrderedDict()

    @property
    def durable(self) -> bool:
        """See ``SessionStore``."""
        return self._durable

    async def create(self, key: SessionKey, session: StoredSession, quota: Quota) -> Creation:
        """See ``SessionStore``."""
        stored = self._sessions.get(key)
        if stored is not None:
            same = stored.revision == session.revision
            return Creation.CREATED if same else Creation.TAKEN
        if len(self._sessions) >= quota.total:
            return Creation.FULL
        if quota.tenant is not None and self._of_tenant[key.tenant] >= quota.tenant:
            return Creation.TENANT_FULL
        self._sessions[key] = session
        self._of_tenant[key.tenant] += 1
        return Creation.CREATED

    async def read(self, key: SessionKey) -> StoredSession | None:
        """See ``SessionStore``."""
        return self._sessions.get(key)

    async def write(self, key: SessionKey, session: StoredSession, expected: str) -> bool:
        """See ``SessionStore``."""
        stored = self._sessions.get(key)
        if stored is None or stored.revision not in (expected, session.revision):
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

    async def delete(
        self, key: SessionKey, closure: Closure, *, expired_by: float | None = None
    ) -> bool:
        """See ``SessionStore``."""
        stored = self._sessions.get(key)
        if stored is None:
            return self._closures.get(key) == closure
        if expired_by is not None and stored.expires_at > expired_by:
            return False
        self._remove(key, closure)
        return True

    async def quarantine(self, key: SessionKey, revision: str, closure: Closure) -> bool:
        """See ``SessionStore``."""
        stored = self._sessions.get(key)
        if stored is None or stored.revision != revision:
            return self._closures.get(key) == closure
        self._aside[key, revision] = stored.data
        while len(self._aside) > QUARANTINED_KEPT:
            self._aside.popitem(last=False)
        self._remove(key, closure)
        return True

    async def closure(self, key: SessionKey) -> Closure | None:
        """See ``SessionStore``."""
        return self._closures.get(key)

    async def count(self, tenant: str | None = None) -> int:
        """See ``SessionStore``."""
        return len(self._sessions) if tenant is None else self._of_tenant[tenant]

    async def quarantined(self) -> int:
        """See ``SessionStore``."""
        return len(self._aside)

    async def page(self, tenant: str, after: str, limit: int) -> list[str]:
        """See ``SessionStore``."""
        ids = (key.id for key in self._sessions if key.tenant == tenant and key.id > after)
        return heapq.nsmallest(limit, ids)

    async def expired(self, now: float, limit: int) -> list[SessionKey]:
        """See ``SessionStore``."""
        due = [key for key, stored in self._sessions.items() if stored.expires_at <= now]
        return due[:limit]

    async def close(self) -> None:
        """See ``SessionStore``."""

    def _remove(self, key: SessionKey, closure: Closure) -> None:
        del self._sessions[key]
        self._of_tenant[key.tenant] -= 1
        if not self._of_tenant[key.tenant]:
            del self._of_tenant[key.tenant]
        self._closures[key] = closure
        self._closures.move_to_end(key)
        # In the order of closing, so the oldest are first.
        while self._closures:
            oldest = next(iter(self._closures.values()))
            if len(self._closures) <= CLOSURES_KEPT and oldest.at > closure.at - CLOSURES_KEPT_S:
                return
            self._closures.popitem(last=False)
