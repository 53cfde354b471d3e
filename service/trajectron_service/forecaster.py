"""Frames in, outcomes and forecasts out, for one scene at one version.

The one path of every use case: ``fold`` (pure) decides what the frames cause, then one job
goes through the batcher, and only when it has succeeded is there a next record.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field

from trajectron_service.choices import Choices, task_points
from trajectron_service.errors import ErrorKind, FieldViolation, ServiceError
from trajectron_service.messages import (
    Forecast,
    ForecastOptions,
    Frame,
    FrameResult,
    Outcome,
    SceneGraph,
)
from trajectron_service.metrics import Metrics
from trajectron_service.quotas import Rate, Usage
from trajectron_service.records import SceneRecord
from trajectron_service.running import Done, Drawn, Runner, SceneBatcher
from trajectron_service.scenes import ForecastTask, ModelFacts, SceneJob, SceneResult
from trajectron_service.timebase import Observation, Step, advance, classify, head
from trajectron_service.validation import Checked, check, quoted

# Checking this many agents takes some milliseconds; then others have their turn on the loop.
_AGENTS_PER_TURN = 2000
_REFUSED = {
    Outcome.OUT_OF_ORDER: "is {new!r}, before the newest frame's {newest!r}; frames go "
    "forward in time",
    Outcome.CONFLICT: "is {new!r}, the newest frame's, whose content differs; a frame cannot "
    "be changed",
}


@dataclass(frozen=True, slots=True)
class FrameRequest:
    """A frame to fold, what to forecast after it (None: nothing), its number on a stream.

    The forecast is wanted by ``deadline``, on ``time.monotonic``. ``fault`` says why what was
    asked of it means nothing; the answer repeats it.
    """

    frame: Frame
    options: ForecastOptions | None = None
    sequence: int | None = None
    fault: ServiceError | None = None
    deadline: float | None = None


@dataclass(frozen=True, slots=True)
class FrameAnswer:
    """What became of one frame; ``forecast`` or ``error`` where one was asked for.

    ``stale`` marks a repeated frame of a stream that newer ones have followed: what was asked
    of it is not answered any more. ``seen`` is the frame as checked, where it was accepted.
    """

    result: FrameResult
    forecast: Forecast | None = None
    error: ServiceError | None = None
    stale: bool = False
    seen: Observation | None = None


@dataclass(eq=False)
class _Fold:
    """What frames cause: the record after them (its states still those before), and the work."""

    record: SceneRecord
    answers: list[FrameAnswer] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    tasks: dict[int, ForecastTask] = field(default_factory=dict)  # by the index of the frame
    points: int = 0  # of the tasks, taken from what the tenant may ask for


class Forecaster:
    """Folds frames into records, through the batcher."""

    def __init__(
        self, choices: Choices, batcher: SceneBatcher, metrics: Metrics, usage: Usage
    ) -> None:
        self._usage = usage
        self._choices = choices
        self._runner = Runner(choices, batcher, metrics)
        self._metrics = metrics

    async def fold(
        self,
        record: SceneRecord,
        requests: Sequence[FrameRequest],
        *,
        key: Hashable = None,
        deadline: float | None,
        pack: bool = False,
        strict: bool = False,
    ) -> tuple[SceneRecord, bytes | None, list[FrameAnswer]]:
        """The record after the frames, its packed states if asked for, an answer to each frame.

        A refused frame leaves the others, unless ``strict``: then it raises, as does a
        forecast that cannot be made, and no work is done. ``deadline`` is that of frames without
        a forecast; a forecast has its request's.

        Raises:
            ServiceError: the work could not be done; none of the frames counts.
        """
        folded = await self._fold(record, requests)
        result = None
        answers = folded.answers
        try:
            if strict:
                _raise_first(answers)
            if folded.tasks:
                job = self._job(record, folded, pack)
                done = await self._runner.forecast(job, key, strict=strict)
                result = done.result
                self._note_forecasts(record, folded, done)
            elif folded.steps:
                job = self._job(record, folded, pack)
                result = await self._runner.run(job, key, deadline)
        except ServiceError:
            self._usage.give_back(Rate.POINTS, folded.points)
            raise
        after, packed = _with_states(folded.record, record, result)
        for answer in answers:
            self._metrics.frames.labels(answer.result.outcome.value).inc()
        if after.version != record.version:
            self._metrics.scene_agents.observe(after.agent_count)
        return after, packed, answers

    async def forecast(
        self,
        record: SceneRecord,
        options: ForecastOptions,
        *,
        key: Hashable = None,
        deadline: float | None,
    ) -> tuple[SceneRecord, Forecast]:
        """The futures from the newest frame; the record comes back with live states."""
        model = self._model(record)
        task = self._choices.task(options, record.timeline, record.version, model, deadline)
        job = dataclasses.replace(_idle_job(record), forecasts=(task,))
        points = task_points(task, model)
        with self._usage.taken(Rate.POINTS, points):
            done = await self._runner.forecast(job, key, strict=True)
        after, _ = _with_states(record, record, done.result)
        (made,) = done.forecasts
        assert isinstance(made, Drawn)  # strict: else it has raised
        self._usage.give_back(Rate.POINTS, points - task_points(made.task, model))
        return after, self._forecast(record, made)

    async def graph(
        self, record: SceneRecord, *, key: Hashable = None, deadline: float | None
    ) -> tuple[SceneRecord, SceneGraph]:
        """The graph at the newest frame, empty before the first."""
        if record.timeline.newest is None:
            return record, SceneGraph((), ())
        self._model(record)
        where = head(record.timeline)
        job = dataclasses.replace(_idle_job(record), graph=where)
        result = await self._runner.run(job, key, deadline)
        assert result.graph is not None  # asked for
        after, _ = _with_states(record, record, result)
        return after, result.graph

    async def packed(self, record: SceneRecord) -> bytes:
        """The record's states as bytes."""
        if isinstance(record.states, bytes):
            return record.states
        job = dataclasses.replace(_idle_job(record), pack=True)
        result = await self._runner.run(job, None, None)
        assert result.packed is not None  # asked for
        return result.packed

    async def _fold(self, record: SceneRecord, requests: Sequence[FrameRequest]) -> _Fold:
        model = self._model(record)
        fold = _Fold(record)
        agents = 0
        for request in requests:
            self._fold_one(fold, request, model)
            agents += len(request.frame.agents)
            if agents > _AGENTS_PER_TURN:
                agents = 0
                await asyncio.sleep(0)
        return fold

    def _fold_one(self, fold: _Fold, request: FrameRequest, model: ModelFacts) -> None:
        """Takes one frame: its outcome, its steps, its forecast's task."""
        record, sequence = fold.record, request.sequence
        last = record.last_sequence
        if sequence is not None and last is not None and sequence <= last:
            result = FrameResult(Outcome.DUPLICATE, record.version)
            answer = FrameAnswer(result, stale=sequence < last)
        else:
            record, answer, steps = self._take(record, request.frame)
            fold.steps.extend(steps)
            if sequence is not None:
                record = dataclasses.replace(record, last_sequence=sequence)
        if request.fault is not None:
            answer = dataclasses.replace(answer, error=request.fault)
        wanted = request.options is not None and not answer.stale and not answer.result.refused
        if wanted and request.options is not None:
            try:
                task = self._choices.task(
                    request.options, record.timeline, record.version, model, request.deadline
                )
                points = task_points(task, model)
                self._usage.take(Rate.POINTS, points)
                fold.points += points
                fold.tasks[len(fold.answers)] = task
            except ServiceError as error:
                answer = dataclasses.replace(answer, error=error)
        fold.answers.append(answer)
        fold.record = record

    def _take(
        self, record: SceneRecord, frame: Frame
    ) -> tuple[SceneRecord, FrameAnswer, tuple[Step, ...]]:
        timeline, version = record.timeline, record.version
        rules = self._choices.type_rules(record.config)
        checked = check(frame, timeline, rules, self._choices.frame_limits)
        if isinstance(checked, FieldViolation):
            return record, FrameAnswer(_refused(Outcome.INVALID, version, checked)), ()
        outcome = classify(timeline, checked.observation)
        if outcome is Outcome.ACCEPTED:
            taken = advance(timeline, checked.observation)
            after = dataclasses.replace(record, timeline=taken.timeline, version=version + 1)
            result = FrameResult(taken.outcome, version + 1, taken.gaps, checked.ignored)
            return after, FrameAnswer(result, seen=checked.observation), taken.steps
        if outcome is Outcome.DUPLICATE:
            result = FrameResult(outcome, version, ignored_agents=checked.ignored)
            return record, FrameAnswer(result), ()
        return record, FrameAnswer(_out_of_turn(outcome, record, checked)), ()

    def _model(self, record: SceneRecord) -> ModelFacts:
        """The model that made the record's states; raises when it is not loaded any more."""
        facts = self._choices.model(record.model)
        if facts.info.hash != record.model_hash:
            raise ServiceError(
                ErrorKind.UNKNOWN_MODEL,
                f"model: this server has other weights under the name {quoted(record.model)} than "
                "those that this session began with; open a new session",
            )
        return facts

    def _job(self, before: SceneRecord, fold: _Fold, pack: bool) -> SceneJob:
        return SceneJob(
            model=before.model,
            serials=tuple(state.serial for state in before.timeline.committed),
            states=before.states,
            steps=tuple(fold.steps),
            keep=tuple(state.serial for state in fold.record.timeline.committed),
            forecasts=tuple(fold.tasks.values()),
            pack=pack,
        )

    def _note_forecasts(self, record: SceneRecord, fold: _Fold, done: Done) -> None:
        """Puts what was forecast into the answers; what was not made does not count as used."""
        made_points = 0
        for index, made in zip(fold.tasks, done.forecasts, strict=True):
            answer = fold.answers[index]
            if isinstance(made, ServiceError):
                fold.answers[index] = dataclasses.replace(answer, error=made)
            else:
                made_points += task_points(made.task, self._model(record))
                forecast = self._forecast(record, made)
                fold.answers[index] = dataclasses.replace(answer, forecast=forecast)
        self._usage.give_back(Rate.POINTS, fold.points - made_points)

    def _forecast(self, record: SceneRecord, made: Drawn) -> Forecast:
        task = made.task
        facts: ModelFacts = self._choices.model(record.model)
        fewer = 0 < task.made < task.num_samples
        self._metrics.fewer_samples.inc(fewer)
        return Forecast(
            model=facts.info.name,
            model_hash=facts.info.hash,
            mode=task.mode,
            seed=task.seed,
            reference_time=task.head.time_s,
            # Rounded: 3 * 0.4 is to read 1.2.
            time_offsets_s=tuple(round(facts.info.dt_s * (h + 1), 9) for h in range(task.horizon)),
            agents=made.agents,
            sampling=task.sampling,
            num_samples=task.made,
            fewer_samples=fewer,
        )


