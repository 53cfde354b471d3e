"""Who calls: the tenant on whose behalf the work in hand is done, and what it may do.

Every call runs in a task of its own; the adapters name its tenant there (``enter``) before the
core is asked for anything. Without tokens everybody is the one tenant ``DEFAULT``.
"""

from __future__ import annotations

import enum
from contextvars import ContextVar

DEFAULT = "default"


class Scope(enum.Enum):
    """What a token may be good for."""

    PREDICT = "predict"
    SESSIONS = "sessions"
    EVALUATE = "evaluate"
    ADMIN = "admin"


_tenant: ContextVar[str] = ContextVar("tenant", default=DEFAULT)


def enter(tenant: str) -> None:
    """The rest of the running task works for this tenant, and so do the tasks that it starts."""
    _tenant.set(tenant)


def current() -> str:
    """The tenant that the running task works for."""
    return _tenant.get()
