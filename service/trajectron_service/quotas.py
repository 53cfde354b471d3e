"""What a tenant may use: how much may be open at once, and how much it may ask for a second.

Quotas stand in the file of tokens; all tokens of a tenant share them. What they do not name is
not bounded for a tenant, only for all together. Counts of sessions are the store's, shared by
its replicas; everything else is counted by this process.
"""

from __future__ import annotations

import enum
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from trajectron_service import tenancy
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.metrics import Metrics

_Count = Annotated[int, Field(ge=1)]
_PerSecond = Annotated[float, Field(gt=0.0, le=1e12, allow_inf_nan=False)]

# A tenant may save up a second's worth, one at least.
_BURST_S = 1.0
# What is missing of a whole one may be a rounding of the clock.
_ROUNDING = 1e-9
# More tenants than this share a label: series are for ever.
_MOST_LABELS = 100
_OTHER = "(other)"


class Quotas(BaseModel):
    """What one tenant may use at most; None: as much as there is."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    sessions: _Count | None = Field(None, description="Open sessions.")
    streams: _Count | None = Field(None, description="Open streams, and evaluations watched.")
    evaluations: _Count | None = Field(None, description="Evaluations kept.")
    evaluations_active: _Count | None = Field(None, description="Evaluations queued or running.")
    requests_per_s: _PerSecond | None = Field(None, description="Calls; a stream is one.")
    frames_per_s: _PerSecond | None = Field(None, description="Frames, of calls and streams.")
    points_per_s: _PerSecond | None = Field(None, description="Agents x samples x steps.")


UNLIMITED = Quotas()


class Limit(enum.Enum):
    """Quotas of what is there at once, by their names in ``Quotas``."""

    SESSIONS = "sessions"
    STREAMS = "streams"
    EVALUATIONS = "evaluations"
    EVALUATIONS_ACTIVE = "evaluations_active"


class Rate(enum.Enum):
    """Quotas of what is asked for in a second, by their names in ``Quotas``."""

    REQUESTS = "requests_per_s"
    FRAMES = "frames_per_s"
    POINTS = "points_per_s"


_TOO_MANY = {
    Limit.SESSIONS: (ErrorKind.TOO_MANY_SESSIONS, "sessions open", 5.0),
    Limit.STREAMS: (ErrorKind.TOO_MANY_STREAMS, "streams open", 1.0),
    Limit.EVALUATIONS: (ErrorKind.TOO_MANY_EVALUATIONS, "evaluations kept; delete some", 30.0),
    Limit.EVALUATIONS_ACTIVE: (
        ErrorKind.TOO_MANY_EVALUATIONS, "evaluations queued or running", 30.0,
    ),
}  # fmt: skip
_UNITS = {
    Rate.REQUESTS: "requests",
    Rate.FRAMES: "frames",
    Rate.POINTS: "points of forecasts (agents x samples x steps)",
}


class Usage:
    """What the tenants use, held to their quotas; the tenant is that of the running task.

    Args:
        quotas: those of a tenant, as they are now.
        metrics: told what is refused.
        clock: seconds that never go back.
    """

    def __init__(
        self,
        quotas: Callable[[str], Quotas],
        metrics: Metrics,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._quotas = quotas
        self._metrics = metrics
        self._clock = clock
        self._buckets: dict[tuple[str, Rate], _Bucket] = {}
        self._streams: dict[str, Counter[Hashable]] = {}  # by tenant, of each subject
        self._labels: set[str] = set()

    def limit(self, limit: Limit) -> int | None:
        """How many the tenant may have."""
        value: int | None = getattr(self._quotas(tenancy.current()), limit.value)
        return value

    def check(self, limit: Limit, there: int) -> None:
        """Raises where the tenant has as many as it may.

        Raises:
            ServiceError: TOO_MANY_SESSIONS, TOO_MANY_STREAMS, TOO_MANY_EVALUATIONS.
        """
        most = self.limit(limit)
        if most is not None and there >= most:
            raise self.too_many(limit)

    def too_many(self, limit: Limit) -> ServiceError:
        """The refusal of one more."""
        self._refused(limit.value)
        kind, what, retry_after_s = _TOO_MANY[limit]
        return ServiceError(
            kind,
            f"your tenant may have {self.limit(limit)} {what}",
            retry_after_s=retry_after_s,
        )

    @contextmanager
    def stream(self, subject: Hashable) -> Iterator[None]:
        """Counts a stream for the length of the block; one that takes over another is not one more.

        Args:
            subject: what one stream at a time has, such as the id of a session.

        Raises:
            ServiceError: TOO_MANY_STREAMS.
        """
        tenant = tenancy.current()
        streams = self._streams.setdefault(tenant, Counter())
        if subject not in streams:
            self.check(Limit.STREAMS, len(streams))
        streams[subject] += 1
        try:
            yield
        finally:
            streams[subject] -= 1
            if not streams[subject]:
                del streams[subject]

    def take(self, rate: Rate, amount: float = 1.0) -> None:
        """Takes an amount from what the tenant may ask for.

        More than a second's worth is taken from a second's worth saved up, and owed.

        Raises:
            ServiceError: RATE_LIMITED, and nothing was taken.
        """
        bucket = self._bucket(rate)
        wait_s = 0.0 if bucket is None else bucket.take(amount, self._clock())
        if bucket is not None and wait_s > 0.0:
            self._refused(rate.value)
            raise ServiceError(
                ErrorKind.RATE_LIMITED,
                f"your tenant may ask for {bucket.rate:g} {_UNITS[rate]} a second",
                retry_after_s=wait_s,
            )

    def give_back(self, rate: Rate, amount: float) -> None:
        """Gives back what was taken for work that was refused after all."""
        bucket = self._bucket(rate)
        if bucket is not None:
            bucket.give_back(amount)

    @contextmanager
    def taken(self, rate: Rate, amount: float) -> Iterator[None]:
        """Takes an amount, and gives it back where the block refuses the work.

        Raises:
            ServiceError: RATE_LIMITED.
        """
        self.take(rate, amount)
        try:
            yield
        except ServiceError:
            self.give_back(rate, amount)
            raise

    def _bucket(self, rate: Rate) -> _Bucket | None:
        tenant = tenancy.current()
        per_second: float | None = getattr(self._quotas(tenant), rate.value)
        if per_second is None:
            return None
        bucket = self._buckets.get((tenant, rate))
        if bucket is None or bucket.rate != per_second:
            bucket = self._buckets[tenant, rate] = _Bucket(per_second, self._clock())
        return bucket

    def _refused(self, quota: str) -> None:
        tenant = tenancy.current()
        if tenant not in self._labels:
            if len(self._labels) >= _MOST_LABELS:
                tenant = _OTHER
            else:
                self._labels.add(tenant)
        self._metrics.quota_refusals.labels(tenant, quota).inc()


def unlimited(metrics: Metrics) -> Usage:
    """Usage that nothing bounds."""
    return Usage(lambda _: UNLIMITED, metrics)


class _Bucket:
    """Fills at ``rate`` a second up to a burst; may be owed more than it held."""

    def __init__(self, rate: float, now: float) -> None:
        self.rate = rate
        self._most = max(1.0, rate * _BURST_S)
        self._level = self._most
        self._filled_at = now

    def take(self, amount: float, now: float) -> float:
        """0 where the amount was taken, else the seconds until it could be."""
        self._level = min(self._most, self._level + (now - self._filled_at) * self.rate)
        self._filled_at = now
        missing = min(amount, self._most) - self._level
        if missing > _ROUNDING * self._most:
            return missing / self.rate
        self._level -= amount
        return 0.0

    def give_back(self, amount: float) -> None:
        self._level = min(self._most, self._level + amount)
