"""Where sessions are kept: bytes in, bytes out, revisions compared and set.

One protocol, three stores: ``memory``, ``sqlite`` (a file: durable, one machine) and ``redis``
(shared by replicas). ``opening`` makes the one that the settings name.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol

# Why sessions were closed is kept for so long, and for so many of them.
CLOSURES_KEPT_S = 3600.0
CLOSURES_KEPT = 10_000
# Unreadable sessions that are kept aside; of more the oldest are let go.
QUARANTINED_KEPT = 1000


class StoreError(Exception):
    """The store is away, refuses, or takes too long; what was asked may have been done."""


class Durability(Enum):
    """What an acknowledged write survives."""

    DISK = "disk"  # a loss of power: it is on disk
    OS = "os"  # the end of any process: the operating system has it
    NONE = "none"  # the end of this process, where the store is another one


class SessionKey(NamedTuple):
    """A session's name: unique within its tenant."""

    tenant: str
    id: str


@dataclass(frozen=True)
class StoredSession:
    """A session as bytes.

    ``revision`` names this very write (``new_revision``): unlike a count it never comes back,
    whatever is deleted and created again under the same key. ``expires_at`` is in Unix seconds
    and is kept apart from ``data`` so that a store can act on it.
    """

    revision: str
    expires_at: float
    data: bytes


@dataclass(frozen=True)
class Closure:
    """Why a session was closed (``reason`` as in the metric), and when, in Unix seconds.

    ``detail`` says more, in words. ``token`` tells this closure from every other one.
    """

    reason: str
    at: float
    detail: str = ""
    token: str = ""


class Quota(NamedTuple):
    """How many sessions there may be: in the whole store, and of one tenant (None: no limit)."""

    total: int
    tenant: int | None = None


class Creation(Enum):
    """What became of an attempt to create a session."""

    CREATED = "created"
    TAKEN = "taken"
    FULL = "full"
    TENANT_FULL = "tenant_full"


def new_revision() -> str:
    """A name that no other write has had or will have."""
    return secrets.token_hex(8)


class SessionStore(Protocol):
    """Keeps sessions. Every method is atomic: of two that race, one sees the other's effect.

    Whatever writes may be repeated after a ``StoreError`` with the same arguments: it is not
    done twice, and answers as it would have the first time.

    Raises:
        StoreError: by every method.
    """

    @property
    def kind(self) -> str:
        """``memory``, ``sqlite`` or ``redis``."""
        ...

    @property
    def durable(self) -> bool:
        """Whether every accepted frame is written, before it is acknowledged.

        A store that is not gets sessions when they are created and when they are parked;
        in between, memory is ahead of it.
        """
        ...

    @property
    def shared(self) -> bool:
        """Whether other processes may change sessions meanwhile."""
        ...

    @property
    def durability(self) -> Durability:
        """What a write survives once its method has returned."""
        ...

    async def create(self, key: SessionKey, session: StoredSession, quota: Quota) -> Creation:
        """Adds a session, where its key is free and the quota allows one more."""
        ...

    async def read(self, key: SessionKey) -> StoredSession | None:
        """The session, None when there is none."""
        ...

    async def write(self, key: SessionKey, session: StoredSession, expected: str) -> bool:
        """Replaces a session whose stored revision is the one expected; False when it is not."""
        ...

    async def touch(self, key: SessionKey, expires_at: float) -> bool:
        """Sets when the session expires; False when there is none."""
        ...

    async def delete(
        self, key: SessionKey, closure: Closure, *, expired_by: float | None = None
    ) -> bool:
        """Removes a session (with ``expired_by``: only if it expires by then) and notes why.

        True for the one caller that removed it.
        """
        ...

    async def quarantine(self, key: SessionKey, revision: str, closure: Closure) -> bool:
        """Removes a session of this revision and keeps its bytes aside; True for the one caller."""
        ...

    async def closure(self, key: SessionKey) -> Closure | None:
        """Why the last session of this key was closed, while that is kept."""
        ...

    async def count(self, tenant: str | None = None) -> int:
        """How many sessions there are, of one tenant or of all."""
        ...

    async def quarantined(self) -> int:
        """How many unreadable sessions are kept aside."""
        ...

    async def page(self, tenant: str, after: str, limit: int) -> list[str]:
        """Up to ``limit`` ids greater than ``after``, rising."""
        ...

    async def expired(self, now: float, limit: int) -> list[SessionKey]:
        """Up to ``limit`` sessions that expire at or before ``now``."""
        ...

    async def close(self) -> None:
        """Lets go of files and connections; what was acknowledged stays."""
        ...
