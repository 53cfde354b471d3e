"""Records of sessions as their store has them: made, read, set aside, and why they are gone."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from trajectron_service import logs, records
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.metrics import Metrics
from trajectron_service.records import RecordError, SceneRecord, UnknownFormatError
from trajectron_service.session_errors import DAMAGED, IDLE, LOST, gone
from trajectron_service.stores import (
    Closure,
    SessionKey,
    SessionStore,
    StoredSession,
    StoreError,
    new_revision,
)
from trajectron_service.validation import quoted

log = logs.get(__name__)

_LONGEST_SLACK_S = 30.0
_RETRY_AFTER_OTHER_VERSION_S = 5.0


class KeptRecords:
    """The records in one store.

    Args:
        store: has them.
        clock: Unix seconds that never go back.
        metrics: told what is closed, lost and set aside.
    """

    def __init__(self, store: SessionStore, clock: Callable[[], float], metrics: Metrics) -> None:
        self._store = store
        self._clock = clock
        self._metrics = metrics

    def stored(self, record: SceneRecord, packed: bytes, expires_at: float) -> StoredSession:
        """A record as the store takes it, under a new revision."""
        data = records.encode(record, packed)
        return StoredSession(new_revision(), expires_at + self.slack_s(record.idle_timeout_s), data)

    def slack_s(self, idle_timeout_s: float) -> float:
        """How much later than it must the store may close a session, so that it is told less."""
        return min(_LONGEST_SLACK_S, idle_timeout_s / 20) if self._store.durable else 0.0

    async def decoded(self, key: SessionKey, stored: StoredSession) -> SceneRecord:
        """The record in the bytes; bytes that are none are set aside, and said to be."""
        try:
            return records.decode(stored.data)
        except UnknownFormatError as error:
            # Another version of the service reads it, so it stays where it is.
            raise ServiceError(
                ErrorKind.STORE_UNAVAILABLE,
                f"session_id: {quoted(key.id)} was stored by another version of the service: "
                f"{error}",
                retry_after_s=_RETRY_AFTER_OTHER_VERSION_S,
            ) from error
        except RecordError as error:
            why = self.closure(DAMAGED, str(error))
            if await self._store.quarantine(key, stored.revision, why):
                log.exception("session set aside", session=key.id)
                self._metrics.evictions.labels(DAMAGED).inc()
                self._metrics.quarantined.set(await self._store.quarantined())
                await self.count()
            raise gone(key, why) from error

    def closure(self, reason: str, detail: str = "") -> Closure:
        """Why a session is closed, now."""
        return Closure(reason, self._clock(), detail, new_revision())

    def idle(self, idle_timeout_s: float | None = None) -> Closure:
        """A closure for want of use."""
        detail = "" if idle_timeout_s is None else f"{idle_timeout_s:g} s unused"
        return self.closure(IDLE, detail)

    async def gone(self, key: SessionKey, *, lost: bool = False) -> ServiceError:
        """The error for a session that the store has not; ``lost``: though it was here before."""
        closure = None
        with suppress(StoreError):
            closure = await self._store.closure(key)
            if closure is None and lost:
                log.error("session lost by the store", session=key.id)
                self._metrics.evictions.labels(LOST).inc()
                closure = self.closure(LOST, "its data is gone, and nobody closed it")
        return gone(key, closure)

    async def count(self) -> None:
        """Tells the metrics how many sessions there are."""
        self._metrics.sessions.set(await self._store.count())
