"""The work in hand: counted, so that the service can finish it, and refused while it drains."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.metrics import Metrics


class WorkInHand:
    """Counts the calls and streams being worked on; used inside one event loop.

    Args:
        metrics: told what is refused.
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._count = 0
        self._draining = False
        self._idle = asyncio.Event()
        self._idle.set()

    @property
    def count(self) -> int:
        """How much there is."""
        return self._count

    @property
    def draining(self) -> bool:
        """Whether no more is taken."""
        return self._draining

    def drain(self) -> None:
        """Refuses all work from now on; there is no way back."""
        self._draining = True

    async def finished(self) -> None:
        """Returns when nothing is in hand."""
        await self._idle.wait()

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Counts what is done inside as work in hand; refuses it while draining."""
        if self._draining:
            error = stopping()
            self._metrics.refusals.labels(error.kind.value).inc()
            raise error
        self._count += 1
        self._idle.clear()
        try:
            yield
        except ServiceError as error:
            self._metrics.refusals.labels(error.kind.value).inc()
            raise
        finally:
            self._count -= 1
            if not self._count:
                self._idle.set()


def stopping() -> ServiceError:
    """The refusal of work while the service drains."""
    return ServiceError(
        ErrorKind.DRAINING,
        "the service is stopping; another replica may answer",
        retry_after_s=1.0,
    )
