"""The real servers, once for all contract tests, on loopback and on free ports."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
import pytest_asyncio
from tests.contract.drivers import Driver, GrpcDriver, HttpDriver
from tests.contract.servers import save_small_model, small_settings

from trajectron_service.evaluations import jobs, queue
from trajectron_service.lifecycle import Service, running
from trajectron_service.settings import Settings


@pytest.fixture(scope="session")
def model_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real model with random weights of one seed, as a checkpoint."""
    return save_small_model(tmp_path_factory.mktemp("models") / "small")


@pytest.fixture(scope="session")
def settings(model_path: Path) -> Settings:
    """Free ports; limits small enough to reach them quickly."""
    return small_settings(model_path)


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def service(settings: Settings) -> AsyncIterator[Service]:
    """The service, ready."""
    async with running(settings) as service:
        yield service


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def http(service: Service) -> AsyncIterator[httpx.AsyncClient]:
    """A client of the HTTP server."""
    async with httpx.AsyncClient(
        base_url=f"http://127.0.0.1:{service.http_port}", timeout=60.0
    ) as client:
        yield client


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def channel(service: Service) -> AsyncIterator[grpc.aio.Channel]:
    """A channel to the gRPC server, without limits of its own."""
    async with grpc.aio.insecure_channel(
        f"127.0.0.1:{service.grpc_port}",
        options=[
            ("grpc.max_receive_message_length", -1),
            ("grpc.max_send_message_length", -1),
        ],
    ) as channel:
        yield channel


@pytest.fixture(params=["http", "grpc"])
def driver(
    request: pytest.FixtureRequest, http: httpx.AsyncClient, channel: grpc.aio.Channel
) -> Driver:
    """Each transport in turn."""
    return HttpDriver(http) if request.param == "http" else GrpcDriver(channel)


@pytest.fixture
def drivers(http: httpx.AsyncClient, channel: grpc.aio.Channel) -> tuple[Driver, Driver]:
    """Both transports, to compare them."""
    return HttpDriver(http), GrpcDriver(channel)


@pytest.fixture
def endless_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluations take any recording and run until they are cancelled."""

    async def forever(*_: Any) -> None:
        await asyncio.Event().wait()

    async def readable(*_: Any) -> None:
        pass

    monkeypatch.setattr(queue, "carry_out", forever)
    monkeypatch.setattr(jobs, "check_recordings", readable)
