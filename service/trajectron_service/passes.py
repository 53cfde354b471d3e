"""What a call was let in by, for as long as it goes on: a stream ends when its token does.

The gate (``admission``) hands each call a pass, and asks all passes again whenever its tokens
may have changed. A call that answers once has a pass, and is not asked again.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import aclosing, asynccontextmanager
from contextvars import ContextVar
from typing import TypeVar

from trajectron_service.errors import ServiceError

AnswerT = TypeVar("AnswerT")


class Pass:
    """Lets one call go on.

    Args:
        fault: why it would be refused now, None while it would not.
    """

    def __init__(self, fault: Callable[[], ServiceError | None]) -> None:
        self._fault = fault
        self._refusal: ServiceError | None = None
        self._waits: set[asyncio.Timeout] = set()

    def check(self) -> bool:
        """Ends what goes on under this pass if it is not good any more; whether that has ended it.

        What has been refused once stays so.
        """
        if self._refusal is not None:
            return False
        self._refusal = self._fault()
        if self._refusal is None:
            return False
        now = asyncio.get_running_loop().time()
        for wait in self._waits:
            wait.reschedule(now)
        return bool(self._waits)

    async def guard(self, answers: AsyncGenerator[AnswerT, None]) -> AsyncGenerator[AnswerT, None]:
        """The same answers, until the pass is not good any more: then its ``ServiceError``."""
        async with aclosing(answers):
            while True:
                # Interrupted while it waits for an answer, never while one is being sent.
                async with self._wait():
                    try:
                        answer = await anext(answers)
                    except StopAsyncIteration:
                        return
                yield answer

    @asynccontextmanager
    async def _wait(self) -> AsyncIterator[None]:
        if self._refusal is not None:
            raise self._refusal
        try:
            async with asyncio.timeout(None) as wait:
                self._waits.add(wait)
                try:
                    yield
                finally:
                    self._waits.discard(wait)
        except TimeoutError:
            if not wait.expired():
                raise  # of what it waited for
            raise self._told() from None

    def _told(self) -> ServiceError:
        assert self._refusal is not None  # nothing else ends a wait
        return self._refusal


_current: ContextVar[Pass | None] = ContextVar("pass", default=None)


def enter(held: Pass) -> None:
    """The rest of the running task was let in by this pass."""
    _current.set(held)


def while_good(answers: AsyncGenerator[AnswerT, None]) -> AsyncGenerator[AnswerT, None]:
    """The answers for as long as the pass of the running task is good; all where it has none."""
    held = _current.get()
    return answers if held is None else held.guard(answers)
