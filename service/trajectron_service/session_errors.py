"""What clients are told of sessions that are gone, damaged, or cannot be stored."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

from trajectron_service import logs
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.stores import Closure, SessionKey, StoreError
from trajectron_service.validation import quoted

log = logs.get(__name__)

DELETED, IDLE, STREAM_ENDED, DAMAGED, LOST = (
    "deleted", "idle", "stream_ended", "damaged", "lost",
)  # fmt: skip
_RETRY_AFTER_FAULT_S = 1.0
_WORDS = {
    DELETED: "it was deleted",
    IDLE: "it was closed for want of use",
    STREAM_ENDED: "it was closed with its stream",
    LOST: "the store had lost it",
}


def gone(key: SessionKey, closure: Closure | None) -> ServiceError:
    """The error for a session that does not exist, or not any more."""
    name = quoted(key.id)
    if closure is None:
        return ServiceError(
            ErrorKind.UNKNOWN_SESSION,
            f"session_id: {name} is unknown: it was never opened, or was closed long ago",
        )
    at = datetime.fromtimestamp(closure.at, UTC).isoformat(timespec="seconds")
    if closure.reason == DAMAGED:
        return ServiceError(
            ErrorKind.SESSION_DAMAGED,
            f"session_id: what is stored of {name} cannot be read ({closure.detail}); it was set "
            f"aside at {at}; open a new session",
        )
    words = _WORDS.get(closure.reason, f"it was closed ({closure.reason})")
    detail = f" ({closure.detail})" if closure.detail else ""
    return ServiceError(
        ErrorKind.UNKNOWN_SESSION, f"session_id: {name} is unknown: {words} at {at}{detail}"
    )


@contextmanager
def store_faults() -> Iterator[None]:
    """Turns faults of the store in the block into STORE_UNAVAILABLE."""
    try:
        yield
    except StoreError as error:
        log.warning("store fault", reason=str(error))
        raise ServiceError(
            ErrorKind.STORE_UNAVAILABLE,
            "sessions cannot be stored or looked up now; try again, after the last frame "
            "acknowledged",
            retry_after_s=_RETRY_AFTER_FAULT_S,
        ) from error
