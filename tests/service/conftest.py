"""What the tests of the service's core share."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
import torch
from tests.service.building import application, random_network

from trajectron_model.trajectron import Trajectron
from trajectron_service import logs
from trajectron_service.application import Application


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def _plain_logs() -> None:
    logs.configure("error", "json")


@pytest.fixture(scope="session")
def network() -> Trajectron:
    """A real network with random weights of one seed."""
    return random_network()


@pytest_asyncio.fixture
async def app(network: Trajectron) -> AsyncIterator[Application]:
    """An application over it, with the default settings."""
    built = application(network)
    yield built
    await built.close()
