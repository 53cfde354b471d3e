"""The use cases: what the service does, whatever transport asked for it.

Everything raised here is a ``ServiceError``. Deadlines are seconds on ``time.monotonic()``.
"""

from __future__ import annotations

import asyncio
import time
import weakref
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress

from trajectron_service import choices as chosen
from trajectron_service import logs, pages, tenancy
from trajectron_service.batching import Batcher, BatchReport
from trajectron_service.choices import Choices
from trajectron_service.errors import ErrorKind, ServiceError, invalid
from trajectron_service.forecaster import Forecaster, FrameAnswer, FrameRequest
from trajectron_service.messages import (
    Forecast,
    ForecastOptions,
    Frame,
    FrameResult,
    ModelInfo,
    SceneGraph,
    SessionConfig,
    SessionInfo,
    StreamOptions,
    UnknownTypes,
)
from trajectron_service.metrics import Metrics
from trajectron_service.quotas import Rate, Usage, unlimited
from trajectron_service.records import SceneRecord
from trajectron_service.scenes import SceneEngine, SceneJob, SceneResult
from trajectron_service.session_errors import STREAM_ENDED
from trajectron_service.sessions import Change, Sessions
from trajectron_service.settings import Settings
from trajectron_service.stores import SessionKey, SessionStore, StoreError
from trajectron_service.stores.memory import MemoryStore
from trajectron_service.streams import Stream, StreamLimits
from trajectron_service.timebase import Timeline
from trajectron_service.watching.accuracy import LiveAccuracy, WatchLimits
from trajectron_service.watching.drawing import mixture_drawer
from trajectron_service.work import WorkInHand

__all__ = ["Application", "Stream"]

log = logs.get(__name__)

HOUSEKEEPING_S = 1.0
# What one batch should take at most: nobody who comes while it runs waits for much longer.
_BATCH_S = 0.05


def steady_unix_clock() -> Callable[[], float]:
    """Unix seconds that go on steadily whatever happens to the system's clock."""
    offset = time.time() - time.monotonic()
    return lambda: time.monotonic() + offset


