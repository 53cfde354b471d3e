"""Where sessions are kept: bytes in, bytes out, versions compared and set.

One protocol; ``memory`` is its first implementation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol


class SessionKey(NamedTuple):
    """A session's name: unique within its tenant."""

    tenant: str
    id: str


@dataclass(frozen=True)
class StoredSession:
    """A session as bytes.

    ``version`` is the session's own: it counts accepted frames. ``expires_at`` is in Unix
    seconds and is kept apart from ``data`` so that a store can act on it.
    """

    version: int
    expires_at: float
    data: bytes


class SessionStore(Protocol):
    """Keeps sessions. Every method is atomic: of two that race, one sees the other's effect."""

    @property
    def durable(self) -> bool:
        """Whether every accepted frame is written, before it is acknowledged.

        A store that is not gets sessions when they are created and when they are parked;
        in between, memory is ahead of it.
        """
        ...

    async def create(self, key: SessionKey, session: StoredSession) -> bool:
        """Adds a session; False when the key is taken."""
        ...

    async def read(self, key: SessionKey) -> StoredSession | None:
        """The session, None when there is none."""
        ...

    async def write(self, key: SessionKey, session: StoredSession, expected_version: int) -> bool:
        """Replaces a session whose stored version is the one expected; False when it is not."""
        ...

    async def touch(self, key: SessionKey, expires_at: float) -> bool:
        """Sets when the session expires; False when there is none."""
        ...

    async def delete(self, key: SessionKey, *, expired_by: float | None = None) -> bool:
        """Removes a session (with ``expired_by``: only if it expires by then).

        True for the one caller that removed it.
        """
        ...

    async def count(self) -> int:
        """How many sessions there are, of all tenants."""
        ...

    async def page(self, tenant: str, after: str, limit: int) -> list[str]:
        """Up to ``limit`` ids greater than ``after``, rising."""
        ...

    async def expired(self, now: float, limit: int) -> list[SessionKey]:
        """Up to ``limit`` sessions that expire at or before ``now``."""
        ...
