"""Work under a learned pace: refusals before any cost, slices, and what goes first."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import socket
import threading
from collections.abc import Sequence

import numpy as np
import pytest
from tests.service.building import Clock, application, predict, same_forecast, turns, walk

from trajectron_model.trajectron import Trajectron
from trajectron_service import running
from trajectron_service.batching import Batcher, Part, QueueFull, TooLate
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.http_server import listen
from trajectron_service.messages import ForecastOptions, Sampling
from trajectron_service.pace import Pace, Work


class Held:
    """A ``run`` whose first batch waits until it is let go; each job is its own result."""

    def __init__(self) -> None:
        self.batches: list[list[str]] = []
        self.entered = threading.Event()
        self.release = threading.Event()

    def __call__(self, jobs: list[str]) -> Sequence[str]:
        self.batches.append(list(jobs))
        self.entered.set()
        assert self.release.wait(5.0)
        return jobs


def parts(name: str, count: int, samples: float = 0.0) -> list[Part[str]]:
    return [Part(f"{name}{k}", 1.0, Work(jobs=1.0, samples=samples)) for k in range(count)]


def batcher(held: Held, clock: Clock, queue_size: int = 100) -> Batcher[str, str]:
    return Batcher(held, queue_size=queue_size, max_batch_cost=1.0, clock=clock)


async def run_after_first(
    batches: Batcher[str, str], held: Held, *calls: tuple[list[Part[str]], float | None, bool]
) -> list[list[str]]:
    """Submits all while a first batch runs; the batches that followed."""
    first = asyncio.create_task(batches.submit("first"))
    await asyncio.to_thread(held.entered.wait, 5.0)
    tasks = []
    for given, deadline, urgent in calls:
        tasks.append(
            asyncio.create_task(batches.submit_parts(given, deadline=deadline, urgent=urgent))
        )
        await turns()
    held.release.set()
    await asyncio.gather(first, *tasks)
    await batches.close()
    return held.batches[1:]


async def test_short_work_gets_in_between_the_parts_of_long_work() -> None:
    held = Held()
    ran = await run_after_first(
        batcher(held, Clock(0.0)),
        held,
        (parts("long", 3), None, False),
        (parts("a", 1), None, False),
        (parts("b", 1), None, False),
    )
    assert ran == [["a0", "long0"], ["b0", "long1"], ["long2"]]


async def test_long_work_that_has_begun_is_finished_first() -> None:
    held = Held()
    ran = await run_after_first(
        batcher(held, Clock(0.0)),
        held,
        (parts("x", 2), 100.0, False),
        (parts("y", 2), 100.0, False),
        (parts("z", 2), 100.0, False),
    )
    assert ran == [["x0"], ["x1"], ["y0"], ["y1"], ["z0"], ["z1"]]


@pytest.mark.parametrize(
    ("deadline", "then"), [(11.5, "urgent"), (90.0, "begun")], ids=["cannot wait", "can wait"]
)
async def test_begun_work_waits_only_for_what_cannot_wait(deadline: float, then: str) -> None:
    clock, held = Clock(0.0), Held()
    batches = batcher(held, clock)
    second = 1.0 / batches.pace.seconds(Work(samples=1.0))  # as many samples as take a second
    submitted: list[asyncio.Task[list[str]]] = []

    def run(jobs: list[str]) -> Sequence[str]:
        held(jobs)
        if jobs == ["begun0"]:
            arrived.set()
            assert goes_on.wait(5.0)
        return jobs

    arrived, goes_on = threading.Event(), threading.Event()
    batches._run = run
    batches.pace.learn = lambda *_: None  # type: ignore[method-assign]  # the clock stands
    held.release.set()
    begun = batches.submit_parts(parts("begun", 11, second), deadline=100.0)
    submitted.append(asyncio.create_task(begun))
    await asyncio.to_thread(arrived.wait, 5.0)
    # Ready before the other by its deadline; 10 s of the other are left.
    other = batches.submit_parts(parts("urgent", 2, second), deadline=deadline)
    clock.now = 0.0 if then == "begun" else 1.0
    batches._busy_until = 0.0
    batches.check = lambda *_, **__: None  # type: ignore[method-assign]  # admitted all the same
    submitted.append(asyncio.create_task(other))
    await turns()
    goes_on.set()
    await asyncio.gather(*submitted)
    await batches.close()
    assert held.batches[1][0].startswith(then)


async def test_frames_to_observe_go_before_forecasts() -> None:
    held = Held()
    ran = await run_after_first(
        batcher(held, Clock(0.0)),
        held,
        (parts("forecast", 1), 10.0, False),
        (parts("frame", 1), None, True),
    )
    assert ran == [["frame0"], ["forecast0"]]


async def test_what_would_be_late_is_refused_before_it_costs_anything() -> None:
    held = Held()
    held.release.set()
    batches = batcher(held, Clock(0.0))
    slow = parts("slow", 1, samples=1e9)
    with pytest.raises(TooLate) as refusal:
        await batches.submit_parts(slow, deadline=1.0)
    assert refusal.value.own_s > refusal.value.left_s == 1.0
    assert not held.batches
    await batches.submit_parts(slow, deadline=1e6)
    assert held.batches == [["slow0"]]
    await batches.close()


async def test_the_queue_counts_against_a_deadline() -> None:
    held = Held()
    batches = batcher(held, Clock(0.0))
    second = 1.0 / batches.pace.seconds(Work(samples=1.0))
    first = asyncio.create_task(batches.submit("first"))
    await asyncio.to_thread(held.entered.wait, 5.0)
    waits = asyncio.create_task(batches.submit_parts(parts("a", 1, 3 * second), deadline=3.4))
    await turns()
    with pytest.raises(TooLate) as refusal:
        await batches.submit_parts(parts("b", 1, second), deadline=3.6)
    assert refusal.value.queue_s == pytest.approx(3.0, rel=0.01)
    held.release.set()
    await asyncio.gather(first, waits)
    await batches.close()


async def test_estimates_that_refuse_everything_give_in() -> None:
    held = Held()
    held.release.set()
    batches = batcher(held, Clock(0.0))
    for _ in range(100):
        batches.pace.learn([Work(jobs=1.0, samples=100.0)], 1.0)
    refused = 0
    while not held.batches:
        try:
            await batches.submit_parts(parts("a", 1, 100.0), deadline=0.5)
        except TooLate:
            refused += 1
            assert refused < 50
    assert refused > 0
    await batches.close()


def test_the_pace_of_each_kind_is_learned() -> None:
    pace = Pace()
    true = Work(jobs=2e-4, steps=1e-5, samples=2e-6, modes=5e-6)
    for k in range(2000):
        work = Work(1.0 + k % 5, 40.0 * (k % 3), 10_000.0 * (k % 2), 500.0 * (k % 7))
        took = 5e-4 + sum(a * s for a, s in zip(work, true, strict=True))
        pace.learn([work], took)
    assert pace.seconds(Work(samples=96_000.0)) == pytest.approx(0.192, rel=0.1)
    assert pace.seconds(Work(modes=6000.0)) == pytest.approx(0.03, rel=0.25)


async def test_refusals_leave_nothing_for_the_cyclic_collector() -> None:
    held = Held()
    batches = batcher(held, Clock(0.0), queue_size=1)
    first = asyncio.create_task(batches.submit("first"))
    await asyncio.to_thread(held.entered.wait, 5.0)
    waits = asyncio.create_task(batches.submit("waits"))
    await turns()

    async def refuse() -> None:
        for _ in range(50):
            with contextlib.suppress(QueueFull):
                await batches.submit("too much")

    await refuse()
    gc.collect()
    gc.disable()
    try:
        await refuse()
        assert gc.collect() < 50
    finally:
        gc.enable()
    held.release.set()
    await asyncio.gather(first, waits)
    await batches.close()


@pytest.mark.parametrize("sampling", Sampling)
async def test_slices_give_the_samples_of_the_whole(
    network: Trajectron, monkeypatch: pytest.MonkeyPatch, sampling: Sampling
) -> None:
    options = ForecastOptions(
        num_samples=50, horizon=6, seed=7, include_modes=True, sampling=sampling
    )
    frames = walk(range(5), agents=("ann", "bob", "cat", "dan", "eve"))
    app = application(network)
    whole = await predict(app, frames, options)
    batches = app._metrics.registry.get_sample_value
    before = batches("trajectron_batch_jobs_sum") or 0.0
    whole_s = app._batcher.pace.seconds(Work(samples=50.0 * 6 * len(whole.agents)))
    monkeypatch.setattr(running, "_SLICE_S", whole_s / 15)
    monkeypatch.setattr(app._batcher.pace, "learn", lambda *_: None)
    sliced = await predict(app, frames, options)
    jobs = (batches("trajectron_batch_jobs_sum") or 0.0) - before
    # The steps, then each agent with its samples in runs: three at least, more for the modes.
    assert jobs >= 1 + 5 * 3
    assert (jobs - 1) % 5 == 0
    assert same_forecast(whole, sliced, tolerance_m=1e-5)
    for one, other in zip(whole.agents, sliced.agents, strict=True):
        assert one.sample_modes is not None
        assert other.sample_modes is not None
        assert np.array_equal(one.sample_modes, other.sample_modes)
    await app.close()


async def test_a_forecast_that_would_be_late_is_an_error_of_its_kind(network: Trajectron) -> None:
    app = application(network)
    for _ in range(60):
        app._batcher.pace.learn([Work(jobs=1.0, samples=900.0)], 60.0)
    asked = ForecastOptions(num_samples=100, horizon=12, seed=7)
    with pytest.raises(ServiceError, match="would be late") as refusal:
        await predict(app, walk(range(3)), asked)
    assert refusal.value.kind is ErrorKind.DEADLINE_EXCEEDED
    await app.close()


async def test_answers_are_not_held_back_for_acknowledgements() -> None:
    delays: list[int] = []

    async def on_connection(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = writer.get_extra_info("socket")
        delays.append(peer.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
        writer.close()

    listener = listen("127.0.0.1", 0)
    async with await asyncio.start_server(on_connection, sock=listener):
        reader, writer = await asyncio.open_connection(*listener.getsockname())
        await reader.read()
        writer.close()
    assert delays == [1]
