"""Forecasts in time: fewer samples where that is allowed, and frames observed whatever is late."""

from __future__ import annotations

import asyncio
import dataclasses
import threading
from collections.abc import Sequence

import numpy as np
import pytest
from tests.service.building import application, config, predict, same_forecast, walk
from tests.service.test_session_streams import Sender, run

from trajectron_model.trajectron import Trajectron
from trajectron_service import running
from trajectron_service.application import Application
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.messages import (
    Forecast,
    ForecastMode,
    ForecastOptions,
    Outcome,
    Sampling,
    StreamOptions,
)
from trajectron_service.pace import Pace, Work
from trajectron_service.scenes import SceneJob, SceneResult

ASKED = ForecastOptions(num_samples=40, horizon=6, seed=7, deadline_s=20.0)
FEWER = dataclasses.replace(ASKED, allow_fewer_samples=True)
AGENTS = 3


class Fixed(Pace):
    """One sample of the three agents takes so many seconds; all else hardly any."""

    def __init__(self, sample_s: float) -> None:
        super().__init__()
        self._each_s = Work(1e-9, 1e-9, sample_s / (AGENTS * 6), 1e-9)

    def learn(self, done: object, took_s: float) -> None:
        """It knows."""

    def doubt(self, work: Work) -> None:
        """It is certain."""


def at_pace(network: Trajectron, sample_s: float) -> Application:
    app = application(network)
    app._batcher.pace = Fixed(sample_s)
    return app


def first_samples(few: Forecast, all_of_them: Forecast) -> bool:
    """Whether those of one forecast are the first of another's."""
    for one, other in zip(few.agents, all_of_them.agents, strict=True):
        assert one.samples is not None and other.samples is not None
        assert one.sample_modes is not None and other.sample_modes is not None
        count = len(one.samples)
        if not np.allclose(one.samples, other.samples[:count], rtol=0.0, atol=1e-5):
            return False
        if not np.array_equal(one.sample_modes, other.sample_modes[:count]):
            return False
    return True


@pytest.mark.parametrize("sampling", Sampling)
async def test_fewer_samples_are_the_first_of_all_and_say_so(
    network: Trajectron, sampling: Sampling
) -> None:
    options = dataclasses.replace(FEWER, sampling=sampling)
    app = application(network)
    whole = await predict(app, walk(range(4)), options)
    assert (whole.num_samples, whole.fewer_samples) == (40, False)
    slow = at_pace(network, 2.0)  # 80 s for all of them
    few = await predict(slow, walk(range(4)), options)
    assert 1 <= few.num_samples <= 10
    assert few.fewer_samples
    assert [len(agent.samples) for agent in few.agents if agent.samples is not None] == [
        few.num_samples
    ] * AGENTS
    assert first_samples(few, whole)
    value = slow.metrics.registry.get_sample_value
    assert value("trajectron_forecasts_fewer_samples_total") == 1.0
    await app.close()
    await slow.close()


@pytest.mark.parametrize(
    ("options", "sample_s"),
    [
        (ASKED, 2.0),
        (FEWER, 30.0),
        (dataclasses.replace(FEWER, mode=ForecastMode.GMM), 2.0),
    ],
    ids=["not allowed", "not even one", "gmm has none"],
)
async def test_what_would_be_late_all_the_same_is_refused_and_costs_nothing(
    network: Trajectron, options: ForecastOptions, sample_s: float
) -> None:
    app = at_pace(network, sample_s)
    if options.mode is ForecastMode.GMM:
        app._batcher.pace._each_s = Work(modes=10.0)
    with pytest.raises(ServiceError, match="would be late") as refusal:
        await predict(app, walk(range(4)), options)
    assert refusal.value.kind is ErrorKind.DEADLINE_EXCEEDED
    assert app.metrics.registry.get_sample_value("trajectron_batch_jobs_count") == 0.0
    await app.close()


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
async def test_a_deadline_that_is_none_is_refused(app: Application, value: float) -> None:
    with pytest.raises(ServiceError, match="deadline_s") as refusal:
        await predict(app, walk(range(2)), ForecastOptions(deadline_s=value))
    assert refusal.value.kind is ErrorKind.INVALID_ARGUMENT


@pytest.mark.parametrize("slices", [1, 6], ids=["whole", "sliced"])
async def test_a_late_forecast_is_an_error_in_its_reply_and_its_frame_is_observed_once(
    network: Trajectron, monkeypatch: pytest.MonkeyPatch, slices: int
) -> None:
    app = at_pace(network, 2.0)
    monkeypatch.setattr(running, "_SLICE_S", 80.0 / slices)
    folded: list[int] = []
    run_jobs = app._batcher._run

    def noting(jobs: list[SceneJob]) -> Sequence[SceneResult]:
        folded.extend(len(job.steps) for job in jobs)
        return run_jobs(jobs)

    app._batcher._run = noting
    stream = await app.open_stream("s", config(), StreamOptions(ASKED))
    replies = await run(stream, walk(range(5)))
    assert [reply.result.outcome for reply in replies] == [Outcome.ACCEPTED] * 5
    assert [reply.error and reply.error.kind for reply in replies] == [
        ErrorKind.DEADLINE_EXCEEDED
    ] * 5
    session, _ = await app.get_session("s")
    assert (session.version, session.last_sequence) == (5, 5)
    assert sum(folded) == 5  # several frames were read together, and none was done again
    await app.close()


async def test_a_frame_of_a_stream_has_a_deadline_of_its_own(network: Trajectron) -> None:
    app = at_pace(network, 0.2)  # 8 s for all
    sender = Sender()
    one, two, three = walk(range(3))
    sender.send(1, one, dataclasses.replace(ASKED, deadline_s=4.0))
    sender.send(2, two, dataclasses.replace(FEWER, deadline_s=4.0))
    sender.send(3, three)
    sender.end()
    stream = await app.open_stream("s", config(), StreamOptions(ASKED))
    late, few, fine = [reply async for reply in stream.replies(sender.frames())]
    assert {reply.result.outcome for reply in (late, few, fine)} == {Outcome.ACCEPTED}
    assert late.error is not None
    assert late.error.kind is ErrorKind.DEADLINE_EXCEEDED
    assert few.forecast is not None and few.forecast.fewer_samples
    assert fine.forecast is not None and not fine.forecast.fewer_samples
    other = application(network)
    assert same_forecast(fine.forecast, await predict(other, walk(range(3)), ASKED), 1e-4)
    await app.close()
    await other.close()


async def test_a_short_forecast_behind_a_long_one_of_few_agents_is_answered_first(
    network: Trajectron, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = application(network)
    app._batcher.pace = Fixed(1e-3)
    monkeypatch.setattr(running, "_SLICE_S", 0.1)
    begun, goes_on = threading.Event(), threading.Event()
    run_jobs = app._batcher._run

    def held(jobs: list[SceneJob]) -> Sequence[SceneResult]:
        if any(task.run for job in jobs for task in job.forecasts):
            begun.set()
            assert goes_on.wait(10.0)
        return run_jobs(jobs)

    app._batcher._run = held
    ended: list[str] = []

    async def ask(name: str, samples: int) -> None:
        await predict(app, walk(range(3), agents=("ann",)), ForecastOptions(num_samples=samples))
        ended.append(name)

    long = asyncio.create_task(ask("long", 2000))
    assert await asyncio.to_thread(begun.wait, 10.0)
    short = asyncio.create_task(ask("short", 2))
    await asyncio.sleep(0)
    goes_on.set()
    await asyncio.gather(long, short)
    assert ended == ["short", "long"]
    await app.close()
