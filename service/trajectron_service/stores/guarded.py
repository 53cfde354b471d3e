"""Around any store: a time limit on every operation, and its faults counted."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import TypeVar

from trajectron_service.metrics import Metrics
from trajectron_service.stores import (
    Closure,
    Creation,
    Durability,
    Quota,
    SessionKey,
    SessionStore,
    StoredSession,
    StoreError,
)

T = TypeVar("T")


class GuardedStore:
    """Implements ``SessionStore`` over another one.

    Args:
        store: the one that does the work.
        metrics: told about faults, and whether the last operation went well.
        timeout_s: an operation that takes longer is given up; the store may still do it.
    """

    def __init__(self, store: SessionStore, metrics: Metrics, timeout_s: float) -> None:
        self._store = store
        self._metrics = metrics
        self._timeout_s = timeout_s
        metrics.store_up.set(1)

    @property
    def kind(self) -> str:
        """See ``SessionStore``."""
        return self._store.kind

    @property
    def durable(self) -> bool:
        """See ``SessionStore``."""
        return self._store.durable

    @property
    def shared(self) -> bool:
        """See ``SessionStore``."""
        return self._store.shared

    @property
    def durability(self) -> Durability:
        """See ``SessionStore``."""
        return self._store.durability

    async def create(self, key: SessionKey, session: StoredSession, quota: Quota) -> Creation:
        """See ``SessionStore``."""
        return await self._within("create", self._store.create(key, session, quota))

    async def read(self, key: SessionKey) -> StoredSession | None:
        """See ``SessionStore``."""
        return await self._within("read", self._store.read(key))

    async def write(self, key: SessionKey, session: StoredSession, expected: str) -> bool:
        """See ``SessionStore``."""
        return await self._within("write", self._store.write(key, session, expected))

    async def touch(self, key: SessionKey, expires_at: float) -> bool:
        """See ``SessionStore``."""
        return await self._within("touch", self._store.touch(key, expires_at))

    async def delete(
        self, key: SessionKey, closure: Closure, *, expired_by: float | None = None
    ) -> bool:
        """See ``SessionStore``."""
        removal = self._store.delete(key, closure, expired_by=expired_by)
        return await self._within("delete", removal)

    async def quarantine(self, key: SessionKey, revision: str, closure: Closure) -> bool:
        """See ``SessionStore``."""
        return await self._within("quarantine", self._store.quarantine(key, revision, closure))

    async def closure(self, key: SessionKey) -> Closure | None:
        """See ``SessionStore``."""
        return await self._within("closure", self._store.closure(key))

    async def count(self, tenant: str | None = None) -> int:
        """See ``SessionStore``."""
        return await self._within("count", self._store.count(tenant))

    async def quarantined(self) -> int:
        """See ``SessionStore``."""
        return await self._within("quarantined", self._store.quarantined())

    async def page(self, tenant: str, after: str, limit: int) -> list[str]:
        """See ``SessionStore``."""
        return await self._within("page", self._store.page(tenant, after, limit))

    async def expired(self, now: float, limit: int) -> list[SessionKey]:
        """See ``SessionStore``."""
        return await self._within("expired", self._store.expired(now, limit))

    async def close(self) -> None:
        """See ``SessionStore``."""
        await self._store.close()

    async def _within(self, operation: str, work: Awaitable[T]) -> T:
        try:
            async with asyncio.timeout(self._timeout_s):
                result = await work
        except (StoreError, TimeoutError) as error:
            self._metrics.store_errors.labels(operation).inc()
            self._metrics.store_up.set(0)
            if isinstance(error, StoreError):
                raise
            raise StoreError(f"no answer to {operation} within {self._timeout_s:g} s") from error
        self._metrics.store_up.set(1)
        return result
