"""The evaluations of a service: each carried out in its turn, its record written first."""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
from collections.abc import Callable, Coroutine, Iterator
from functools import partial
from typing import Any, TypeVar

from trajectron_service import logs
from trajectron_service.errors import ServiceError
from trajectron_service.evaluations.archive import Archive
from trajectron_service.evaluations.background import Background
from trajectron_service.evaluations.messages import (
    EvaluationInfo,
    EvaluationProgress,
    EvaluationState,
)
from trajectron_service.evaluations.requests import EvaluationChoices
from trajectron_service.evaluations.running import FailedError, carry_out
from trajectron_service.evaluations.store import StoredEvaluation
from trajectron_service.metrics import Metrics

T = TypeVar("T")

log = logs.get(__name__)


class Job:
    """An evaluation in memory.

    Attributes:
        stored: as it is in the store, but for its progress.
        changed: set, and replaced, whenever something has changed.
        task: what carries it out, None while nothing does.
        halted: never to be started (again).
        removed: deleted, or about to be; whoever still holds it sees that.
    """

    def __init__(self, stored: StoredEvaluation) -> None:
        self.stored = stored
        self.changed = asyncio.Event()
        self.task: asyncio.Task[None] | None = None
        self.halted = False
        self.removed = False

    @property
    def info(self) -> EvaluationInfo:
        """The evaluation as clients see it."""
        return self.stored.info

    @property
    def state(self) -> EvaluationState:
        """Where it is in its life."""
        return self.stored.info.state

    def tell(self) -> None:
        """Wakes everybody who watches."""
        self.changed.set()
        self.changed = asyncio.Event()

    @property
    def waits(self) -> bool:
        """Whether it is to be started, in its turn."""
        return self.state is EvaluationState.QUEUED and self.task is None and not self.halted


