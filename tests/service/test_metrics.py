"""Metrics: bounded in number, listed in the documentation."""

from __future__ import annotations

import asyncio

import pytest
from scripts import metrics_page
from tests.service.building import QUICK, Clock, application, predict, walk

from trajectron_model.trajectron import Trajectron
from trajectron_service.application import Application
from trajectron_service.errors import ServiceError
from trajectron_service.messages import Agent, Frame, SessionConfig

SESSIONS = 10_000
AT_ONCE = 500


def series(app: Application) -> set[tuple[str, tuple[tuple[str, str], ...]]]:
    """Every series of the registry, by name and labels."""
    return {
        (sample.name, tuple(sorted(sample.labels.items())))
        for family in app.metrics.registry.collect()
        for sample in family.samples
    }


async def use(app: Application, name: str, clock: Clock) -> None:
    """All that a session can meet: frames, forecasts scored, refusals, its ends."""
    await app.create_session(name, SessionConfig())
    for one in walk(range(8), (f"{name}-a", f"{name}-b")):
        await app.observe(name, (one,), None)
        await app.predict_session(name, QUICK, None)
    (late,) = walk([1])
    with pytest.raises(ServiceError):
        await app.observe(name, (late,), None)
    with pytest.raises(ServiceError):
        await app.create_session(name, SessionConfig())
    await predict(app, walk(range(2)))
    await app.create_session(f"{name}-idle", SessionConfig())
    await app.delete_session(name)
    clock.now += 1e4
    await app._sessions.reap()


async def test_ten_thousand_sessions_leave_as_many_series_as_a_few(network: Trajectron) -> None:
    clock = Clock()
    app = application(network, clock=clock, live_accuracy_budget=1000.0, queue_size=AT_ONCE)
    await use(app, "first", clock)
    assert app._accuracy is not None
    await app._accuracy.settled()
    before = series(app)
    assert any(name == "trajectron_accuracy_steps_total" for name, _ in before)

    async def open_one(number: int) -> None:
        name = f"session-{number}"
        await app.create_session(name, SessionConfig())
        if number % 10 == 0:
            await app.observe(name, (Frame(0.0, (Agent(name, "pedestrian", 0.0, 0.0),)),), None)

    for first in range(0, SESSIONS, AT_ONCE):
        await asyncio.gather(*map(open_one, range(first, first + AT_ONCE)))
    assert app.metrics.registry.get_sample_value("trajectron_sessions") == SESSIONS
    clock.now += 1e4
    for _ in range(SESSIONS // 1000):
        await app._sessions.reap()
    await use(app, "last", clock)
    await app._accuracy.settled()
    assert app.metrics.registry.get_sample_value("trajectron_sessions") == 0
    assert series(app) == before
    await app.close()


def test_the_page_of_metrics_lists_what_the_registry_has() -> None:
    page = metrics_page.PAGE.read_text(encoding="utf-8")
    assert metrics_page.with_table(page) == page, "run python scripts/metrics_page.py"
    names = [line.split("`")[1] for line in page.splitlines() if line.startswith("| `trajectron_")]
    assert len(names) == len(metrics_page.instruments()) > 30


def test_no_metric_has_a_label_for_ids() -> None:
    """Tenants are names of the operator's, and there are at most so many labels of them."""
    instruments = {metrics_page._row(one)[0]: one for one in metrics_page.instruments()}
    bounded = instruments.pop("trajectron_quota_refusals_total")
    assert bounded._labelnames == ("tenant", "quota")
    labels = {label for one in instruments.values() for label in one._labelnames}
    assert not labels & {"session", "session_id", "agent", "agent_id", "client", "path", "tenant"}