def _idle_job(record: SceneRecord) -> SceneJob:
    """A job that makes no steps and gives the record's states back, live."""
    serials = tuple(state.serial for state in record.timeline.committed)
    return SceneJob(record.model, serials, record.states, keep=serials)


def _with_states(
    record: SceneRecord, before: SceneRecord, result: SceneResult | None
) -> tuple[SceneRecord, bytes | None]:
    """The record with the states that came back; the very same one when nothing changed."""
    if result is None:
        return record, None
    if record is before and not isinstance(before.states, bytes):
        return record, result.packed
    after = dataclasses.replace(record, states=result.states, edge_count=result.edge_count)
    return after, result.packed


def _refused(outcome: Outcome, version: int, violation: FieldViolation) -> FrameResult:
    message = f"{violation.field} {violation.description}"
    return FrameResult(outcome, version, field=violation.field, message=message)


def _raise_first(answers: Sequence[FrameAnswer]) -> None:
    for place, answer in enumerate(answers):
        if answer.result.refused:
            raise refusal(answer.result, f"frames[{place}].")
        if answer.error is not None:
            raise answer.error


def _out_of_turn(outcome: Outcome, record: SceneRecord, checked: Checked) -> FrameResult:
    newest = record.timeline.newest
    assert newest is not None  # what is out of turn has something before it
    text = _REFUSED[outcome].format(new=checked.observation.time_s, newest=newest.time_s)
    return _refused(outcome, record.version, FieldViolation("time", text))


def refusal(result: FrameResult, place: str) -> ServiceError:
    """A refused frame as an error; ``place`` is put before the field's path."""
    kind = {
        Outcome.CONFLICT: ErrorKind.FRAME_CONFLICT,
        Outcome.OUT_OF_ORDER: ErrorKind.FRAME_OUT_OF_ORDER,
        Outcome.INVALID: ErrorKind.INVALID_ARGUMENT,
    }[result.outcome]
    description = result.message.removeprefix(f"{result.field} ")
    violation = FieldViolation(f"{place}{result.field}", description)
    return ServiceError(kind, f"{place}{result.message}", violations=(violation,))
