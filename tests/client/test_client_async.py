"""The asyncio clients against the real service, both transports alike."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator

import numpy as np
import pytest
import pytest_asyncio
from tests.client.crowd import frame, walking
from tests.process import Served

import trajectron_client as tc
from trajectron_client.async_calls import AsyncCalls

pytestmark = pytest.mark.asyncio(loop_scope="session")  # grpc.aio wants one loop in a process


@pytest_asyncio.fixture(params=["grpc", "http"], loop_scope="session")
async def client(request: pytest.FixtureRequest, served: Served) -> AsyncIterator[AsyncCalls]:
    if request.param == "grpc":
        async with tc.AsyncClient(served.grpc_target, timeout_s=30.0) as over_grpc:
            yield over_grpc
    else:
        async with tc.AsyncHttpClient(served.http_url, timeout_s=30.0) as over_http:
            yield over_http


async def test_it_answers_as_the_synchronous_client_does(
    client: AsyncCalls, served: Served
) -> None:
    forecast = await client.predict(walking(), num_samples=4, seed=3)
    with tc.HttpClient(served.http_url) as twin:
        expected = await asyncio.to_thread(twin.predict, walking(), num_samples=4, seed=3)
    for agent in forecast:
        samples = expected[agent.id].samples
        assert agent.samples is not None
        assert samples is not None
        np.testing.assert_allclose(agent.samples, samples, atol=1e-4)


async def test_many_calls_at_a_time(client: AsyncCalls) -> None:
    forecasts = await asyncio.gather(
        *(client.predict(walking(people=1 + n), seed=n, num_samples=2) for n in range(8))
    )
    assert [len(forecast) for forecast in forecasts] == list(range(1, 9))
    assert [forecast.seed for forecast in forecasts] == list(range(8))


async def test_a_session_lives_for_its_block(client: AsyncCalls) -> None:
    async with client.session() as session:
        assert (await session.observe(frame(0))).outcome is tc.Outcome.ACCEPTED
        assert len(await session.observe_all([frame(1), frame(2)])) == 2
        assert (await session.predict(mode="gmm"))["0"].mean is not None
        assert (await session.describe()).info.version == 3
        assert session.id in [info.id async for info in client.list_sessions(page_size=1)]
    with pytest.raises(tc.UnknownSessionError):
        await session.describe()


async def test_a_block_that_fails_deletes_its_session(client: AsyncCalls) -> None:
    opened = []

    async def fail() -> None:
        async with client.session() as session:
            opened.append(session.id)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await fail()
    with pytest.raises(tc.UnknownSessionError):
        await client.get_session(opened[0])


async def test_errors_come_as_their_own_classes(client: AsyncCalls) -> None:
    with pytest.raises(tc.UnknownModelError):
        await client.predict(walking(), model="no-such-model")
    with pytest.raises(tc.DeadlineExceededError):
        await client.predict(walking(), num_samples=2000, horizon=60, timeout_s=0.001)
    name = f"taken-{type(client).__name__}"
    async with client.session(name):
        with pytest.raises(tc.SessionExistsError):
            await client.create_session(name)


async def test_models_and_readiness(client: AsyncCalls) -> None:
    await client.wait_until_ready(10.0)
    assert await client.is_ready()
    assert [model.name for model in await client.list_models()] == ["small"]


async def test_cancelling_the_task_is_a_cancelled_task(client: AsyncCalls) -> None:
    task = asyncio.create_task(client.predict(walking(), num_samples=2000, horizon=60))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_where_nobody_answers() -> None:
    with socket.socket() as taken:  # bound, but nobody listens
        taken.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{taken.getsockname()[1]}"
        async with tc.AsyncClient(place) as grpc, tc.AsyncHttpClient(f"http://{place}") as http:
            for one in (grpc, http):
                assert not await one.is_ready()
                with pytest.raises(tc.TransportError):
                    await one.list_models()
                with pytest.raises(tc.DeadlineExceededError):
                    await one.wait_until_ready(0.3)
