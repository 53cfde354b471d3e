"""The queue before the model: whatever waits is taken at once, by one thread.

Knows neither the model nor transports: ``run`` takes a list and gives a list. There is no
fixed delay: an idle batcher starts at once, and what arrives meanwhile forms the next batch.

- **Order.** Entries of one key (a session) run in the order submitted, one to a batch.
- **Fairness.** Rounds: a key's next entry waits a round after its last one, so that a busy
  session takes turns with the others. Within a round the earliest deadline goes first; urgent
  entries (frames to observe) go before all others.
- **Cost.** A batch closes before the entry that would take it beyond ``max_batch_cost``, or
  beyond ``batch_s`` by what is known of the pace; an entry that alone costs more runs alone.
- **Slices.** Long work comes in parts. A batch has room for one part beside the short work, so
  neither waits for the other. A long entry that has begun is finished before the next one
  begins, or all would end late; unless the other cannot wait and this one can.
- **Dropping.** Entries that are cancelled, past their deadline or sure to miss it never run (no
  further part of them does), and leave their place in the queue at once.
- **Bounds.** A full queue refuses at once (``QueueFull``), with an estimate of when to retry. So
  does one that would be too slow for a deadline (``TooLate``).
- **Faults.** When a batch raises, its entries run one by one; only the guilty ones fail.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from trajectron_service.pace import Pace, Work

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")

_MIN_RETRY_S = 0.05
_MAX_RETRY_S = 10.0
_NEVER = float("inf")
_ONE = Work(jobs=1.0)


class QueueFull(Exception):
    """The queue is full; trying again after ``retry_after_s`` is worth it."""

    def __init__(self, retry_after_s: float) -> None:
        super().__init__("the queue is full")
        self.retry_after_s = retry_after_s


class TooLate(Exception):
    """The work would not be done by its deadline, so it is not begun.

    Attributes:
        queue_s: seconds until what goes before it is done.
        own_s: seconds of the work itself.
        left_s: seconds until the deadline.
    """

    def __init__(self, queue_s: float, own_s: float, left_s: float) -> None:
        super().__init__(
            f"about {(queue_s + own_s) * 1e3:.0f} ms are needed ({queue_s * 1e3:.0f} ms of them "
            f"until other work is done), {left_s * 1e3:.0f} ms are left"
        )
        self.queue_s = queue_s
        self.own_s = own_s
        self.left_s = left_s


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


@dataclass(frozen=True)
class Part(Generic[JobT]):
    """Work that runs in one go: what to do, its cost against a batch's limit, its amounts."""

    job: JobT
    cost: float = 1.0
    work: Work = _ONE


@dataclass(eq=False)
class _Entry(Generic[JobT, ResultT]):
    parts: deque[Part[JobT]]  # not begun
    deadline: float
    urgent: bool
    arrival: int
    queued_at: float
    done: asyncio.Future[list[ResultT]]
    long: bool
    results: list[ResultT] = field(default_factory=list)
    started: bool = False


@dataclass(eq=False)
class _Line(Generic[JobT, ResultT]):
    """The entries of one key, in order, and the round of the first."""

    round: int
    entries: deque[_Entry[JobT, ResultT]] = field(default_factory=deque)


# An entry with the part of it that a batch runs.
_Taken = tuple[_Entry[JobT, ResultT], Part[JobT]]


