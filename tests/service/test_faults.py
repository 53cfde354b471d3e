"""Faults that have no place of their own elsewhere; docs/faults.md lists all of them."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from tests.service.building import (
    QUICK,
    Clock,
    Loaded,
    application,
    config,
    observe_all,
    predict,
    same_forecast,
    walk,
)

from trajectron_model.trajectron import Trajectron
from trajectron_service import application as core
from trajectron_service.engine import Engine
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.lag import PERIOD_S, measure_lag
from trajectron_service.messages import Outcome
from trajectron_service.metrics import Metrics
from trajectron_service.scenes import SceneJob, SceneResult
from trajectron_service.stores import SessionKey, StoredSession
from trajectron_service.stores.memory import MemoryStore
from trajectron_service.stores.sqlite import SqliteStore

ROOT = Path(__file__).parents[2]


class Exhausted(Engine):
    """An engine that runs out of memory for scenes with a poisoned agent."""

    def run(self, jobs: Sequence[SceneJob]) -> list[SceneResult]:
        if any("poison" in step.frame.ids for job in jobs for step in job.steps):
            raise MemoryError
        return super().run(jobs)


async def test_a_poisoned_session_fails_alone_and_stays_as_it_was(network: Trajectron) -> None:
    app = application(network, engine=Exhausted([Loaded(network)]))
    for name in ("healthy", "poisoned"):
        await app.create_session(name, config())
        await observe_all(app, name, walk(range(2)))
    before = await app.predict_session("poisoned", QUICK, None)
    good, bad = walk([2]), walk([2], ("ann", "poison"))
    results = await asyncio.gather(
        app.observe("healthy", tuple(good), None),
        app.observe("poisoned", tuple(bad), None),
        return_exceptions=True,
    )
    assert isinstance(results[1], ServiceError) and results[1].kind is ErrorKind.INTERNAL
    assert not isinstance(results[0], BaseException)
    assert results[0][0].outcome is Outcome.ACCEPTED
    assert same_forecast(before, await app.predict_session("poisoned", QUICK, None))
    (again,) = await app.observe("poisoned", tuple(good), None)
    assert again.outcome is Outcome.ACCEPTED
    await app.close()


async def test_a_full_disk_refuses_frames_and_is_over_when_there_is_room(
    network: Trajectron, tmp_path: Path
) -> None:
    store = SqliteStore.open(tmp_path / "sessions")
    app = application(network, store=store)
    await app.create_session("s", config())
    await observe_all(app, "s", walk(range(2)))
    (pages,) = store._connection.execute("PRAGMA page_count").fetchone()
    store._connection.execute(f"PRAGMA max_page_count = {pages}")
    crowd = [f"agent-{number}" for number in range(200)]
    with pytest.raises(ServiceError) as refusal:
        await app.observe("s", tuple(walk([2], crowd)), None)
    assert refusal.value.kind is ErrorKind.STORE_UNAVAILABLE
    assert refusal.value.retry_after_s
    # What is in memory goes on to answer, as it was.
    assert len((await app.predict_session("s", QUICK, None)).agents) == 3
    store._connection.execute(f"PRAGMA max_page_count = {pages + 1000}")
    (result,) = await app.observe("s", tuple(walk([2], crowd)), None)
    assert (result.outcome, result.version) == (Outcome.ACCEPTED, 3)
    await app.close()
    await store.close()


def test_a_system_clock_that_steps_moves_no_expiry(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = core.steady_unix_clock()
    before, now = clock(), time.time()
    for step_s in (-86_400.0, 86_400.0):
        monkeypatch.setattr(time, "time", lambda step_s=step_s: now + step_s)
        assert 0.0 <= clock() - before < 60.0


async def test_a_blocked_event_loop_is_told_as_lag() -> None:
    lag = Metrics().loop_lag
    measuring = asyncio.create_task(measure_lag(lag))
    await asyncio.sleep(5 * PERIOD_S)
    before = lag._sum.get()
    time.sleep(0.3)  # noqa: ASYNC251 - blocking the loop is the point
    await asyncio.sleep(PERIOD_S)
    assert lag._sum.get() - before >= 0.3 - PERIOD_S
    measuring.cancel()


async def test_a_store_that_is_slow_delays_its_own_session_only(network: Trajectron) -> None:
    gate = asyncio.Event()

    class Slow(MemoryStore):
        async def write(self, key: SessionKey, session: StoredSession, expected: str) -> bool:
            if key.id == "slow":
                await gate.wait()
            return await super().write(key, session, expected)

    app = application(network, store=Slow(durable=True), clock=Clock())
    for name in ("slow", "quick"):
        await app.create_session(name, config())
    waiting = asyncio.create_task(app.observe("slow", tuple(walk([0])), None))
    for step in range(3):
        (result,) = await app.observe("quick", tuple(walk([step])), None)
        assert result.outcome is Outcome.ACCEPTED
    await predict(app, walk(range(2)))
    assert not waiting.done(), "acknowledged before it was safe"
    gate.set()
    (result,) = await waiting
    assert result.outcome is Outcome.ACCEPTED
    await app.close()


def test_every_test_that_the_table_of_faults_names_exists() -> None:
    page = (ROOT / "docs" / "faults.md").read_text()
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", page)
    assert len(named) > 15
    for file, test in named:
        assert re.search(rf"def {test}\(", (ROOT / file).read_text()), f"{file}::{test}"


def test_every_metric_that_the_table_of_faults_names_exists() -> None:
    page, listed = ((ROOT / "docs" / name).read_text() for name in ("faults.md", "metrics.md"))
    named = set(re.findall(r"`(trajectron_\w+)", page))
    assert len(named) > 8
    assert named <= set(re.findall(r"^\| `(trajectron_\w+)`", listed, re.MULTILINE))
