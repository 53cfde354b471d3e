"""The gRPC server: limits, keepalive, health and reflection around our services."""

from __future__ import annotations

import grpc
from grpc_health.v1 import health as grpc_health
from grpc_health.v1 import health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from trajectron_proto.v1 import (
    evaluation_pb2,
    evaluation_pb2_grpc,
    trajectron_pb2,
    trajectron_pb2_grpc,
)
from trajectron_service.admission import Admission
from trajectron_service.application import Application
from trajectron_service.evaluations.jobs import Evaluations
from trajectron_service.grpc_api import GrpcApi
from trajectron_service.grpc_evaluations import GrpcEvaluations
from trajectron_service.grpc_interceptor import GrpcInterceptor
from trajectron_service.health import Health
from trajectron_service.metrics import Metrics
from trajectron_service.settings import Settings

SERVICES = (
    trajectron_pb2.DESCRIPTOR.services_by_name["TrajectronService"].full_name,
    evaluation_pb2.DESCRIPTOR.services_by_name["EvaluationService"].full_name,
)

# Clients may ping every 10 s, with some jitter, even while no call is open.
_SHORTEST_PING_MS = 5_000
# We look for dead peers once a minute, and give them 20 s.
_KEEPALIVE_MS = 60_000
_KEEPALIVE_TIMEOUT_MS = 20_000
# A connection has so long to say that it speaks gRPC, and is closed after so long without a call.
_HANDSHAKE_MS = 20_000
_IDLE_MS = 600_000


def grpc_server(
    application: Application,
    evaluations: Evaluations,
    health: Health,
    metrics: Metrics,
    admission: Admission,
    settings: Settings,
) -> grpc.aio.Server:
    """Everything that is served over gRPC; not yet bound to a port.

    Args:
        application: the core: sessions and forecasts.
        evaluations: the core: batch evaluations.
        health: what ``grpc.health.v1`` tells.
        metrics: where durations go.
        admission: who is let in.
        settings: the limits of messages.
    """
    server = grpc.aio.server(
        interceptors=[GrpcInterceptor(SERVICES, metrics, admission, settings.max_calls)],
        options=_options(settings),
    )
    trajectron_pb2_grpc.add_TrajectronServiceServicer_to_server(GrpcApi(application), server)
    evaluation_pb2_grpc.add_EvaluationServiceServicer_to_server(
        GrpcEvaluations(evaluations), server
    )
    health_pb2_grpc.add_HealthServicer_to_server(health.servicer, server)
    names = (*SERVICES, grpc_health.SERVICE_NAME, reflection.SERVICE_NAME)
    reflection.enable_server_reflection(names, server)
    return server


def _options(settings: Settings) -> list[tuple[str, int]]:
    return [
        ("grpc.max_receive_message_length", settings.max_message_bytes),
        ("grpc.max_send_message_length", settings.max_reply_bytes),
        ("grpc.keepalive_time_ms", _KEEPALIVE_MS),
        ("grpc.keepalive_timeout_ms", _KEEPALIVE_TIMEOUT_MS),
        # A keepalive is a ping, and waits for so long; a minute unless said.
        ("grpc.http2.ping_timeout_ms", _KEEPALIVE_TIMEOUT_MS),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.min_ping_interval_without_data_ms", _SHORTEST_PING_MS),
        # While such a probe is on its way no keepalive is sent, and a dead peer is never noticed.
        ("grpc.http2.bdp_probe", 0),
        ("grpc.max_concurrent_streams", settings.max_calls),
        ("grpc.server_handshake_timeout_ms", _HANDSHAKE_MS),
        ("grpc.max_connection_idle_ms", _IDLE_MS),
        # Otherwise a second server would share the port, and half of the calls, unnoticed.
        ("grpc.so_reuseport", 0),
    ]
