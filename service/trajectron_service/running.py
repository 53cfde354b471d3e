"""Jobs on their way through the batcher: whole or in slices, in time, with fewer samples or not.

Frames are folded whatever becomes of the forecasts after them; a forecast that is late is an
error of its own. Long forecasts are cut by agents and, where these are too few, by samples: the
slices of one agent draw the noise of all its samples and use their own part of it, so that they
give what the whole would have given.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Hashable, Sequence

import numpy as np

from trajectron_service import logs
from trajectron_service.batching import Batcher, Closed, Expired, Part, QueueFull, TooLate
from trajectron_service.choices import Choices, task_points, task_work
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.messages import AgentForecast
from trajectron_service.metrics import Metrics
from trajectron_service.pace import Work
from trajectron_service.scenes import ForecastTask, ModelFacts, SceneJob, SceneResult

log = logs.get(__name__)

# An agent's encoder step costs about as much as this many sampled positions.
_STEP_POINTS = 20
# A forecast that takes longer than this is made in slices, so that others have their turn.
_SLICE_S = 0.025
# Of the time that is left, what fewer samples may take by the estimate: it may be off.
_FILLED = 0.8

SceneBatcher = Batcher[SceneJob, SceneResult]
Agents = tuple[AgentForecast, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Drawn:
    """A forecast that was made: the task as it was in the end, and its agents."""

    task: ForecastTask
    agents: Agents


@dataclasses.dataclass(eq=False)
class Done:
    """What came of a job: the states, and for each of its forecasts agents or an error."""

    result: SceneResult
    forecasts: list[Drawn | ServiceError]


class Runner:
    """Does jobs on the inference thread, through the batcher."""

    def __init__(self, choices: Choices, batcher: SceneBatcher, metrics: Metrics) -> None:
        self._choices = choices
        self._batcher = batcher
        self._metrics = metrics

    async def run(self, job: SceneJob, key: Hashable, deadline: float | None) -> SceneResult:
        """Does a job without forecasts; raises ServiceError."""
        model = self._choices.model(job.model)
        urgent = bool(job.steps)
        (result,) = await self._submit([_part(job, model)], key, deadline, urgent=urgent)
        return result

    async def forecast(self, job: SceneJob, key: Hashable, *, strict: bool) -> Done:
        """Does a job with its forecasts, each by its deadline.

        Args:
            job: at least one forecast.
            key: of its session.
            strict: a forecast that cannot be made raises, if possible before any work is done;
                otherwise it is an error in the answer, and the steps are made all the same.

        Raises:
            ServiceError: the steps could not be made, and nothing has changed.
        """
        done = await self._forecast(job, key, strict=strict)
        if strict:
            for made in done.forecasts:
                if isinstance(made, ServiceError):
                    raise made
        return done

    async def _forecast(self, job: SceneJob, key: Hashable, *, strict: bool) -> Done:
        model = self._choices.model(job.model)
        tasks = list(job.forecasts)
        errors: dict[int, ServiceError] = {}
        while True:
            left = self._in_time(job, tasks, errors, model, strict=strict)
            if not left:
                result = await self.run(dataclasses.replace(job, forecasts=()), key, None)
                return Done(result, [errors[i] for i in range(len(tasks))])
            if self._is_long(job, [tasks[i] for i in left], model):
                return await self._in_slices(job, tasks, errors, key, strict=strict)
            whole = dataclasses.replace(job, forecasts=tuple(tasks[i] for i in left))
            first = min(left, key=lambda i: _deadline(tasks[i]))
            try:
                (result,) = await self._submit(
                    [_part(whole, model)], key, tasks[first].deadline, finish=not strict
                )
            except ServiceError as error:
                # Nothing has been done: what was late goes, the others and the steps go on.
                if not _concerns_forecasts(error, len(left)):
                    raise
                if _halved(tasks, first, error):
                    continue
                if strict:
                    raise
                errors[first] = error
                continue
            break
        drawn = dict(zip(left, result.forecasts, strict=True))
        return Done(
            result,
            [
                errors[i] if i in errors else _on_time(task, drawn[i])
                for i, task in enumerate(tasks)
            ],
        )

    def _in_time(
        self,
        job: SceneJob,
        tasks: list[ForecastTask],
        errors: dict[int, ServiceError],
        model: ModelFacts,
        *,
        strict: bool,
    ) -> list[int]:
        """Which forecasts can be made in time, with fewer samples where that is allowed.

        Those that cannot get their error, or raise it if ``strict``.
        """
        before = [_part(dataclasses.replace(job, forecasts=()), model)]
        left = []
        for i, task in enumerate(tasks):
            if i in errors:
                continue
            try:
                tasks[i] = self._fitted(task, before, model)
            except TooLate as error:
                errors[i] = _late(error)
                if strict:
                    raise errors[i] from None
                continue
            before.append(_task_part(tasks[i], model))
            left.append(i)
        return left

    def _fitted(
        self, task: ForecastTask, before: Sequence[Part[SceneJob]], model: ModelFacts
    ) -> ForecastTask:
        """The task, with as many samples as can be made by its deadline; raises TooLate."""
        parts = [*before, _task_part(task, model)]
        if not (task.allow_fewer and task.made > 1):
            self._batcher.check(parts, deadline=task.deadline)
            return task
        late = self._batcher.late(parts, deadline=task.deadline)
        if late is None:
            return task
        work = task_work(task, model)
        each_s = self._batcher.pace.seconds(Work(samples=work.samples / task.made))
        spare_s = late.left_s - late.queue_s - (late.own_s - each_s * task.made)
        fits = int(_FILLED * spare_s / each_s)
        fewer = dataclasses.replace(task, run=(0, min(max(fits, 1), task.made)))
        self._batcher.check([*before, _task_part(fewer, model)], deadline=task.deadline)
        return fewer

    def _is_long(self, job: SceneJob, tasks: Sequence[ForecastTask], model: ModelFacts) -> bool:
        """Whether forecasts are cut: they take long, and start from states given back."""
        kept = {None, *job.keep}
        return all(task.head.source in kept for task in tasks) and any(
            len(self._slices(task, model)) > 1 for task in tasks
        )

    def _slices(self, task: ForecastTask, model: ModelFacts) -> list[ForecastTask]:
        """A forecast in slices: the first agents with their samples in order, then the next.

        None is smaller than one sample of one agent. Modes come with an agent's first samples.
        """
        seconds = self._batcher.pace.seconds(task_work(task, model))
        wanted = max(1, math.ceil(seconds / _SLICE_S))
        agents = max(1, min(len(task.agents or task.head.ids), wanted))
        runs = max(1, min(task.made, math.ceil(wanted / agents)))
        bounds = [task.made * k // runs for k in range(runs + 1)]
        return [
            dataclasses.replace(
                task,
                share=(share, agents),
                run=(bounds[k], bounds[k + 1]) if task.made else None,
                include_modes=task.include_modes and k == 0,
            )
            for share in range(agents)
            for k in range(runs)
        ]

    async def _in_slices(
        self,
        job: SceneJob,
        tasks: list[ForecastTask],
        errors: dict[int, ServiceError],
        key: Hashable,
        *,
        strict: bool,
    ) -> Done:
        """The steps at once, then the forecasts one after the other, between other work."""
        model = self._choices.model(job.model)
        stepped = await self.run(dataclasses.replace(job, forecasts=()), key, None)
        # Slices start from the states after the steps.
        live = SceneJob(job.model, job.keep, stepped.states)
        done = Done(stepped, [])
        for i in range(len(tasks)):
            while i not in errors:
                try:
                    tasks[i] = self._fitted(tasks[i], (), model)
                    cut = self._slices(tasks[i], model)
                    parts = [_slice(live, one, model) for one in cut]
                    results = await self._submit(parts, key, tasks[i].deadline)
                except TooLate as error:
                    errors[i] = _late(error)
                except ServiceError as error:
                    if not _halved(tasks, i, error):
                        errors[i] = error
                else:
                    agents = _joined(cut, [result.forecasts[0] for result in results])
                    done.forecasts.append(_on_time(tasks[i], agents))
                    break
            if i in errors:
                if strict:
                    raise errors[i]
                done.forecasts.append(errors[i])
        return done

    async def _submit(
        self,
        parts: Sequence[Part[SceneJob]],
        key: Hashable,
        deadline: float | None,
        *,
        urgent: bool = False,
        finish: bool = False,
    ) -> list[SceneResult]:
        ticket = self._metrics.tracing.ticket()
        if ticket is not None:
            parts = [
                dataclasses.replace(part, job=dataclasses.replace(part.job, ticket=ticket))
                for part in parts
            ]
        try:
            return await self._batcher.submit_parts(
                parts, key=key, deadline=deadline, urgent=urgent, finish=finish
            )
        except QueueFull as error:
            # ``from None``, here and below: refusals are many when there is too much to do, and
            # each would keep the frames that it came through.
            raise ServiceError(
                ErrorKind.OVERLOADED,
                "the service is busy: too much work waits already; try again later",
                retry_after_s=error.retry_after_s,
            ) from None
        except TooLate as error:
            raise _late(error) from None
        except Expired as error:
            raise ServiceError(ErrorKind.DEADLINE_EXCEEDED, str(error)) from None
        except Closed:
            raise ServiceError(ErrorKind.DRAINING, "the service is stopping") from None
        except Exception as error:
            job = parts[0].job
            log.exception("job failed", model=job.model, steps=len(job.steps))
            raise ServiceError(
                ErrorKind.INTERNAL, "the model failed on this request; the fault is logged"
            ) from error


def _part(job: SceneJob, model: ModelFacts) -> Part[SceneJob]:
    stepped = sum(len(step.frame.ids) for step in job.steps)
    drawn = sum(task_points(task, model) for task in job.forecasts)
    works = [task_work(task, model) for task in job.forecasts]
    amounts = (sum(column) for column in zip(Work(1.0, stepped), *works, strict=True))
    return Part(job, drawn + _STEP_POINTS * stepped, Work(*amounts))


def _task_part(task: ForecastTask, model: ModelFacts) -> Part[SceneJob]:
    """A forecast for estimates; it runs as part of a job or in slices."""
    return Part(SceneJob("", (), ()), task_points(task, model), task_work(task, model))


def _slice(live: SceneJob, task: ForecastTask, model: ModelFacts) -> Part[SceneJob]:
    """One slice; its amounts are an equal share of those of all the agents."""
    count = task.share[1]
    work = Work(1.0, *(amount / count for amount in task_work(task, model)[1:]))
    return Part(
        dataclasses.replace(live, forecasts=(task,)), task_points(task, model) / count, work
    )


def _joined(cut: Sequence[ForecastTask], drawn: Sequence[Agents]) -> Agents:
    """The agents of a forecast from its slices."""
    shares: dict[int, list[Agents]] = {}
    for task, agents in zip(cut, drawn, strict=True):
        shares.setdefault(task.share[0], []).append(agents)
    return tuple(
        _with_all_samples(slices) for runs in shares.values() for slices in zip(*runs, strict=True)
    )


def _with_all_samples(runs: Sequence[AgentForecast]) -> AgentForecast:
    """One agent's forecast from those of its runs of samples."""
    if len(runs) == 1:
        return runs[0]
    samples = [run.samples for run in runs if run.samples is not None]
    modes = [run.sample_modes for run in runs if run.sample_modes is not None]
    return dataclasses.replace(
        runs[0], samples=np.concatenate(samples), sample_modes=np.concatenate(modes)
    )


