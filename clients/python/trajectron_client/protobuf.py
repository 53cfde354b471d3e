"""The client's values to and from the messages of the contract."""

from __future__ import annotations

import json
from datetime import UTC
from typing import Unpack, cast

import numpy as np
from google.protobuf.duration_pb2 import Duration

from trajectron_client.forecast import AgentForecast, Float64, Forecast, covariance_matrices
from trajectron_client.grpc_errors import from_status
from trajectron_client.replies import (
    FrameResult,
    GraphEdge,
    GraphNode,
    ModelInfo,
    Outcome,
    SceneGraph,
    SessionInfo,
    SessionSnapshot,
    StreamReply,
)
from trajectron_client.scene import (
    Delivery,
    ForecastMode,
    ForecastOptions,
    Frame,
    SessionOptions,
    UnknownTypes,
    check_names,
)
from trajectron_proto.v1 import trajectron_pb2 as pb


def frame(value: Frame) -> pb.Frame:
    """A frame as the contract carries it."""
    return pb.Frame(
        time_s=value.time,
        agents=[pb.Agent(id=a.id, type=a.type, x=a.x, y=a.y) for a in value.agents],
    )


def forecast_options(**options: Unpack[ForecastOptions]) -> pb.ForecastOptions:
    """Options as the contract carries them; what is absent stays absent."""
    check_names(ForecastOptions, options)
    return pb.ForecastOptions(
        mode=pb.ForecastMode.Value(f"FORECAST_MODE_{options.get('mode', 'full').upper()}"),
        num_samples=options.get("num_samples"),
        horizon=options.get("horizon"),
        seed=options.get("seed"),
        agent_ids=options.get("agents") or (),
        include_modes=options.get("include_modes"),
        sampling=pb.Sampling.Value(f"SAMPLING_{options.get('sampling', 'iid').upper()}"),
        deadline=duration(options.get("deadline_s")),
        allow_fewer_samples=options.get("allow_fewer_samples", False),
    )


def session_config(**options: Unpack[SessionOptions]) -> pb.SessionConfig:
    """A session's configuration as the contract carries it."""
    check_names(SessionOptions, options)
    return pb.SessionConfig(
        model=options.get("model") or "",
        frame_interval=duration(options.get("frame_interval_s")),
        agent_timeout=duration(options.get("agent_timeout_s")),
        idle_timeout=duration(options.get("idle_timeout_s")),
        unknown_types=unknown_types(options.get("unknown_types", "reject")),
        type_map=options.get("type_map") or {},
    )


def unknown_types(policy: UnknownTypes) -> pb.UnknownTypePolicy.ValueType:
    """The policy's number."""
    return pb.UnknownTypePolicy.Value(f"UNKNOWN_TYPE_POLICY_{policy.upper()}")


def delivery(value: Delivery) -> pb.StreamDelivery.ValueType:
    """The delivery's number."""
    return pb.StreamDelivery.Value(f"STREAM_DELIVERY_{value.upper()}")


def duration(seconds: float | None) -> Duration | None:
    """Seconds as a Duration, to the nanosecond."""
    if seconds is None:
        return None
    value = Duration()
    value.FromNanoseconds(round(seconds * 1e9))
    return value


def to_forecast(message: pb.Forecast) -> Forecast:
    """A forecast, its offsets added to the agents' last positions."""
    mode = pb.ForecastMode.Name(message.mode).removeprefix("FORECAST_MODE_").lower()
    semantics = pb.SampleSemantics.Name(message.sample_semantics)
    return Forecast(
        model=message.model,
        model_hash=message.model_hash,
        mode=cast("ForecastMode", mode),
        seed=message.seed,
        reference_time=message.reference_time_s,
        time_offsets_s=np.array(message.time_offsets_s, dtype=np.float64),
        agents=tuple(_agent_forecast(agent) for agent in message.agents),
        sample_semantics=semantics.removeprefix("SAMPLE_SEMANTICS_").lower(),
        mode_probability_floor=message.mode_probability_floor,
        num_samples=message.num_samples,
        fewer_samples=message.fewer_samples,
    )


