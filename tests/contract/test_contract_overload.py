"""What holds over both transports when there is too much to do, no time, or nobody there.

The inference thread is held at will, so that what waits and what is refused is certain.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import grpc
import httpx
import numpy as np
import pytest
import pytest_asyncio
from tests.contract.drivers import CODES, Driver, GrpcDriver, HttpDriver, RefusalError
from tests.contract.scenes import Json, walking
from tests.contract.servers import small_settings

from trajectron_service.lifecycle import Service, running
from trajectron_service.pace import Work

pytestmark = pytest.mark.asyncio(loop_scope="session")

TRANSPORTS = pytest.mark.parametrize("transport", ["http", "grpc"])
# Jobs that may wait; the model takes them one by one.
QUEUE_SIZE = 2


@asynccontextmanager
async def driver_to(service: Service, transport: str) -> AsyncIterator[Driver]:
    """A driver of a service's transport."""
    if transport == "http":
        url = f"http://127.0.0.1:{service.http_port}"
        async with httpx.AsyncClient(base_url=url, timeout=60.0) as client:
            yield HttpDriver(client)
    else:
        async with grpc.aio.insecure_channel(f"127.0.0.1:{service.grpc_port}") as channel:
            yield GrpcDriver(channel)


@asynccontextmanager
async def model_held(service: Service) -> AsyncIterator[None]:
    """Inside, the model does nothing."""
    release = threading.Event()
    batcher = service.application._batcher
    held = asyncio.create_task(batcher.run_alone(lambda: assert_released(release)))
    try:
        yield
    finally:
        release.set()
        await held


def assert_released(release: threading.Event) -> None:
    assert release.wait(60)


@pytest_asyncio.fixture(scope="module", loop_scope="session")
async def narrow(model_path: Path) -> AsyncIterator[Service]:
    """A service where hardly anything may wait."""
    settings = small_settings(model_path, queue_size=QUEUE_SIZE, max_batch_points=1)
    async with running(settings) as service:
        yield service


@pytest_asyncio.fixture(scope="module", loop_scope="session")
async def hasty(model_path: Path) -> AsyncIterator[Service]:
    """A service that gives a request hardly any time."""
    async with running(small_settings(model_path, request_timeout_s=0.1)) as service:
        yield service


async def jobs_waiting(service: Service, number: int) -> None:
    """Returns once that many jobs wait for the model."""
    async with asyncio.timeout(30):
        gauge = service.metrics.registry.get_sample_value
        while gauge("trajectron_queue_length") != number:  # noqa: ASYNC110  a gauge has no event
            await asyncio.sleep(0.001)


async def calls_in_hand(service: Service, number: int) -> None:
    """Returns once the application works on that many calls."""
    async with asyncio.timeout(30):
        while service.application._work.count != number:  # noqa: ASYNC110  a count has no event
            await asyncio.sleep(0.001)


async def call_with_the_model(service: Service, driver: Driver) -> asyncio.Task[Json]:
    """A call whose job the model, which is held, has taken off the queue."""
    call = asyncio.create_task(driver.predict(walking()))
    await calls_in_hand(service, 1)
    for _ in range(20):  # turns of the loop, which the service shares with this test
        await asyncio.sleep(0)
    await jobs_waiting(service, 0)
    return call


@TRANSPORTS
async def test_what_does_not_fit_the_queue_is_refused_at_once(
    narrow: Service, transport: str
) -> None:
    async with driver_to(narrow, transport) as driver:
        async with model_held(narrow):
            first = await call_with_the_model(narrow, driver)
            calls = {asyncio.create_task(driver.predict(walking())) for _ in range(9)}
            refused: set[asyncio.Task[Json]] = set()
            while len(refused) < 9 - QUEUE_SIZE:
                done, _ = await asyncio.wait(
                    calls - refused, return_when=asyncio.FIRST_COMPLETED, timeout=30
                )
                assert done
                refused |= done
        for call in refused:
            refusal = call.exception()
            assert isinstance(refusal, RefusalError)
            assert refusal.kind == "OVERLOADED"
            assert refusal.code == CODES["OVERLOADED"][transport]
            assert refusal.retry_after_s is not None
            assert refusal.retry_after_s > 0
        answered = await asyncio.gather(first, *calls - refused)
        assert [len(one["agents"]) for one in answered] == [3] * (1 + QUEUE_SIZE)