def _deadline(task: ForecastTask) -> float:
    return math.inf if task.deadline is None else task.deadline


def _on_time(task: ForecastTask, agents: Agents) -> Drawn | ServiceError:
    """A forecast, unless it has come late: its frame was observed all the same."""
    if time.monotonic() <= _deadline(task):
        return Drawn(task, agents)
    return ServiceError(
        ErrorKind.DEADLINE_EXCEEDED, "the deadline passed before the forecast was made"
    )


def _halved(tasks: list[ForecastTask], i: int, error: ServiceError) -> bool:
    """Goes on with half the samples of a task that other work made late, if that may be."""
    task = tasks[i]
    late = error.kind is ErrorKind.DEADLINE_EXCEEDED and time.monotonic() < _deadline(task)
    if not (late and task.allow_fewer and task.made > 1):
        return False
    tasks[i] = dataclasses.replace(task, run=(0, task.made // 2))
    return True


def _concerns_forecasts(error: ServiceError, forecasts: int) -> bool:
    """Whether the steps may go on without a forecast: it was late, or is alone with its fault."""
    if error.kind is ErrorKind.INTERNAL:
        return forecasts == 1
    return error.kind is ErrorKind.DEADLINE_EXCEEDED


def _late(error: TooLate) -> ServiceError:
    return ServiceError(ErrorKind.DEADLINE_EXCEEDED, f"not begun, for it would be late: {error}")
