"""Whether the service takes work: one state, told over both transports."""

from __future__ import annotations

import enum

from grpc_health.v1.health import aio
from grpc_health.v1.health_pb2 import HealthCheckResponse


class Phase(enum.Enum):
    """The life of the process, in order."""

    STARTING = "starting"
    READY = "ready"
    DRAINING = "draining"


class Health:
    """The phase; ``servicer`` tells it as ``grpc.health.v1``, ``/readyz`` over HTTP.

    Args:
        services: the full names of the gRPC services whose health this is.
    """

    def __init__(self, *services: str) -> None:
        self.phase = Phase.STARTING
        self.servicer = aio.HealthServicer()
        self._services = ("", *services)

    async def starting(self) -> None:
        """Not yet: models are being loaded and warmed up."""
        await self._tell(HealthCheckResponse.NOT_SERVING)

    async def ready(self) -> None:
        """Work is welcome."""
        self.phase = Phase.READY
        await self._tell(HealthCheckResponse.SERVING)

    async def draining(self) -> None:
        """Work in hand finishes, no more is taken; there is no way back."""
        self.phase = Phase.DRAINING
        await self.servicer.enter_graceful_shutdown()

    async def _tell(self, status: int) -> None:
        for service in self._services:
            await self.servicer.set(service, status)
