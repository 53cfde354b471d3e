"""The queue before the model: order, fairness, deadlines, cost, bounds, faults."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

import pytest
from tests.service.building import Clock, turns

from trajectron_service.batching import Batcher, BatchReport, Closed, Expired, QueueFull


class Gate:
    """A ``run`` that notes its batches and waits until it is let through."""

    def __init__(self, shut: bool = False) -> None:
        self.batches: list[list[str]] = []
        self.threads: set[str] = set()
        self.open = threading.Event()
        self.entered = threading.Event()
        if not shut:
            self.open.set()

    def __call__(self, jobs: list[str]) -> Sequence[str]:
        self.threads.add(threading.current_thread().name)
        self.batches.append(list(jobs))
        self.entered.set()
        assert self.open.wait(5.0)
        if any(job.startswith("bad") for job in jobs):
            raise ValueError(f"cannot do {jobs}")
        return [job.upper() for job in jobs]


@asynccontextmanager
async def batching(gate: Gate, **changes: Any) -> AsyncIterator[Batcher[str, str]]:
    options = {"queue_size": 100, "max_batch_cost": 100.0, **changes}
    batcher = Batcher[str, str](gate, **options)
    try:
        yield batcher
    finally:
        gate.open.set()
        await batcher.close()


@asynccontextmanager
async def busy(**changes: Any) -> AsyncIterator[tuple[Batcher[str, str], Gate]]:
    """A batcher whose first batch is running and stays so until the gate opens."""
    gate = Gate(shut=True)
    async with batching(gate, **changes) as batcher:
        first = asyncio.create_task(batcher.submit("first"))
        await asyncio.to_thread(gate.entered.wait, 5.0)
        yield batcher, gate
        gate.open.set()
        await first


async def test_what_waits_is_taken_at_once_and_results_find_their_way() -> None:
    gate = Gate()
    async with batching(gate) as batcher:
        results = await asyncio.gather(*(batcher.submit(job) for job in "abc"))
    assert results == ["A", "B", "C"]
    assert gate.batches == [["a", "b", "c"]]


async def test_what_comes_while_a_batch_runs_forms_the_next() -> None:
    async with busy() as (batcher, gate):
        later = [asyncio.create_task(batcher.submit(job)) for job in "abc"]
        await turns()
        gate.open.set()
        await asyncio.gather(*later)
    assert gate.batches == [["first"], ["a", "b", "c"]]


async def test_everything_runs_on_one_thread() -> None:
    gate = Gate()
    async with batching(gate) as batcher:
        for job in "abcdef":
            await batcher.submit(job)
    assert len(gate.threads) == 1
    assert threading.current_thread().name not in gate.threads


async def test_entries_of_a_session_keep_their_order_and_never_share_a_batch() -> None:
    async with busy() as (batcher, gate):
        urgent_last = [
            asyncio.create_task(batcher.submit(f"s{k}", key="s", deadline=batcher_deadline(9 - k)))
            for k in range(3)
        ]
        await turns()
        gate.open.set()
        await asyncio.gather(*urgent_last)
    assert gate.batches == [["first"], ["s0"], ["s1"], ["s2"]]


def batcher_deadline(after_s: float) -> float:
    return asyncio.get_running_loop().time() + 100.0 + after_s


async def test_a_session_with_much_waiting_takes_turns() -> None:
    async with busy(max_batch_cost=1.0) as (batcher, gate):
        greedy = [batcher.submit(f"g{k}", key="g", deadline=batcher_deadline(0)) for k in range(3)]
        modest = [batcher.submit("m", key="m", deadline=batcher_deadline(50))]
        tasks = [asyncio.ensure_future(one) for one in (*greedy, *modest)]
        await turns()
        gate.open.set()
        await asyncio.gather(*tasks)
    assert gate.batches[1:] == [["g0"], ["m"], ["g1"], ["g2"]]


async def test_the_earliest_deadline_goes_first() -> None:
    async with busy(max_batch_cost=1.0) as (batcher, gate):
        after = {"never": None, "late": batcher_deadline(9), "soon": batcher_deadline(1)}
        tasks = [asyncio.ensure_future(batcher.submit(j, deadline=d)) for j, d in after.items()]
        await turns()
        gate.open.set()
        await asyncio.gather(*tasks)
    assert gate.batches[1:] == [["soon"], ["late"], ["never"]]


async def test_a_huge_job_joins_nobody() -> None:
    async with busy(max_batch_cost=10.0) as (batcher, gate):
        costs = {"a": 4.0, "b": 4.0, "huge": 1000.0, "c": 4.0}
        tasks = [asyncio.ensure_future(batcher.submit(j, cost=c)) for j, c in costs.items()]
        await turns()
        gate.open.set()
        await asyncio.gather(*tasks)
    assert gate.batches[1:] == [["a", "b"], ["huge"], ["c"]]


async def test_cancelled_work_never_runs() -> None:
    async with busy() as (batcher, gate):
        gone = asyncio.create_task(batcher.submit("gone"))
        kept = asyncio.create_task(batcher.submit("kept"))
        await turns()
        gone.cancel()
        gate.open.set()
        assert await kept == "KEPT"
        with pytest.raises(asyncio.CancelledError):
            await gone
    assert gate.batches == [["first"], ["kept"]]


async def test_expired_work_never_runs() -> None:
    clock = Clock(0.0)
    async with busy(clock=clock) as (batcher, gate):
        late = asyncio.create_task(batcher.submit("late", deadline=1000.0))
        kept = asyncio.create_task(batcher.submit("kept", deadline=3000.0))
        await turns()
        clock.now = 2000.0
        gate.open.set()
        assert await kept == "KEPT"
        with pytest.raises(Expired):
            await late
        with pytest.raises(Expired):
            await batcher.submit("too late", deadline=1999.0)
    assert gate.batches == [["first"], ["kept"]]


async def test_a_deadline_is_answered_when_it_passes_not_when_the_queue_gets_there() -> None:
    async with busy() as (batcher, _):
        soon = asyncio.get_running_loop().time() + 0.01
        with pytest.raises(Expired):
            await batcher.submit("soon", deadline=soon)


async def test_a_full_queue_refuses_at_once_and_says_when_to_come_back() -> None:
    async with busy(queue_size=2) as (batcher, gate):
        waiting = [asyncio.create_task(batcher.submit(job)) for job in "ab"]
        await turns()
        assert batcher.waiting == 2
        with pytest.raises(QueueFull) as refusal:
            await batcher.submit("c")
        assert refusal.value.retry_after_s > 0.0
        gate.open.set()
        assert await asyncio.gather(*waiting) == ["A", "B"]
        assert await batcher.submit("d") == "D"


@pytest.mark.parametrize("key", [None, "s"])
async def test_cancelled_work_frees_its_place_while_a_batch_runs(key: str | None) -> None:
    async with busy(queue_size=2) as (batcher, gate):
        gone, kept = (asyncio.create_task(batcher.submit(job, key=key)) for job in ("gone", "kept"))
        await turns()
        gone.cancel()
        with pytest.raises(asyncio.CancelledError):
            await gone
        assert batcher.waiting == 1
        new = asyncio.create_task(batcher.submit("new", key=key))
        await turns()
        assert batcher.waiting == 2
        with pytest.raises(QueueFull):
            await batcher.submit("beyond")
        gate.open.set()
        assert [await kept, await new] == ["KEPT", "NEW"]
        assert batcher.waiting == 0


async def test_work_that_expires_frees_its_place_while_a_batch_runs() -> None:
    async with busy(queue_size=1) as (batcher, gate):
        soon = asyncio.get_running_loop().time() + 0.01
        with pytest.raises(Expired):
            await batcher.submit("soon", deadline=soon)
        kept = asyncio.create_task(batcher.submit("kept"))
        await turns()
        gate.open.set()
        assert await kept == "KEPT"
    assert gate.batches == [["first"], ["kept"]]


async def test_a_queue_that_all_have_left_is_empty_and_works_on() -> None:
    async with busy() as (batcher, gate):
        tasks = [asyncio.create_task(batcher.submit("gone", key="s")) for _ in range(3)]
        await turns()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        assert not batcher.waiting
        assert not batcher._lines
        gate.open.set()
        assert await batcher.submit("next", key="s") == "NEXT"
    assert gate.batches == [["first"], ["next"]]


async def test_only_the_guilty_fail() -> None:
    gate = Gate()
    async with batching(gate) as batcher:
        jobs = ["a", "bad", "c"]
        results = await asyncio.gather(*map(batcher.submit, jobs), return_exceptions=True)
        assert results[0] == "A"
        assert isinstance(results[1], ValueError)
        assert results[2] == "C"
        assert await batcher.submit("next") == "NEXT"
    assert gate.batches == [jobs, ["a"], ["bad"], ["c"], ["next"]]


async def test_a_single_guilty_job_is_not_tried_again() -> None:
    gate = Gate()
    async with batching(gate) as batcher:
        with pytest.raises(ValueError, match="cannot do"):
            await batcher.submit("bad")
    assert gate.batches == [["bad"]]


async def test_closing_finishes_what_waits_and_refuses_the_rest() -> None:
    gate = Gate(shut=True)
    async with batching(gate) as batcher:
        waiting = asyncio.create_task(batcher.submit("a"))
        await turns()
        closing = asyncio.create_task(batcher.close())
        await turns()
        with pytest.raises(Closed):
            await batcher.submit("b")
        gate.open.set()
        await closing
        assert await waiting == "A"


async def test_batches_are_reported() -> None:
    reports: list[BatchReport] = []
    clock = Clock(0.0)
    async with batching(Gate(), report=reports.append, clock=clock) as batcher:
        await asyncio.gather(*(batcher.submit(job) for job in "ab"))
    assert [(r.entries, r.waited_s) for r in reports] == [(2, (0.0, 0.0))]


async def test_nothing_is_kept_of_work_that_is_done() -> None:
    async with batching(Gate()) as batcher:
        for k in range(20):
            await batcher.submit("a", key=k % 3)
            await batcher.submit("b")
        assert not batcher._lines