def _agent_forecast(message: pb.AgentForecast) -> AgentForecast:
    position = np.array([message.x, message.y], dtype=np.float64)
    has_samples = message.HasField("samples")
    has_modes = message.HasField("mean")
    return AgentForecast(
        id=message.id,
        type=message.type,
        position=position,
        last_observed_time=message.last_observed_time_s,
        observations=message.observations,
        heading_known=message.heading_known,
        mode_probabilities=_array(message.mode_probabilities),
        mean=position + _array(message.mean) if has_modes else None,
        covariance=covariance_matrices(_array(message.covariance)) if has_modes else None,
        samples=position + _array(message.samples) if has_samples else None,
        sample_modes=np.array(message.sample_modes, dtype=np.int64) if has_samples else None,
    )


def _array(message: pb.Float32Array) -> Float64:
    flat = np.frombuffer(message.data, dtype="<f4")
    return flat.reshape(tuple(message.shape)).astype(np.float64)


def to_session_info(message: pb.Session) -> SessionInfo:
    """A session as the client shows it."""
    config = message.config
    policy = pb.UnknownTypePolicy.Name(config.unknown_types).removeprefix("UNKNOWN_TYPE_POLICY_")
    return SessionInfo(
        id=message.id,
        model=config.model,
        dt_s=_seconds(message.dt),
        frame_interval_s=_seconds(config.frame_interval),
        agent_timeout_s=_seconds(config.agent_timeout),
        idle_timeout_s=_seconds(config.idle_timeout),
        unknown_types=cast("UnknownTypes", policy.lower()),
        type_map=dict(config.type_map),
        version=message.version,
        created_at=message.create_time.ToDatetime(tzinfo=UTC),
        expires_at=message.expire_time.ToDatetime(tzinfo=UTC),
        last_frame_time=(
            message.last_frame_time_s if message.HasField("last_frame_time_s") else None
        ),
        agent_count=message.agent_count,
        last_sequence=message.last_sequence if message.HasField("last_sequence") else None,
    )


def _seconds(message: Duration) -> float:
    return message.ToNanoseconds() / 1e9


def to_session_snapshot(message: pb.GetSessionResponse) -> SessionSnapshot:
    """A session with its graph."""
    nodes = (
        GraphNode(n.id, n.type, n.x, n.y, n.observations, n.last_observed_time_s)
        for n in message.graph.nodes
    )
    edges = (
        GraphEdge(e.receiver_id, e.sender_id, e.age_steps, e.gone_steps, e.modulation)
        for e in message.graph.edges
    )
    return SessionSnapshot(to_session_info(message.session), SceneGraph(tuple(nodes), tuple(edges)))


def to_frame_result(message: pb.FrameResult) -> FrameResult:
    """What became of a frame."""
    name = pb.FrameOutcome.Name(message.outcome).removeprefix("FRAME_OUTCOME_")
    return FrameResult(
        outcome=Outcome(name.lower()),
        version=message.version,
        gap_agents=tuple(message.gap_agent_ids),
        ignored_agents=tuple(message.ignored_agent_ids),
        field=message.field,
        message=message.message,
    )


def to_stream_reply(message: pb.StreamFrameReply) -> StreamReply:
    """The reply to one frame of a stream."""
    return StreamReply(
        sequence=message.sequence,
        result=to_frame_result(message.result),
        forecast=to_forecast(message.forecast) if message.HasField("forecast") else None,
        superseded=message.superseded,
        error=from_status(message.error) if message.HasField("error") else None,
    )


def to_model_info(message: pb.Model) -> ModelInfo:
    """A model as the client shows it."""
    return ModelInfo(
        name=message.name,
        hash=message.hash,
        agent_types=tuple(message.agent_types),
        dt_s=_seconds(message.dt),
        horizon=message.horizon,
        latent_values=message.latent_values,
        is_default=message.is_default,
        provenance=json.loads(message.provenance_json or "{}"),
        kernels=message.kernels,
    )
