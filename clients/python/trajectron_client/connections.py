"""The connections to a service's replicas: one is used until it fails, then the next."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import grpc
from grpc_health.v1 import health_pb2_grpc

from trajectron_client import evaluation_operations, operations
from trajectron_client.exceptions import (
    DrainingError,
    StoreUnavailableError,
    TrajectronError,
    TransportError,
)
from trajectron_client.operations import Operation
from trajectron_client.resuming import Reopening
from trajectron_proto.v1 import evaluation_pb2_grpc, trajectron_pb2_grpc

ChannelT = TypeVar("ChannelT", grpc.Channel, grpc.aio.Channel)

# 200 samples x 12 steps of 2000 agents are 38 MB.
_MAX_ANSWER_BYTES = 64 * 1024 * 1024
# Calls that change nothing, so that sending one twice does no harm.
_SAFE_TO_REPEAT = {
    operations.SERVICE: (
        "Predict", "PredictSession", "GetSession", "ListSessions", "ListModels",
    ),
    evaluation_operations.SERVICE: ("GetEvaluation", "ListEvaluations", "GetEvaluationResult"),
}  # fmt: skip
_SERVICE_CONFIG = {
    "methodConfig": [
        {
            "name": [
                {"service": service, "method": method}
                for service, methods in _SAFE_TO_REPEAT.items()
                for method in methods
            ],
            "retryPolicy": {
                "maxAttempts": 4,
                "initialBackoff": "0.05s",
                "maxBackoff": "1s",
                "backoffMultiplier": 2,
                "retryableStatusCodes": ["UNAVAILABLE"],
            },
        }
    ]
}
_OPTIONS: dict[str, Any] = {
    "grpc.max_receive_message_length": _MAX_ANSWER_BYTES,
    "grpc.service_config": json.dumps(_SERVICE_CONFIG),
    # A peer that is silently gone is noticed after 15 s, with a call open.
    "grpc.keepalive_time_ms": 10_000,
    "grpc.keepalive_timeout_ms": 5_000,
    # A keepalive is a ping, and waits for so long; a minute unless said.
    "grpc.http2.ping_timeout_ms": 5_000,
    "grpc.http2.max_pings_without_data": 0,
    # While such a probe is on its way no keepalive is sent: a connection that goes silent just
    # then would never be found dead.
    "grpc.http2.bdp_probe": 0,
    # A replica that comes back is found soon, not after minutes.
    "grpc.initial_reconnect_backoff_ms": 100,
    "grpc.min_reconnect_backoff_ms": 1_000,
    "grpc.max_reconnect_backoff_ms": 2_000,
}


@dataclass(frozen=True, eq=False)
class Connection(Generic[ChannelT]):
    """A channel to one address, and what can be called through it."""

    channel: ChannelT
    service: Any
    evaluations: Any
    health: Any


class Connections(Generic[ChannelT]):
    """The connections to all addresses. Safe to share between threads.

    Args:
        targets: ``host:port`` of each replica, at least one.
        connect: makes a channel of a target and options.
        options: further gRPC channel options.
    """

    def __init__(
        self,
        targets: Sequence[str],
        connect: Callable[[str, list[tuple[str, Any]]], ChannelT],
        options: Sequence[tuple[str, Any]],
    ) -> None:
        if not targets:
            raise ValueError("a client needs at least one address")
        merged = list((_OPTIONS | dict(options)).items())
        self._all: tuple[Connection[ChannelT], ...] = tuple(
            _connection(connect(target, merged)) for target in targets
        )
        self._place = 0

    @property
    def current(self) -> Connection[ChannelT]:
        """The one to use."""
        return self._all[self._place]

    def __len__(self) -> int:
        return len(self._all)

    def __iter__(self) -> Iterator[Connection[ChannelT]]:
        return iter(self._all)

    def turn(self, failed: Connection[ChannelT]) -> None:
        """Makes the next one current, unless somebody has turned away from this one already."""
        place = self._all.index(failed)
        if self._place == place:
            self._place = (place + 1) % len(self._all)


class Route(Generic[ChannelT]):
    """The way of one stream: which connection its current attempt uses."""

    def __init__(self, connections: Connections[ChannelT], within_s: float) -> None:
        self._connections: Connections[ChannelT] = connections
        self._used: Connection[ChannelT] = connections.current
        self.reopening = Reopening(within_s, len(connections), self._turn)

    def next(self) -> Connection[ChannelT]:
        """The connection for the next attempt."""
        self._used = self._connections.current
        return self._used

    def _turn(self) -> None:
        self._connections.turn(self._used)


def elsewhere(operation: Operation[Any], error: TrajectronError) -> bool:
    """Whether a call that failed so may be sent to another replica."""
    if isinstance(error, DrainingError):
        return True  # it was refused before anything was done
    repeatable = operation.rpc in _SAFE_TO_REPEAT[operation.service]
    return repeatable and (
        type(error) is TransportError or isinstance(error, StoreUnavailableError)
    )


def _connection(channel: ChannelT) -> Connection[ChannelT]:
    # The generated stubs take either kind of channel, and say so by overloads.
    either: Any = channel
    health: Any = health_pb2_grpc.HealthStub
    return Connection(
        channel,
        trajectron_pb2_grpc.TrajectronServiceStub(either),
        evaluation_pb2_grpc.EvaluationServiceStub(either),
        health(channel),
    )
