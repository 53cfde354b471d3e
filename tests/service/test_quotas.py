"""Quotas by themselves: what a bucket gives, what is given back, what labels there may be."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from trajectron_service import quotas, tenancy
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.metrics import Metrics
from trajectron_service.quotas import Limit, Quotas, Rate, Usage, unlimited


@pytest.fixture(autouse=True)
def _tenant_of_this_test_only() -> Iterator[None]:
    before = tenancy._tenant.set("ann")
    yield
    tenancy._tenant.reset(before)


class Clock:
    """Stands still until it is moved."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def used(clock: Clock | None = None, **of_each: float) -> Usage:
    bounds = Quotas.model_validate(of_each)
    return Usage(lambda _: bounds, Metrics(), clock or Clock())


def wait_s(usage: Usage, rate: Rate, amount: float) -> float:
    """0 where it was taken."""
    try:
        usage.take(rate, amount)
    except ServiceError as error:
        told = error
    else:
        return 0.0
    assert told.kind is ErrorKind.RATE_LIMITED
    assert told.retry_after_s is not None
    return told.retry_after_s


def test_a_seconds_worth_is_saved_up_and_no_more() -> None:
    clock = Clock()
    usage = used(clock, frames_per_s=10)
    assert [wait_s(usage, Rate.FRAMES, 5) for _ in range(3)] == [0.0, 0.0, 0.5]
    clock.now = 0.3
    assert wait_s(usage, Rate.FRAMES, 5) == pytest.approx(0.2)
    clock.now = 100.0
    assert [wait_s(usage, Rate.FRAMES, 5) for _ in range(3)] == [0.0, 0.0, 0.5]


def test_who_comes_when_it_was_told_to_is_served() -> None:
    clock = Clock()
    usage = used(clock, points_per_s=1 / 3)
    assert wait_s(usage, Rate.POINTS, 1) == 0.0
    for _ in range(100):
        told_s = wait_s(usage, Rate.POINTS, 1)
        assert told_s == pytest.approx(3.0)
        clock.now += told_s
        assert wait_s(usage, Rate.POINTS, 1) == 0.0


def test_more_than_a_seconds_worth_is_owed() -> None:
    clock = Clock()
    usage = used(clock, points_per_s=100)
    assert wait_s(usage, Rate.POINTS, 300) == 0.0
    assert wait_s(usage, Rate.POINTS, 1) == pytest.approx(2.01)
    clock.now = 2.5
    assert wait_s(usage, Rate.POINTS, 300) == pytest.approx(0.5)


def test_what_is_refused_costs_nothing_and_faults_do() -> None:
    usage = used(frames_per_s=2)
    with pytest.raises(ServiceError, match="refused"), usage.taken(Rate.FRAMES, 2):
        raise ServiceError(ErrorKind.UNKNOWN_SESSION, "refused")
    with pytest.raises(RuntimeError), usage.taken(Rate.FRAMES, 2):
        raise RuntimeError
    assert wait_s(usage, Rate.FRAMES, 1) == 0.5


def test_what_is_given_back_does_not_add_up() -> None:
    usage = used(frames_per_s=2)
    usage.give_back(Rate.FRAMES, 1000)
    assert [wait_s(usage, Rate.FRAMES, 1) for _ in range(3)] == [0.0, 0.0, 0.5]


def test_tenants_have_each_their_own_and_a_new_rate_counts_at_once() -> None:
    bounds = {"ann": Quotas(requests_per_s=1), "bob": Quotas(requests_per_s=1)}
    usage = Usage(lambda tenant: bounds[tenant], Metrics(), Clock())
    assert wait_s(usage, Rate.REQUESTS, 1) == 0.0
    assert wait_s(usage, Rate.REQUESTS, 1) == 1.0
    tenancy.enter("bob")
    assert wait_s(usage, Rate.REQUESTS, 1) == 0.0
    tenancy.enter("ann")
    bounds["ann"] = Quotas(requests_per_s=4)
    assert wait_s(usage, Rate.REQUESTS, 4) == 0.0
    bounds["ann"] = Quotas()
    assert wait_s(usage, Rate.REQUESTS, 1e9) == 0.0


def test_streams_count_by_session_until_the_last_has_gone() -> None:
    usage = used(streams=2)
    with ExitStack() as first, ExitStack() as second:
        first.enter_context(usage.stream("a"))
        second.enter_context(usage.stream("a"))  # takes over
        first.enter_context(usage.stream("b"))
        with pytest.raises(ServiceError) as told, usage.stream("c"):
            pass
        assert told.value.kind is ErrorKind.TOO_MANY_STREAMS
        first.close()
        with usage.stream("c"), pytest.raises(ServiceError), usage.stream("d"):
            pass
        second.close()
        with usage.stream("c"), usage.stream("d"):
            pass


def test_nothing_is_bounded_that_no_quota_names() -> None:
    usage = unlimited(Metrics())
    for limit in Limit:
        usage.check(limit, 10**9)
    for rate in Rate:
        assert wait_s(usage, rate, 1e12) == 0.0
    with ExitStack() as stack:
        for number in range(1000):
            stack.enter_context(usage.stream(str(number)))


def test_many_tenants_share_a_label(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quotas, "_MOST_LABELS", 2)
    metrics = Metrics()
    usage = Usage(lambda _: Quotas(sessions=1), metrics)
    for tenant in ("a", "b", "c", "d", "a"):
        tenancy.enter(tenant)
        with pytest.raises(ServiceError):
            usage.check(Limit.SESSIONS, 1)
    found = {
        sample.labels["tenant"]: sample.value
        for family in metrics.registry.collect()
        for sample in family.samples
        if sample.name == "trajectron_quota_refusals_total"
    }
    assert found == {"a": 2.0, "b": 1.0, "(other)": 2.0}