class EvaluationQueue:
    """Every evaluation that is kept, and what carries them out.

    Args:
        archive: where they are kept.
        choices: knows where the data set is.
        background: how their processes run.
        at_once: how many run at the same time.
        metrics: told about everything.
        clock: Unix seconds.
    """

    def __init__(
        self,
        archive: Archive,
        choices: EvaluationChoices,
        background: Background,
        at_once: int,
        metrics: Metrics,
        clock: Callable[[], float],
    ) -> None:
        self._archive = archive
        self._choices = choices
        self._background = background
        self._at_once = at_once
        self._metrics = metrics
        self._clock = clock
        self._jobs: dict[tuple[str, str], Job] = {}  # by tenant and id
        self._numbers = itertools.count(1)
        self._running: set[Job] = set()
        self._finishing: set[asyncio.Task[Any]] = set()
        self._closing = False

    def __len__(self) -> int:
        return len(self._jobs)

    def __iter__(self) -> Iterator[Job]:
        return (job for job in self._jobs.values() if not job.removed)

    def of(self, tenant: str) -> Iterator[Job]:
        """The evaluations of one tenant."""
        return (job for job in self if job.stored.tenant == tenant)

    def get(self, tenant: str, identity: str) -> Job | None:
        """A tenant's evaluation by its id, None when there is none."""
        job = self._jobs.get((tenant, identity))
        return None if job is None or job.removed else job

    def has_record(self, tenant: str, identity: str) -> bool:
        """Whether a tenant's id is taken, if only by an evaluation that is about to be deleted."""
        return (tenant, identity) in self._jobs

    @property
    def waiting(self) -> int:
        """How many wait for their turn."""
        return sum(job.waits for job in self)

    def take_number(self) -> int:
        """A number for a new evaluation: nobody else gets it, even if nothing comes of it."""
        return next(self._numbers)

    async def start(self) -> None:
        """Takes up what was queued or running when the service ended.

        Raises:
            StoreError: the records are damaged.
        """
        for stored in await self._archive.load():
            self._jobs[stored.tenant, stored.info.id] = Job(_queued_again(stored))
        last = max((job.stored.number for job in self), default=0)
        self._numbers = itertools.count(last + 1)
        for state in EvaluationState:
            gauge = self._metrics.evaluations.labels(state.value)
            gauge.set_function(partial(self._count, state))
        self._pump()

    async def close(self) -> None:
        """Ends what runs, to be taken up at the next start; what is being written is written."""
        self._closing = True
        running = [job.task for job in self._running if job.task is not None]
        for task in running:
            task.cancel()
        await asyncio.gather(*running, *self._finishing, return_exceptions=True)

    async def add(self, stored: StoredEvaluation) -> None:
        """Queues an evaluation whose files are there."""
        await self.whole(self._add(stored))

    async def _add(self, stored: StoredEvaluation) -> None:
        await self._archive.add(stored)
        self._jobs[stored.tenant, stored.info.id] = Job(stored)
        self._pump()

    async def cancel(self, job: Job) -> None:
        """Ends an evaluation; one that has ended stays as it is."""
        if not job.state.ended:
            await self.whole(self._cancel(job))

    async def _cancel(self, job: Job) -> None:
        await self._halt(job)
        if not job.state.ended:
            await self._finish(job, EvaluationState.CANCELLED)

    async def remove(self, job: Job) -> None:
        """Removes an evaluation, ends it, and removes its files.

        One whose record cannot be removed stays, and goes on.
        """
        job.removed = True
        await self.whole(self._remove(job))

    async def _remove(self, job: Job) -> None:
        try:
            await self._archive.remove_record(job.stored)
            del self._jobs[job.stored.tenant, job.info.id]
        except BaseException:
            job.removed = False
            self._pump()  # it may have been passed over meanwhile
            raise
        finally:
            job.tell()
        await self._halt(job)
        await self._archive.remove_files(job.stored)

    async def whole(self, work: Coroutine[Any, Any, T]) -> T:
        """Does some work to its end; who is cancelled meanwhile goes no sooner than that."""
        task = asyncio.create_task(work)
        self._finishing.add(task)
        task.add_done_callback(self._finishing.discard)
        cancelled: asyncio.CancelledError | None = None
        while not task.done():
            try:
                await asyncio.wait({task})
            except asyncio.CancelledError as error:
                cancelled = error
        result = task.result()
        if cancelled is not None:
            raise cancelled
        return result

    def _pump(self) -> None:
        """Starts what may run, the oldest first."""
        if self._closing:
            return
        waiting = (job for job in self if job.waits)
        for job in sorted(waiting, key=lambda job: job.stored.number):
            if len(self._running) >= self._at_once:
                return
            job.task = asyncio.create_task(self._run(job), name=f"evaluation {job.info.id}")
            self._running.add(job)
            job.task.add_done_callback(partial(self._ended, job))

    async def _run(self, job: Job) -> None:
        """Carries an evaluation out; what is cancelled here can be taken up again."""
        started_at = job.info.started_at or self._clock()
        await self._change(job, state=EvaluationState.RUNNING, started_at=started_at)
        try:
            data = self._choices.data_folder if job.info.config.dataset else None
            folder = self._archive.folder(job.stored.number)
            await carry_out(folder, data, self._background, lambda far: _note(job, far))
        except (FailedError, ServiceError) as error:
            await self._finish(job, EvaluationState.FAILED, error=str(error))
        except Exception:
            log.exception("fault", evaluation=job.info.id)
            reason = "a fault of the service; its log has more"
            await self._finish(job, EvaluationState.FAILED, error=reason)
        else:
            done = dataclasses.replace(job.info.progress, share=1.0, seconds_left=0.0)
            await self._finish(job, EvaluationState.SUCCEEDED, progress=done)

    def _ended(self, job: Job, task: asyncio.Task[None]) -> None:
        self._running.discard(job)
        job.task = None
        fault = None if task.cancelled() else task.exception()
        if fault is not None:
            # Its record says that it runs: the next start takes it up.
            log.error("fault", evaluation=job.info.id, exc_info=fault)
            job.halted = True
        self._pump()

    async def _finish(self, job: Job, state: EvaluationState, **changes: Any) -> None:
        """Writes how an evaluation has ended."""
        ended_at = self._clock()
        await self._change(job, state=state, ended_at=ended_at, **changes)
        if job.info.started_at is not None:
            duration_s = ended_at - job.info.started_at
            self._metrics.evaluation_seconds.labels(state.value).observe(duration_s)

    async def _change(self, job: Job, **changes: Any) -> None:
        """Changes an evaluation: in the store first, so that nobody sees what may be lost."""
        stored = dataclasses.replace(job.stored, info=dataclasses.replace(job.info, **changes))
        await self._archive.change(stored)
        job.stored = stored
        log.info("evaluation", id=job.info.id, state=job.state.value, error=job.info.error)
        job.tell()

    async def _halt(self, job: Job) -> None:
        """Ends what carries an evaluation out, for good."""
        job.halted = True
        if job.task is not None:
            job.task.cancel()
            await asyncio.wait({job.task})

    def _count(self, state: EvaluationState) -> float:
        return sum(job.state is state for job in self)


def _note(job: Job, progress: EvaluationProgress) -> None:
    info = dataclasses.replace(job.info, progress=progress)
    job.stored = dataclasses.replace(job.stored, info=info)
    job.tell()


def _queued_again(stored: StoredEvaluation) -> StoredEvaluation:
    """What ran when the service ended has to be taken up."""
    if stored.info.state.ended:
        return stored
    info = dataclasses.replace(stored.info, state=EvaluationState.QUEUED)
    return dataclasses.replace(stored, info=info)