class Application:
    """The service without a transport. Made inside a running event loop's program, used in it.

    Args:
        settings: limits and defaults.
        engine: the loaded models.
        metrics: told about everything.
        work: counts the calls, and refuses them while the service drains; its own when None.
        store: where sessions are kept; this process's memory when None.
        usage: holds tenants to their quotas; nobody has one where None.
        clock: Unix seconds that never go back: when sessions expire.
        draw_seed: gives the seed of a request that brings none.
    """

    def __init__(
        self,
        settings: Settings,
        engine: SceneEngine,
        metrics: Metrics,
        *,
        work: WorkInHand | None = None,
        store: SessionStore | None = None,
        usage: Usage | None = None,
        clock: Callable[[], float] | None = None,
        draw_seed: Callable[[], int] = chosen.draw_seed,
    ) -> None:
        self._settings = settings
        self._engine = engine
        self._metrics = metrics
        self._work = work or WorkInHand(metrics)
        self._usage = usage or unlimited(metrics)
        self._clock = clock or steady_unix_clock()
        self._choices = Choices(settings, engine.models, engine.default_model, draw_seed)
        self._batcher = Batcher[SceneJob, SceneResult](
            self._run,
            queue_size=settings.queue_size,
            max_batch_cost=settings.max_batch_points,
            batch_s=_BATCH_S,
            report=self._note_batch,
        )
        self._forecaster = Forecaster(self._choices, self._batcher, metrics, self._usage)
        self._sessions = Sessions(
            store or MemoryStore(),
            self._forecaster.packed,
            clock=self._clock,
            metrics=metrics,
            max_sessions=settings.max_sessions,
            park_after_s=settings.park_after_s,
            usage=self._usage,
            on_close=self._on_close,
        )
        self._accuracy = self._watch() if settings.live_accuracy else None
        self._streams: weakref.WeakValueDictionary[SessionKey, Stream] = (
            weakref.WeakValueDictionary()
        )
        self._started = False
        self._housekeeper: asyncio.Task[None] | None = None
        for facts in engine.models.values():
            info = facts.info
            metrics.model_info.labels(info.name, info.hash, str(info.is_default).lower()).set(1)
        metrics.queue_length.set_function(lambda: self._batcher.waiting)
        metrics.in_hand.set_function(lambda: self._work.count)
        metrics.ready.set_function(lambda: float(self.ready))

    def _watch(self) -> LiveAccuracy:
        settings = self._settings
        return LiveAccuracy(
            WatchLimits(settings.live_accuracy_budget, settings.live_accuracy_pending),
            self._metrics.accuracy,
            self._batcher.run_alone,
            lambda model: self._engine.models[model].info.horizon,
        )

    async def start(self) -> None:
        """Warms the models up and begins to close idle sessions; then ``ready`` is true."""
        if self._settings.warm_up:
            await self._batcher.run_alone(self._engine.warm_up)
        self._housekeeper = asyncio.create_task(self._keep_house(), name="housekeeper")
        self._started = True

    @property
    def metrics(self) -> Metrics:
        """What it was told to tell everything."""
        return self._metrics

    @property
    def ready(self) -> bool:
        """Whether new work is taken."""
        return self._started and not self._work.draining

    def begin_drain(self) -> None:
        """Refuses new work from now on; work in hand finishes, streams end after what they read."""
        self._work.drain()
        for stream in list(self._streams.values()):
            stream.drain()

    async def drained(self) -> None:
        """Returns when no work is in hand."""
        await self._work.finished()

    async def close(self) -> None:
        """Ends the housekeeping and, after what waits there, the inference thread."""
        self._work.drain()
        if self._housekeeper is not None:
            self._housekeeper.cancel()
            with suppress(asyncio.CancelledError):
                await self._housekeeper
        if self._accuracy is not None:
            await self._accuracy.close()
        await self._batcher.close()

    def list_models(self) -> tuple[ModelInfo, ...]:
        """The loaded models, the default one first."""
        infos = [facts.info for facts in self._engine.models.values()]
        return tuple(sorted(infos, key=lambda info: not info.is_default))

    async def predict(
        self,
        *,
        model: str | None,
        frames: tuple[Frame, ...],
        options: ForecastOptions,
        unknown_types: UnknownTypes,
        type_map: Mapping[str, str],
        frame_interval_s: float | None,
        deadline: float | None,
    ) -> Forecast:
        """The futures after ``frames``: what a session that observed them would forecast."""
        with self._work.taken():
            self._check_frames(frames)
            self._choices.check_options(options)
            asked = SessionConfig(
                model=model,
                frame_interval_s=frame_interval_s,
                unknown_types=unknown_types,
                type_map=type_map,
            )
            requests = [FrameRequest(frame) for frame in frames[:-1]]
            async with self._until(_sooner(deadline, options.deadline_s)) as limit:
                requests.append(FrameRequest(frames[-1], options, deadline=limit))
                with self._usage.taken(Rate.FRAMES, len(frames)):
                    _, _, answers = await self._forecaster.fold(
                        self._blank(asked), requests, deadline=limit, strict=True
                    )
        forecast = answers[-1].forecast
        assert forecast is not None  # strict: else it has raised
        return forecast

    async def create_session(self, session_id: str | None, config: SessionConfig) -> SessionInfo:
        """Opens a session; an id is assigned when None or empty."""
        with self._work.taken():
            key = _key(chosen.session_id(session_id))
            return await self._sessions.create(key, self._blank(config))

    async def get_session(self, session_id: str) -> tuple[SessionInfo, SceneGraph]:
        """A session with its graph at the newest frame."""
        key = _key(session_id)

        async def look(record: SceneRecord) -> tuple[Change, SceneGraph]:
            after, graph = await self._forecaster.graph(record, key=key, deadline=limit)
            return Change(after), graph

        with self._work.taken():
            async with self._until(None) as limit:
                graph = await self._sessions.change(key, look)
                return await self._sessions.info(key), graph

    async def list_sessions(
        self, page_size: int | None, page_token: str
    ) -> tuple[tuple[SessionInfo, ...], str]:
        """Open sessions in order of id, and the token of the next page, empty on the last."""
        with self._work.taken():
            size = pages.size(page_size)
            after = pages.read_token(page_token)
            infos, more = await self._sessions.page(tenancy.current(), after, size)
            return infos, pages.write_token(infos[-1].id) if more and infos else ""

    async def delete_session(self, session_id: str) -> None:
        """Closes a session and forgets its state."""
        with self._work.taken():
            await self._sessions.delete(_key(session_id))

    async def observe(
        self, session_id: str, frames: tuple[Frame, ...], deadline: float | None
    ) -> tuple[FrameResult, ...]:
        """Folds frames in order; a refused one leaves the others. A single refused one raises."""
        requests = [FrameRequest(frame) for frame in frames]
        with self._work.taken():
            self._check_frames(frames)
            async with self._until(deadline) as limit:
                strict = len(frames) == 1
                answers = await self._fold(_key(session_id), requests, limit, strict=strict)
        return tuple(answer.result for answer in answers)

    async def predict_session(
        self, session_id: str, options: ForecastOptions, deadline: float | None
    ) -> Forecast:
        """The futures from the session's newest frame."""
        key = _key(session_id)

        async def look(record: SceneRecord) -> tuple[Change, tuple[SceneRecord, Forecast]]:
            after, forecast = await self._forecaster.forecast(
                record, options, key=key, deadline=limit
            )
            return Change(after), (after, forecast)

        with self._work.taken():
            self._choices.check_options(options)
            async with self._until(_sooner(deadline, options.deadline_s)) as limit:
                record, forecast = await self._sessions.change(key, look)
        newest = record.timeline.newest
        if self._accuracy is not None and newest is not None:
            draw = mixture_drawer(self._engine, record)
            self._accuracy.forecast(key, record.version, newest, forecast, draw)
        return forecast

    async def open_stream(
        self, session_id: str | None, config: SessionConfig, options: StreamOptions
    ) -> Stream:
        """A stream into a session, new or resumed; another stream into it ends.

        To be closed by the caller, whether its replies were read or not.
        """
        with self._work.taken(), ExitStack() as counted:
            if options.forecast is not None:
                self._choices.check_options(options.forecast)
            key = _key(chosen.session_id(session_id))
            counted.enter_context(self._usage.stream(key.id))
            session, resumed = await self._open(
                key, config, named=bool(session_id), must_exist=options.must_exist
            )
            before = self._streams.get(key)
            if before is not None:
                await before.take_over()
                session = await self._sessions.info(key)
            stream = Stream(
                session,
                resumed,
                options,
                fold=lambda requests: self._fold(key, requests, None),
                on_end=lambda: self._sessions.delete(key, STREAM_ENDED),
                busy=lambda: self._streaming(key),
                on_close=counted.pop_all().close,
                limits=StreamLimits(
                    self._settings.stream_window,
                    self._settings.max_batch_points,
                    self._settings.request_timeout_s,
                ),
                metrics=self._metrics,
            )
            self._streams[key] = stream
            return stream

    async def _open(
        self, key: SessionKey, config: SessionConfig, *, named: bool, must_exist: bool
    ) -> tuple[SessionInfo, bool]:
        """The session, and whether it was there already; one not ``named`` by its client is not."""
        if must_exist:
            return await self._sessions.info(key), True
        if named:
            with _past(ErrorKind.UNKNOWN_SESSION):
                return await self._sessions.info(key), True
        try:
            return await self._sessions.create(key, self._blank(config)), False
        except ServiceError as error:
            # Somebody opened it in between.
            if error.kind is not ErrorKind.SESSION_EXISTS:
                raise
            return await self._sessions.info(key), True

    async def _fold(
        self,
        key: SessionKey,
        requests: Sequence[FrameRequest],
        deadline: float | None,
        *,
        strict: bool = False,
    ) -> list[FrameAnswer]:
        """Folds frames into a session."""

        async def observe(
            record: SceneRecord,
        ) -> tuple[Change, tuple[SceneRecord, list[FrameAnswer]]]:
            after, packed, answers = await self._forecaster.fold(
                record,
                requests,
                key=key,
                deadline=deadline,
                pack=self._sessions.durable,
                strict=strict,
            )
            return Change(after, packed), (after, answers)

        with self._usage.taken(Rate.FRAMES, len(requests)):
            record, answers = await self._sessions.change(key, observe, extends=True)
        self._note_answers(key, record, answers)
        return answers

    def _note_answers(
        self, key: SessionKey, record: SceneRecord, answers: Sequence[FrameAnswer]
    ) -> None:
        """Tells of accepted frames and of forecasts from them; ``record`` is that after them."""
        if self._accuracy is None:
            return
        for answer in answers:
            if answer.seen is None:
                continue
            version = answer.result.version
            self._accuracy.frame(key, version, answer.seen)
            if answer.forecast is not None:
                last = version == record.version
                draw = mixture_drawer(self._engine, record) if last else None
                self._accuracy.forecast(key, version, answer.seen, answer.forecast, draw)

    def _on_close(self, key: SessionKey) -> None:
        if self._accuracy is not None:
            self._accuracy.closed(key)

    @contextmanager
    def _streaming(self, key: SessionKey) -> Iterator[None]:
        """A stream is work in hand, and holds its session open."""
        with self._work.taken(), self._sessions.held(key):
            yield

    def _blank(self, config: SessionConfig) -> SceneRecord:
        """A session before its first frame."""
        resolved = self._choices.session_config(config)
        facts = self._choices.model(resolved.model)
        return SceneRecord(
            config=resolved,
            model_hash=facts.info.hash,
            created_at=self._clock(),
            timeline=Timeline(self._choices.grid(resolved)),
        )

    def _check_frames(self, frames: tuple[Frame, ...]) -> None:
        most = self._settings.max_frames_per_request
        if not frames:
            raise invalid("frames", "is empty; at least one frame is required")
        if len(frames) > most:
            raise invalid("frames", f"has {len(frames)} frames; a request may have at most {most}")

    @asynccontextmanager
    async def _until(self, deadline: float | None) -> AsyncIterator[float]:
        """The deadline in force; what is inside ends then, with DEADLINE_EXCEEDED."""
        now = time.monotonic()
        longest = now + self._settings.request_timeout_s
        limit = longest if deadline is None else min(deadline, longest)
        try:
            async with asyncio.timeout(limit - now) as scope:
                yield limit
        except TimeoutError as error:
            if not scope.expired():
                raise
            raise ServiceError(
                ErrorKind.DEADLINE_EXCEEDED, "the deadline passed before the work was done"
            ) from error

    def _run(self, jobs: Sequence[SceneJob]) -> Sequence[SceneResult]:
        """A batch, on the inference thread."""
        with self._metrics.tracing.batch([job.ticket for job in jobs]):
            return self._engine.run(jobs)

    def _note_batch(self, report: BatchReport) -> None:
        self._metrics.batch_jobs.observe(report.entries)
        self._metrics.inference_seconds.inc(report.ran_s)
        if self._accuracy is not None:
            self._accuracy.inferred(report.ran_s)
        for waited_s in report.waited_s:
            self._metrics.stage_seconds.labels("queue").observe(waited_s)

    async def keep_house(self) -> None:
        """Keeps sessions open that streams hold, closes those expired, parks those unused."""
        await self._sessions.renew()
        await self._sessions.reap()
        await self._sessions.park()

    async def _keep_house(self) -> None:
        """Closes sessions that have expired and parks those unused, until cancelled."""
        while True:
            await asyncio.sleep(HOUSEKEEPING_S)
            try:
                await self.keep_house()
            except (ServiceError, StoreError) as error:
                # A full queue or a store that is away: the next round tries again.
                log.warning("housekeeping put off", reason=str(error))
            except Exception:
                log.exception("housekeeping failed")


@contextmanager
def _past(kind: ErrorKind) -> Iterator[None]:
    """Goes on after an error of this kind."""
    try:
        yield
    except ServiceError as error:
        if error.kind is not kind:
            raise


def _sooner(deadline: float | None, deadline_s: float | None) -> float | None:
    """The earlier one of a deadline and of so many seconds from now."""
    if deadline_s is None:
        return deadline
    own = time.monotonic() + deadline_s
    return own if deadline is None else min(deadline, own)


def _key(session_id: str) -> SessionKey:
    """A session of the caller's: nobody can name another tenant's."""
    return SessionKey(tenancy.current(), session_id)
