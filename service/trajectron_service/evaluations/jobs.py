"""The use cases of batch evaluations: create, get, list, watch, cancel, delete, result.

Everything raised here is a ``ServiceError``. What has been acknowledged is in the archive; how
far a running evaluation is, is known in memory only, and found again from its shards.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Iterator, Sequence
from contextlib import ExitStack

from trajectron_service import pages, tenancy
from trajectron_service.errors import ErrorKind, ServiceError, invalid
from trajectron_service.evaluations.archive import Archive, ArchiveError
from trajectron_service.evaluations.background import Background
from trajectron_service.evaluations.messages import (
    EvaluationConfig,
    EvaluationInfo,
    EvaluationResult,
    EvaluationState,
    RecordingFile,
    ResultFormat,
)
from trajectron_service.evaluations.queue import EvaluationQueue, Job
from trajectron_service.evaluations.requests import (
    EvaluationChoices,
    digest,
    evaluation_id,
    served_files,
)
from trajectron_service.evaluations.running import check_recordings
from trajectron_service.evaluations.store import StoredEvaluation, StoreError
from trajectron_service.metrics import Metrics
from trajectron_service.quotas import Limit, Usage, unlimited
from trajectron_service.settings import Settings, SettingsError
from trajectron_service.validation import quoted, text_fault
from trajectron_service.work import WorkInHand, stopping

# Where the queue is full, an evaluation is ahead: they take minutes.
_RETRY_AFTER_S = 30.0


class Evaluations:
    """Batch evaluations; made and used inside one event loop.

    Args:
        settings: limits and defaults; the archive's folder.
        metrics: told about everything.
        work: counts the calls, and refuses them while the service drains.
        usage: how many a tenant may have; as many as there are where None.
        clock: Unix seconds.

    Raises:
        SettingsError: the archive's folder cannot be used.
        CheckpointError: a model that is to be served is not there.
    """

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        work: WorkInHand,
        *,
        usage: Usage | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._settings = settings
        self._usage = usage or unlimited(metrics)
        self._work = work
        self._clock = clock
        self._choices = EvaluationChoices(settings, served_files(settings))
        self._background = Background(settings.evaluation_priority, settings.evaluation_threads)
        try:
            self._archive = Archive(settings.state_dir)
        except (ArchiveError, StoreError) as error:
            raise SettingsError(f"state_dir: {error}") from error
        self._queue = EvaluationQueue(
            self._archive,
            self._choices,
            self._background,
            settings.evaluations_at_once,
            metrics,
            clock,
        )
        # Recordings are read one request after the other.
        self._entrance = asyncio.Lock()
        # Before the start nobody knows which ids and numbers are taken.
        self._started = asyncio.Event()
        self._entering: Counter[str] = Counter()  # by tenant

    async def start(self) -> None:
        """Takes up what was queued or running when the service ended.

        Raises:
            SettingsError: the records are damaged.
        """
        try:
            await self._queue.start()
        except StoreError as error:
            raise SettingsError(f"state_dir: {error}") from error
        self._started.set()

    def begin_drain(self) -> None:
        """Ends what watches; the work in hand refuses all else."""
        self._work.drain()
        for job in self._queue:
            job.tell()

    async def close(self) -> None:
        """Ends what runs, to be taken up at the next start, and closes the archive."""
        self.begin_drain()
        # Whoever was cut off while entering has files to remove.
        async with self._entrance:
            await self._queue.close()
            await self._archive.close()

    async def create(
        self,
        wanted_id: str,
        config: EvaluationConfig,
        files: Sequence[RecordingFile],
        request_id: str,
    ) -> EvaluationInfo:
        """Queues an evaluation.

        Args:
            wanted_id: assigned when empty.
            config: what is judged, on what, and how.
            files: recordings to judge on, in place of a data set.
            request_id: sent again with the same request it gives the same evaluation.
        """
        with self._work.taken():
            if request_id and (fault := text_fault(request_id, "a request id")):
                raise invalid("request_id", fault)
            resolved = self._choices.resolve(config, files)
            # Off the loop: a request may bring megabytes.
            sha256 = await asyncio.to_thread(digest, wanted_id, resolved, files)
            blank = EvaluationInfo(
                evaluation_id(wanted_id),
                resolved,
                tuple(file.name for file in files),
                EvaluationState.QUEUED,
                self._clock(),
            )
            before = self._of_request(request_id, sha256)
            if before is not None:
                return before
            self._check_room()
            self._entering[tenancy.current()] += 1
            try:
                await self._started.wait()
                async with self._entrance:
                    return await self._enter(blank, files, request_id, sha256)
            except TimeoutError:
                raise ServiceError(
                    ErrorKind.DEADLINE_EXCEEDED,
                    "the recordings could not be read in time; send fewer at a time",
                ) from None
            finally:
                self._entering[tenancy.current()] -= 1

    async def _enter(
        self, info: EvaluationInfo, files: Sequence[RecordingFile], request_id: str, sha256: str
    ) -> EvaluationInfo:
        """Lays down the files of an evaluation, and then queues it."""
        before = self._of_request(request_id, sha256)
        if before is not None:
            return before
        if self._queue.has_record(tenancy.current(), info.id):
            raise ServiceError(
                ErrorKind.EVALUATION_EXISTS, f"evaluation_id: {quoted(info.id)} is taken"
            )
        stored = StoredEvaluation(
            self._queue.take_number(), tenancy.current(), info, request_id, sha256
        )
        try:
            async with asyncio.timeout(self._settings.request_timeout_s):
                await self._lay_down(stored, files)
        except BaseException:
            await self._queue.whole(self._archive.remove_files(stored))
            raise
        await self._queue.add(stored)
        return info

    async def _lay_down(self, stored: StoredEvaluation, files: Sequence[RecordingFile]) -> None:
        """Writes all that an evaluation needs, and sees whether its recordings can be read."""
        folder, info = self._archive.folder(stored.number), stored.info
        plan = self._choices.plan(info.config, info.files).to_json()
        models = self._choices.model_files(info.config)
        await self._queue.whole(asyncio.to_thread(folder.fill, plan, files, models))
        if files:
            frames_per_step = info.config.frames_per_step
            assert frames_per_step is not None  # resolved
            await check_recordings(folder, info.files, frames_per_step, self._background)

    async def get(self, identity: str) -> EvaluationInfo:
        """An evaluation as it is now."""
        with self._work.taken():
            return self._job(identity).info

    async def list_page(
        self, page_size: int | None, page_token: str
    ) -> tuple[tuple[EvaluationInfo, ...], str]:
        """Evaluations, the newest first, and the token of the next page, empty on the last."""
        with self._work.taken():
            size = pages.size(page_size)
            after = _read_place(page_token)
            infos = sorted((job.info for job in self._own()), key=_place)
            older = [info for info in infos if after is None or _place(info) > after]
            page = older[:size]
            token = _write_place(_place(page[-1])) if len(older) > size else ""
            return tuple(page), token

    async def watch(self, identity: str) -> AsyncGenerator[EvaluationInfo, None]:
        """An evaluation as it is now, and again whenever it has changed, until it has ended.

        What changes twice before it is asked for is given once.
        """
        with ExitStack() as counted:
            with self._work.taken():
                job = self._job(identity)
                counted.enter_context(self._usage.stream(object()))
            while True:
                # Read before it is given: it may change while a slow reader takes its time.
                changed, info = job.changed, job.info
                if job.removed:
                    raise _unknown(identity)
                yield info
                if info.state.ended:
                    return
                if self._work.draining:
                    raise stopping()
                await changed.wait()

    async def cancel(self, identity: str) -> EvaluationInfo:
        """Ends an evaluation; one that has ended stays as it is."""
        with self._work.taken():
            job = self._job(identity)
            await self._queue.cancel(job)
            return job.info

    async def delete(self, identity: str) -> None:
        """Removes an evaluation and its files; ends it first where it is running."""
        with self._work.taken():
            await self._queue.remove(self._job(identity))

    async def result(self, identity: str, form: ResultFormat) -> EvaluationResult:
        """The result of an evaluation that has succeeded."""
        with self._work.taken():
            job = self._job(identity)
            if job.state is not EvaluationState.SUCCEEDED:
                raise ServiceError(
                    ErrorKind.EVALUATION_HAS_NO_RESULT,
                    f"evaluation_id: {quoted(identity)} has no result: it is {job.state.value}",
                )
            folder = self._archive.folder(job.stored.number)
            try:
                return await asyncio.to_thread(folder.result, form)
            except FileNotFoundError:
                if not job.removed:
                    raise
                raise _unknown(identity) from None

    def _own(self) -> Iterator[Job]:
        """The evaluations of the caller's tenant."""
        return self._queue.of(tenancy.current())

    def _job(self, identity: str) -> Job:
        job = self._queue.get(tenancy.current(), identity)
        if job is None:
            raise _unknown(identity)
        return job

    def _of_request(self, request_id: str, sha256: str) -> EvaluationInfo | None:
        """What an earlier request of this id has made."""
        if not request_id:
            return None
        for job in self._own():
            if job.stored.request_id == request_id:
                if job.stored.request_sha256 != sha256:
                    raise invalid("request_id", "was sent before, with another request")
                return job.info
        return None

    def _check_room(self) -> None:
        own, entering = list(self._own()), self._entering[tenancy.current()]
        active = sum(not job.state.ended for job in own)
        self._usage.check(Limit.EVALUATIONS_ACTIVE, active + entering)
        self._usage.check(Limit.EVALUATIONS, len(own) + entering)
        waiting = self._entering.total() + self._queue.waiting
        if waiting >= self._settings.evaluation_queue_size:
            raise ServiceError(
                ErrorKind.OVERLOADED,
                "as many evaluations wait as this server takes; try again later",
                retry_after_s=_RETRY_AFTER_S,
            )
        if len(self._queue) + self._entering.total() >= self._settings.max_evaluations:
            raise ServiceError(
                ErrorKind.TOO_MANY_EVALUATIONS,
                f"{self._settings.max_evaluations} evaluations are kept already; delete some",
                retry_after_s=_RETRY_AFTER_S,
            )


# Where an evaluation stands in its tenant's list, the newest first: of what the tenant sees anyway.
# A number counted over all tenants would tell each how busy the others are.
_Place = tuple[float, str]


def _place(info: EvaluationInfo) -> _Place:
    return -info.created_at, info.id


def _write_place(place: _Place) -> str:
    return pages.write_token(f"{-place[0]!r} {place[1]}")


def _read_place(page_token: str) -> _Place | None:
    """The place that a page begins after; None for the first page."""
    if not page_token:
        return None
    created_at, _, identity = pages.read_token(page_token).partition(" ")
    try:
        at = float(created_at)
    except ValueError:
        raise pages.foreign_token() from None
    if not (math.isfinite(at) and identity):
        raise pages.foreign_token()
    return -at, identity


def _unknown(identity: str) -> ServiceError:
    return ServiceError(
        ErrorKind.UNKNOWN_EVALUATION,
        f"evaluation_id: {quoted(identity)} is unknown: it was never created, or was deleted",
    )
