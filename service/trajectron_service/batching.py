"""The queue before the model: whatever waits is taken at once, by one thread.

Knows neither the model nor transports: ``run`` takes a list and gives a list. There is no
fixed delay: an idle batcher starts at once, and what arrives meanwhile forms the next batch.

- **Order.** Entries of one key (a session) run in the order submitted, one to a batch.
- **Fairness.** Rounds: a key's next entry waits a round after its last one, so that a busy
  session takes turns with the others. Within a round the earliest deadline goes first.
- **Cost.** A batch closes before the entry that would take it beyond ``max_batch_cost``; an
  entry that alone costs more runs alone.
- **Dropping.** Entries that are cancelled or past their deadline never run, and leave their
  place in the queue at once.
- **Bounds.** A full queue refuses at once (``QueueFull``), with an estimate of when to retry.
- **Faults.** When a batch raises, its entries run one by one; only the guilty ones fail.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Generic, TypeVar

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")

_MIN_RETRY_S = 0.05
_MAX_RETRY_S = 10.0
# Weight of the newest batch in the running mean of the time per entry.
_PACE_WEIGHT = 0.2


class QueueFull(Exception):
    """The queue is full; trying again after ``retry_after_s`` is worth it."""

    def __init__(self, retry_after_s: float) -> None:
        super().__init__("the queue is full")
        self.retry_after_s = retry_after_s


class Closed(Exception):
    """The batcher takes no more work."""


class Expired(Exception):
    """The deadline passed before the work was done."""


@dataclass(frozen=True)
class BatchReport:
    """How one batch went: entries in it, how long each waited, how long all ran (seconds)."""

    entries: int
    waited_s: tuple[float, ...]
    ran_s: float


@dataclass(eq=False)
class _Entry(Generic[JobT, ResultT]):
    job: JobT
    cost: float
    deadline: float
    arrival: int
    queued_at: float
    done: asyncio.Future[ResultT]


@dataclass(eq=False)
class _Line(Generic[JobT, ResultT]):
    """The entries of one key, in order, and the round of the first."""

    round: int
    entries: deque[_Entry[JobT, ResultT]] = field(default_factory=deque)


class Batcher(Generic[JobT, ResultT]):
    """Runs jobs in batches on one thread of its own. Use from one event loop.

    Args:
        run: does a batch; results in the order of jobs. It runs on the batcher's thread.
        queue_size: entries that may wait.
        max_batch_cost: see the module.
        clock: seconds, rising; deadlines are on it.
        report: told about every batch, on the event loop.
    """

    def __init__(
        self,
        run: Callable[[list[JobT]], Sequence[ResultT]],
        *,
        queue_size: int,
        max_batch_cost: float,
        clock: Callable[[], float] = time.monotonic,
        report: Callable[[BatchReport], None] = lambda _: None,
    ) -> None:
        self._run = run
        self._queue_size = queue_size
        self._max_batch_cost = max_batch_cost
        self._clock = clock
        self._report = report
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="inference")
        self._lines: dict[Hashable, _Line[JobT, ResultT]] = {}
        self._waiting = 0
        self._round = 0
        self._arrivals = itertools.count()
        self._worker: asyncio.Task[None] | None = None
        self._pace_s = 0.0
        self._closed = False

    @property
    def waiting(self) -> int:
        """Entries that have not begun to run."""
        return self._waiting

    async def submit(
        self, job: JobT, *, key: Hashable = None, cost: float = 1.0, deadline: float | None = None
    ) -> ResultT:
        """The result of ``job``; ``key`` None stands in no line but its own.

        Raises:
            QueueFull, Closed: at once, without waiting.
            Expired: the deadline passed before the job was done.
            Exception: whatever ``run`` raised for this job.
        """
        now = self._clock()
        if self._closed:
            raise Closed("the batcher is closed")
        if deadline is not None and deadline <= now:
            raise Expired("the deadline passed before the work was queued")
        if self._waiting >= self._queue_size:
            raise QueueFull(self._retry_after_s())
        loop = asyncio.get_running_loop()
        entry = _Entry[JobT, ResultT](
            job=job,
            cost=cost,
            deadline=float("inf") if deadline is None else deadline,
            arrival=next(self._arrivals),
            queued_at=now,
            done=loop.create_future(),
        )
        line_key = key if key is not None else entry
        line = self._lines.get(line_key)
        if line is None:
            line = self._lines[line_key] = _Line(self._round)
        line.entries.append(entry)
        self._waiting += 1
        if self._worker is None or self._worker.done():
            self._worker = loop.create_task(self._work(), name="batcher")
        try:
            async with asyncio.timeout(None if deadline is None else deadline - now):
                return await entry.done
        except TimeoutError as error:
            if entry.done.cancelled():
                raise Expired("the deadline passed before the work was done") from error
            raise
        finally:
            if entry.done.cancelled():
                self._forget(line_key, entry)

    async def run_alone(self, call: Callable[[], None]) -> None:
        """Runs something else on the batcher's thread, between batches."""
        await asyncio.get_running_loop().run_in_executor(self._thread, call)

    async def close(self) -> None:
        """Finishes what waits, then ends the thread; further work is refused."""
        self._closed = True
        if self._worker is not None:
            await self._worker
        self._thread.shutdown(wait=False)

    async def _work(self) -> None:
        """Runs batches until nothing waits."""
        # What was submitted in this turn of the loop joins the first batch.
        await asyncio.sleep(0)
        while self._waiting:
            batch = self._take()
            if batch:
                await self._do(batch)

    def _take(self) -> list[_Entry[JobT, ResultT]]:
        """Takes the next batch off the queue and drops what need not run."""
        now = self._clock()
        for line in self._lines.values():
            self._drop_dead(line, now)
        ready = sorted(
            (line for line in self._lines.values() if line.entries),
            key=lambda line: (line.round, line.entries[0].deadline, line.entries[0].arrival),
        )
        batch: list[_Entry[JobT, ResultT]] = []
        cost = 0.0
        for line in ready:
            cost += line.entries[0].cost
            if batch and cost > self._max_batch_cost:
                break
            self._round = max(self._round, line.round)
            line.round = self._round + 1
            batch.append(line.entries.popleft())
        self._waiting -= len(batch)
        self._lines = {key: line for key, line in self._lines.items() if line.entries}
        return batch

    def _drop_dead(self, line: _Line[JobT, ResultT], now: float) -> None:
        alive = deque(e for e in line.entries if not e.done.done() and e.deadline > now)
        for entry in line.entries:
            if not entry.done.done() and entry.deadline <= now:
                entry.done.set_exception(Expired("the deadline passed in the queue"))
        self._waiting -= len(line.entries) - len(alive)
        line.entries = alive

    def _forget(self, key: Hashable, entry: _Entry[JobT, ResultT]) -> None:
        """Frees the place of an entry, unless a batch has taken or dropped it."""
        line = self._lines.get(key)
        if line is None or entry not in line.entries:
            return
        line.entries.remove(entry)
        self._waiting -= 1
        if not line.entries:
            del self._lines[key]

    async def _do(self, batch: list[_Entry[JobT, ResultT]]) -> None:
        start = self._clock()
        try:
            results = await self._on_thread([entry.job for entry in batch])
        except Exception as error:  # noqa: BLE001 - whatever run raises belongs to its callers
            await self._do_singly(batch, error)
        else:
            for entry, result in zip(batch, results, strict=True):
                if not entry.done.done():
                    entry.done.set_result(result)
        ran_s = self._clock() - start
        pace_s = ran_s / len(batch)
        self._pace_s += _PACE_WEIGHT * (pace_s - self._pace_s)
        waited_s = tuple(start - entry.queued_at for entry in batch)
        self._report(BatchReport(len(batch), waited_s, ran_s))

    async def _do_singly(self, batch: list[_Entry[JobT, ResultT]], error: Exception) -> None:
        """Finds the entries that a failed batch failed for."""
        for entry in batch:
            if entry.done.done():
                continue
            if len(batch) > 1:
                try:
                    (result,) = await self._on_thread([entry.job])
                except Exception as own:  # noqa: BLE001 - as above
                    fault = own
                else:
                    if not entry.done.done():
                        entry.done.set_result(result)
                    continue
            else:
                fault = error
            if not entry.done.done():
                entry.done.set_exception(fault)

    async def _on_thread(self, jobs: list[JobT]) -> Sequence[ResultT]:
        loop = asyncio.get_running_loop()
        results = await loop.run_in_executor(self._thread, self._run, jobs)
        if len(results) != len(jobs):
            raise RuntimeError(f"{len(jobs)} jobs gave {len(results)} results")
        return results

    def _retry_after_s(self) -> float:
        return min(max(self._waiting * self._pace_s, _MIN_RETRY_S), _MAX_RETRY_S)