class Batcher(Generic[JobT, ResultT]):
    """Runs jobs in batches on one thread of its own. Use from one event loop.

    Args:
        run: does a batch; results in the order of jobs. It runs on the batcher's thread.
        queue_size: entries that may wait.
        max_batch_cost: see the module.
        batch_s: seconds that a batch should take at most.
        pace: what is known of how long work takes; it learns here.
        clock: seconds, rising; deadlines are on it.
        report: told about every batch, on the event loop.
    """

    def __init__(
        self,
        run: Callable[[list[JobT]], Sequence[ResultT]],
        *,
        queue_size: int,
        max_batch_cost: float,
        batch_s: float = _NEVER,
        pace: Pace | None = None,
        clock: Callable[[], float] = time.monotonic,
        report: Callable[[BatchReport], None] = lambda _: None,
    ) -> None:
        self.pace = pace or Pace()
        self._run = run
        self._queue_size = queue_size
        self._max_batch_cost = max_batch_cost
        self._batch_s = batch_s
        self._clock = clock
        self._report = report
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="inference")
        self._lines: dict[Hashable, _Line[JobT, ResultT]] = {}
        self._waiting = 0
        self._round = 0
        self._arrivals = itertools.count()
        self._worker: asyncio.Task[None] | None = None
        self._begun: _Entry[JobT, ResultT] | None = None  # the long entry at work
        self._busy_until = 0.0
        self._closed = False

    @property
    def waiting(self) -> int:
        """Entries that have not begun to run."""
        return self._waiting

    async def submit(
        self,
        job: JobT,
        *,
        key: Hashable = None,
        cost: float = 1.0,
        work: Work = _ONE,
        deadline: float | None = None,
        urgent: bool = False,
    ) -> ResultT:
        """The result of ``job``; see ``submit_parts``."""
        (result,) = await self.submit_parts(
            [Part(job, cost, work)], key=key, deadline=deadline, urgent=urgent
        )
        return result

    async def submit_parts(
        self,
        parts: Sequence[Part[JobT]],
        *,
        key: Hashable = None,
        deadline: float | None = None,
        urgent: bool = False,
        finish: bool = False,
    ) -> list[ResultT]:
        """The results of parts of one piece of work, in order; several make it long work.

        Args:
            parts: at least one.
            key: None stands in no line but its own.
            deadline: on the batcher's clock.
            urgent: goes before all that is not.
            finish: once begun it is done to the end, and its results come late rather than not.

        Raises:
            QueueFull, TooLate, Closed: at once, without waiting; TooLate also when other work
                has taken the time that there was.
            Expired: the deadline passed before the work was done.
            Exception: whatever ``run`` raised for this work.
        """
        entry = self._enqueue(parts, key, _NEVER if deadline is None else deadline, urgent)
        line_key = key if key is not None else entry
        left_s = None if deadline is None else deadline - entry.queued_at
        try:
            if finish:
                return await _finished(entry, left_s)
            async with asyncio.timeout(left_s):
                return await entry.done
        except TimeoutError:
            if entry.done.cancelled():
                raise Expired("the deadline passed before the work was done") from None
            raise
        finally:
            if entry.done.cancelled():
                self._forget(line_key, entry)
            # An exception holds this frame, and the entry holds the exception: without this
            # only the cyclic collector could free them.
            del entry, line_key

    def _enqueue(
        self, parts: Sequence[Part[JobT]], key: Hashable, deadline: float, urgent: bool
    ) -> _Entry[JobT, ResultT]:
        """Puts work into its line, unless it is refused."""
        now = self._clock()
        if self._closed:
            raise Closed("the batcher is closed")
        if deadline <= now:
            raise Expired("the deadline passed before the work was queued")
        if self._waiting >= self._queue_size:
            raise QueueFull(self._retry_after_s())
        self.check(parts, deadline=deadline)
        loop = asyncio.get_running_loop()
        entry = _Entry[JobT, ResultT](
            parts=deque(parts),
            deadline=deadline,
            urgent=urgent,
            arrival=next(self._arrivals),
            queued_at=now,
            done=loop.create_future(),
            long=len(parts) > 1,
        )
        line_key = key if key is not None else entry
        line = self._lines.get(line_key)
        if line is None:
            line = self._lines[line_key] = _Line(self._round)
        line.entries.append(entry)
        self._waiting += 1
        if self._worker is None or self._worker.done():
            self._worker = loop.create_task(self._work(), name="batcher")
        return entry

    def check(self, parts: Sequence[Part[JobT]], *, deadline: float | None) -> None:
        """Raises TooLate for work that would not be done by its deadline."""
        late = self.late(parts, deadline=deadline)
        if late is not None:
            if late.own_s > late.left_s:
                self.pace.doubt(parts[0].work)
            raise late

    def late(self, parts: Sequence[Part[JobT]], *, deadline: float | None) -> TooLate | None:
        """Why work would not be done by its deadline; None if it would."""
        if deadline is None or deadline == _NEVER:
            return None
        left_s = deadline - self._clock()
        own_s = self.pace.batch_s + self._seconds(parts)
        queue_s = self.queue_s(deadline)
        return TooLate(queue_s, own_s, left_s) if queue_s + own_s > left_s else None

    def queue_s(self, deadline: float) -> float:
        """Seconds until what goes before work with this deadline is done."""
        ahead_s = max(self._busy_until - self._clock(), 0.0)
        for line in self._lines.values():
            for entry in line.entries:
                if entry.urgent or entry.deadline <= deadline or entry is self._begun:
                    ahead_s += self._seconds(entry.parts)
        return ahead_s

    async def run_alone(self, call: Callable[[], None]) -> None:
        """Runs something else on the batcher's thread, between batches."""
        await asyncio.get_running_loop().run_in_executor(self._thread, call)

    async def close(self) -> None:
        """Finishes what waits, then ends the thread; further work is refused."""
        self._closed = True
        if self._worker is not None:
            await self._worker
        self._thread.shutdown(wait=False)

    def _seconds(self, parts: Iterable[Part[JobT]]) -> float:
        return sum(self.pace.seconds(part.work) for part in parts)

    async def _work(self) -> None:
        """Runs batches until nothing waits."""
        # What was submitted in this turn of the loop joins the first batch.
        await asyncio.sleep(0)
        while self._lines:
            batch = self._take()
            if batch:
                await self._do(batch)

    def _take(self) -> list[_Taken[JobT, ResultT]]:
        """Takes the next batch off the queue and drops what need not run."""
        now = self._clock()
        for line in self._lines.values():
            self._drop_dead(line, now)
        ready = [line for line in self._lines.values() if line.entries]
        ready.sort(key=_turn)
        long = self._next_long([line for line in ready if line.entries[0].long], now)
        chosen: list[_Line[JobT, ResultT]] = []
        cost = seconds = 0.0
        for line in ready:
            if line.entries[0].long:
                continue
            part = line.entries[0].parts[0]
            cost += part.cost
            seconds += self.pace.seconds(part.work)
            if chosen and (cost > self._max_batch_cost or seconds > self._batch_s):
                break
            chosen.append(line)
        if long is not None:
            chosen.append(long)
        batch = [self._taken(line) for line in chosen]
        self._lines = {key: line for key, line in self._lines.items() if line.entries}
        return batch

    def _next_long(
        self, lines: Sequence[_Line[JobT, ResultT]], now: float
    ) -> _Line[JobT, ResultT] | None:
        """Whose long entry goes on: the one begun, unless a more pressing one cannot wait."""
        if not lines:
            self._begun = None
            return None
        first = lines[0]
        begun = next((line for line in lines if line.entries[0] is self._begun), first)
        if begun is not first:
            ours_s = self._seconds(begun.entries[0].parts)
            other = first.entries[0]
            both = now + ours_s + self._seconds(other.parts)
            if both > other.deadline and both <= begun.entries[0].deadline:
                begun = first
        self._begun = begun.entries[0]
        return begun

    def _taken(self, line: _Line[JobT, ResultT]) -> _Taken[JobT, ResultT]:
        """The next part of a line's first entry, which leaves the line with its last part."""
        entry = line.entries[0]
        part = entry.parts.popleft()
        self._waiting -= not entry.started
        entry.started = True
        if not entry.parts:
            if entry is self._begun:
                self._begun = None
            line.entries.popleft()
            self._round = max(self._round, line.round)
            line.round = self._round + 1
        return entry, part

    def _drop_dead(self, line: _Line[JobT, ResultT], now: float) -> None:
        """Drops entries that nobody waits for, or that come too late whatever is done."""
        alive: deque[_Entry[JobT, ResultT]] = deque()
        for entry in line.entries:
            if not entry.done.done() and entry.deadline < _NEVER:
                own_s = self._seconds(entry.parts)
                left_s = entry.deadline - now
                if left_s <= 0.0:
                    entry.done.set_exception(Expired("the deadline passed in the queue"))
                elif own_s > left_s:
                    entry.done.set_exception(TooLate(0.0, own_s, left_s))
            if entry.done.done():
                self._waiting -= not entry.started
            else:
                alive.append(entry)
        line.entries = alive

    def _forget(self, key: Hashable, entry: _Entry[JobT, ResultT]) -> None:
        """Frees the place of an entry, unless a batch has taken or dropped it."""
        line = self._lines.get(key)
        if line is None or entry not in line.entries:
            return
        line.entries.remove(entry)
        self._waiting -= not entry.started
        if not line.entries:
            del self._lines[key]

    async def _do(self, batch: list[_Taken[JobT, ResultT]]) -> None:
        start = self._clock()
        works = [part.work for _, part in batch]
        self._busy_until = start + self.pace.batch_s + sum(map(self.pace.seconds, works))
        try:
            results = await self._on_thread([part.job for _, part in batch])
        except Exception as error:  # noqa: BLE001 - whatever run raises belongs to its callers
            await self._do_singly(batch, error)
        else:
            self.pace.learn(works, self._clock() - start)
            for (entry, _), result in zip(batch, results, strict=True):
                _put(entry, result)
        self._busy_until = 0.0
        waited_s = tuple(start - entry.queued_at for entry, _ in batch)
        self._report(BatchReport(len(batch), waited_s, self._clock() - start))

    async def _do_singly(self, batch: list[_Taken[JobT, ResultT]], error: Exception) -> None:
        """Finds the entries that a failed batch failed for."""
        for entry, part in batch:
            if entry.done.done():
                continue
            fault = error
            if len(batch) > 1:
                try:
                    (result,) = await self._on_thread([part.job])
                except Exception as own:  # noqa: BLE001 - as above
                    fault = own
                else:
                    _put(entry, result)
                    continue
            if not entry.done.done():
                entry.done.set_exception(fault)
            # It holds this frame: see ``submit_parts``.
            del fault

    async def _on_thread(self, jobs: list[JobT]) -> Sequence[ResultT]:
        loop = asyncio.get_running_loop()
        results = await loop.run_in_executor(self._thread, self._run, jobs)
        if len(results) != len(jobs):
            raise RuntimeError(f"{len(jobs)} jobs gave {len(results)} results")
        return results

    def _retry_after_s(self) -> float:
        return min(max(self.queue_s(_NEVER), _MIN_RETRY_S), _MAX_RETRY_S)


def _turn(line: _Line[JobT, ResultT]) -> tuple[bool, int, float, int]:
    """The place of a line in the order of the queue."""
    first = line.entries[0]
    return (not first.urgent, line.round, first.deadline, first.arrival)


async def _finished(entry: _Entry[JobT, ResultT], left_s: float | None) -> list[ResultT]:
    """The results of an entry that begins in time, however long it then takes."""
    try:
        await asyncio.wait({entry.done}, timeout=left_s)
        if entry.started or entry.done.done():
            return await entry.done
    except asyncio.CancelledError:
        entry.done.cancel()
        raise
    entry.done.cancel()
    raise Expired("the deadline passed in the queue")


def _put(entry: _Entry[JobT, ResultT], result: ResultT) -> None:
    """Takes a part's result; the last one answers the entry."""
    entry.results.append(result)
    if not entry.parts and not entry.done.done():
        entry.done.set_result(entry.results)