@TRANSPORTS
async def test_an_overload_leaves_a_session_as_it_was(narrow: Service, transport: str) -> None:
    async with driver_to(narrow, transport) as driver:
        await driver.create_session("busy")
        await driver.observe("busy", walking(2))
        async with model_held(narrow):
            noise = [await call_with_the_model(narrow, driver)]
            noise += [asyncio.create_task(driver.predict(walking())) for _ in range(QUEUE_SIZE)]
            await jobs_waiting(narrow, QUEUE_SIZE)
            with pytest.raises(RefusalError, match="OVERLOADED"):
                await driver.observe("busy", walking(3)[2:])
        await asyncio.gather(*noise)
        assert (await driver.get_session("busy"))["version"] == 2
        [result] = await driver.observe("busy", walking(3)[2:])
        assert (result["outcome"], result["version"]) == ("accepted", 3)
        await driver.delete_session("busy")


@TRANSPORTS
async def test_what_takes_too_long_is_given_up(hasty: Service, transport: str) -> None:
    async with driver_to(hasty, transport) as driver:
        async with model_held(hasty):
            with pytest.raises(RefusalError) as caught:
                await driver.predict(walking())
        assert caught.value.kind == "DEADLINE_EXCEEDED"
        assert caught.value.code == CODES["DEADLINE_EXCEEDED"][transport]
        assert await driver.list_models()


@TRANSPORTS
async def test_a_request_brings_a_deadline_of_its_own(narrow: Service, transport: str) -> None:
    async with driver_to(narrow, transport) as driver:
        async with model_held(narrow):
            with pytest.raises(RefusalError) as caught:
                await driver.predict(walking(), deadline_s=0.05)
        assert caught.value.kind == "DEADLINE_EXCEEDED"
        assert caught.value.code == CODES["DEADLINE_EXCEEDED"][transport]
        with pytest.raises(RefusalError) as caught:
            await driver.predict(walking(), deadline_s=0.0)
        assert (caught.value.kind, caught.value.fields) == ("INVALID_ARGUMENT", ("deadline_s",))


@TRANSPORTS
async def test_fewer_samples_come_in_time_where_that_is_allowed(
    narrow: Service, transport: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pace = narrow.application._batcher.pace
    # As if a sample of the three agents took two seconds.
    monkeypatch.setattr(pace, "_each_s", Work(1e-6, 1e-6, 2.0 / (3 * 4), 1e-6))
    monkeypatch.setattr(pace, "learn", lambda *_: None)
    monkeypatch.setattr(pace, "doubt", lambda *_: None)
    asked: Json = {"num_samples": 30, "horizon": 4, "seed": 7, "mode": "full"}
    async with driver_to(narrow, transport) as driver:
        with pytest.raises(RefusalError, match="DEADLINE_EXCEEDED"):
            await driver.predict(walking(), **asked, deadline_s=20.0)
        few = await driver.predict(walking(), **asked, deadline_s=20.0, allow_fewer_samples=True)
        await driver.create_session("hurried")
        await driver.observe("hurried", walking())
        again = await driver.predict_session(
            "hurried", **asked, deadline_s=20.0, allow_fewer_samples=True
        )
        await driver.delete_session("hurried")
        monkeypatch.undo()
        whole = await driver.predict(walking(), **asked)
    assert (whole["num_samples"], whole["fewer_samples"]) == (30, False)
    for forecast in (few, again):
        assert forecast["fewer_samples"]
        assert 1 <= forecast["num_samples"] < 10
        for agent, of_whole in zip(forecast["agents"], whole["agents"], strict=True):
            first = of_whole["samples"][: forecast["num_samples"]]
            np.testing.assert_allclose(agent["samples"], first, atol=1e-4)


@TRANSPORTS
async def test_whoever_hangs_up_is_not_worked_for(narrow: Service, transport: str) -> None:
    jobs_done = narrow.metrics.registry.get_sample_value
    before = jobs_done("trajectron_batch_jobs_sum") or 0.0
    async with driver_to(narrow, transport) as driver:
        async with model_held(narrow):
            first = await call_with_the_model(narrow, driver)
            gone = [asyncio.create_task(driver.predict(walking())) for _ in range(QUEUE_SIZE)]
            await jobs_waiting(narrow, QUEUE_SIZE)
            for call in gone:
                call.cancel()
            await asyncio.wait(gone)
            await calls_in_hand(narrow, 1)
        await asyncio.wait([first])
        await jobs_waiting(narrow, 0)
    assert jobs_done("trajectron_batch_jobs_sum") == before + 1
