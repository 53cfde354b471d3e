"""Between protobuf messages and the core's: decoding requests, encoding answers.

Decoding refuses only what the core's types cannot hold (an enum value that does not
exist); everything else is the core's to judge.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import TypeVar

import numpy as np
from google.protobuf import duration_pb2, timestamp_pb2
from numpy.typing import NDArray

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service import messages as core
from trajectron_service.errors import ServiceError, invalid

E = TypeVar("E")
V = TypeVar("V", bound=int)

_MODES = {
    pb.FORECAST_MODE_UNSPECIFIED: core.ForecastMode.FULL,
    pb.FORECAST_MODE_FULL: core.ForecastMode.FULL,
    pb.FORECAST_MODE_Z_BEST: core.ForecastMode.Z_BEST,
    pb.FORECAST_MODE_GMM: core.ForecastMode.GMM,
}
_SAMPLINGS = {
    pb.SAMPLING_UNSPECIFIED: core.Sampling.IID,
    pb.SAMPLING_IID: core.Sampling.IID,
    pb.SAMPLING_STRATIFIED: core.Sampling.STRATIFIED,
}
_UNKNOWN_TYPES = {
    pb.UNKNOWN_TYPE_POLICY_UNSPECIFIED: core.UnknownTypes.REJECT,
    pb.UNKNOWN_TYPE_POLICY_REJECT: core.UnknownTypes.REJECT,
    pb.UNKNOWN_TYPE_POLICY_IGNORE: core.UnknownTypes.IGNORE,
    pb.UNKNOWN_TYPE_POLICY_MAP: core.UnknownTypes.MAP,
}
_DELIVERIES = {
    pb.STREAM_DELIVERY_UNSPECIFIED: core.Delivery.ALL,
    pb.STREAM_DELIVERY_ALL: core.Delivery.ALL,
    pb.STREAM_DELIVERY_LATEST: core.Delivery.LATEST,
}
_OUTCOMES = {
    core.Outcome.ACCEPTED: pb.FRAME_OUTCOME_ACCEPTED,
    core.Outcome.ACCEPTED_WITH_GAPS: pb.FRAME_OUTCOME_ACCEPTED_WITH_GAPS,
    core.Outcome.DUPLICATE: pb.FRAME_OUTCOME_DUPLICATE,
    core.Outcome.CONFLICT: pb.FRAME_OUTCOME_CONFLICT,
    core.Outcome.OUT_OF_ORDER: pb.FRAME_OUTCOME_OUT_OF_ORDER,
    core.Outcome.INVALID: pb.FRAME_OUTCOME_INVALID,
}
_MODES_OUT = {
    core.ForecastMode.FULL: pb.FORECAST_MODE_FULL,
    core.ForecastMode.Z_BEST: pb.FORECAST_MODE_Z_BEST,
    core.ForecastMode.GMM: pb.FORECAST_MODE_GMM,
}
_SEMANTICS_OUT = {
    core.Sampling.IID: pb.SAMPLE_SEMANTICS_INDEPENDENT_AGENTS,
    core.Sampling.STRATIFIED: pb.SAMPLE_SEMANTICS_INDEPENDENT_AGENTS_STRATIFIED,
}
_UNKNOWN_TYPES_OUT = {
    core.UnknownTypes.REJECT: pb.UNKNOWN_TYPE_POLICY_REJECT,
    core.UnknownTypes.IGNORE: pb.UNKNOWN_TYPE_POLICY_IGNORE,
    core.UnknownTypes.MAP: pb.UNKNOWN_TYPE_POLICY_MAP,
}


def frames(messages: Iterable[pb.Frame]) -> tuple[core.Frame, ...]:
    """Frames as the core takes them."""
    return tuple(frame(message) for message in messages)


def frame(message: pb.Frame) -> core.Frame:
    """One frame; wall-clock times become seconds since the Unix epoch."""
    which = message.WhichOneof("time")
    time_s = None
    if which == "time_s":
        time_s = message.time_s
    elif which == "timestamp":
        time_s = message.timestamp.seconds + message.timestamp.nanos * 1e-9
    return core.Frame(time_s, tuple(_agent(agent) for agent in message.agents))


def _agent(message: pb.Agent) -> core.Agent:
    return core.Agent(
        message.id,
        message.type,
        message.x if message.HasField("x") else None,
        message.y if message.HasField("y") else None,
    )


def forecast_options(message: pb.ForecastOptions, path: str = "options") -> core.ForecastOptions:
    """What to forecast; raises ``INVALID_ARGUMENT`` for an enum value that does not exist."""
    return core.ForecastOptions(
        mode=_known(_MODES, message.mode, f"{path}.mode", "a ForecastMode"),
        num_samples=message.num_samples if message.HasField("num_samples") else None,
        horizon=message.horizon if message.HasField("horizon") else None,
        seed=message.seed if message.HasField("seed") else None,
        agents=tuple(message.agent_ids) or None,
        include_modes=message.include_modes if message.HasField("include_modes") else None,
        sampling=_known(_SAMPLINGS, message.sampling, f"{path}.sampling", "a Sampling"),
        deadline_s=seconds(message.deadline) if message.HasField("deadline") else None,
        allow_fewer_samples=message.allow_fewer_samples,
    )


def unknown_types(
    value: pb.UnknownTypePolicy.ValueType, path: str = "unknown_types"
) -> core.UnknownTypes:
    """The policy; raises ``INVALID_ARGUMENT`` for one that does not exist."""
    return _known(_UNKNOWN_TYPES, value, path, "an UnknownTypePolicy")


def session_config(message: pb.SessionConfig) -> core.SessionConfig:
    """How a session is to read its frames."""
    return core.SessionConfig(
        model=message.model or None,
        frame_interval_s=(
            seconds(message.frame_interval) if message.HasField("frame_interval") else None
        ),
        agent_timeout_s=seconds(message.agent_timeout)
        if message.HasField("agent_timeout")
        else None,
        idle_timeout_s=seconds(message.idle_timeout) if message.HasField("idle_timeout") else None,
        unknown_types=unknown_types(message.unknown_types, "config.unknown_types"),
        type_map=dict(message.type_map),
    )


def stream_options(message: pb.StreamOpen) -> core.StreamOptions:
    """What a stream asks for; forecasts come with every frame unless turned off."""
    every = not message.HasField("forecast_every_frame") or message.forecast_every_frame
    return core.StreamOptions(
        forecast=forecast_options(message.options) if every else None,
        delivery=_known(_DELIVERIES, message.delivery, "delivery", "a StreamDelivery"),
        close_session_at_end=message.close_session_at_end,
        must_exist=message.must_exist,
    )


def stream_frame(message: pb.StreamFrame) -> core.StreamFrame:
    """One frame of a stream, with options of its own where it brings some.

    Never raises: options that cannot be decoded are a fault of this frame, not of its stream.
    """
    options = fault = None
    if message.HasField("options"):
        try:
            options = forecast_options(message.options)
        except ServiceError as error:
            fault = error
    return core.StreamFrame(message.sequence, frame(message.frame), options, fault)


def seconds(span: duration_pb2.Duration) -> float:
    """A span in seconds."""
    return span.seconds + span.nanos * 1e-9


def _known(table: Mapping[V, E], value: V, path: str, kind: str) -> E:
    if value not in table:
        raise invalid(path, f"{value} is not {kind}")
    return table[value]


def session_message(info: core.SessionInfo) -> pb.Session:
    """A session as clients see it."""
    config = info.config
    return pb.Session(
        id=info.id,
        config=pb.SessionConfig(
            model=config.model or "",
            frame_interval=_span(config.frame_interval_s),
            agent_timeout=_span(config.agent_timeout_s),
            idle_timeout=_span(config.idle_timeout_s),
            unknown_types=_UNKNOWN_TYPES_OUT[config.unknown_types],
            type_map=config.type_map,
        ),
        dt=_span(info.dt_s),
        version=info.version,
        create_time=_instant(info.created_at),
        expire_time=_instant(info.expires_at),
        last_frame_time_s=info.last_frame_time,
        agent_count=info.agent_count,
        last_sequence=info.last_sequence,
    )


def graph_message(graph: core.SceneGraph) -> pb.SceneGraph:
    """A scene's graph."""
    return pb.SceneGraph(
        nodes=[
            pb.GraphNode(
                id=node.id,
                type=node.type,
                x=node.x,
                y=node.y,
                observations=node.observations,
                last_observed_time_s=node.last_observed_time,
            )
            for node in graph.nodes
        ],
        edges=[
            pb.GraphEdge(
                receiver_id=edge.receiver_id,
                sender_id=edge.sender_id,
                age_steps=edge.age_steps,
                gone_steps=edge.gone_steps,
                modulation=edge.modulation,
            )
            for edge in graph.edges
        ],
    )


def result_message(result: core.FrameResult) -> pb.FrameResult:
    """What became of a frame."""
    return pb.FrameResult(
        outcome=_OUTCOMES[result.outcome],
        gap_agent_ids=result.gap_agents,
        ignored_agent_ids=result.ignored_agents,
        field=result.field,
        message=result.message,
        version=result.version,
    )


def forecast_message(forecast: core.Forecast) -> pb.Forecast:
    """A scene's futures; arrays stay offsets from each agent's last position."""
    return pb.Forecast(
        model=forecast.model,
        model_hash=forecast.model_hash,
        mode=_MODES_OUT[forecast.mode],
        seed=forecast.seed,
        reference_time_s=forecast.reference_time,
        time_offsets_s=forecast.time_offsets_s,
        sample_semantics=_SEMANTICS_OUT[forecast.sampling],
        mode_probability_floor=forecast.mode_probability_floor,
        num_samples=forecast.num_samples,
        fewer_samples=forecast.fewer_samples,
        agents=[_agent_forecast(agent) for agent in forecast.agents],
    )


def _agent_forecast(agent: core.AgentForecast) -> pb.AgentForecast:
    return pb.AgentForecast(
        id=agent.id,
        type=agent.type,
        x=agent.x,
        y=agent.y,
        last_observed_time_s=agent.last_observed_time,
        observations=agent.observations,
        heading_known=agent.heading_known,
        mode_probabilities=_array(agent.mode_probabilities),
        mean=_array(agent.mean),
        covariance=_array(agent.covariance),
        samples=_array(agent.samples),
        sample_modes=None if agent.sample_modes is None else agent.sample_modes.tolist(),
    )


def model_message(model: core.ModelInfo) -> pb.Model:
    """A model that this server can run."""
    return pb.Model(
        name=model.name,
        hash=model.hash,
        agent_types=model.agent_types,
        dt=_span(model.dt_s),
        horizon=model.horizon,
        latent_values=model.latent_values,
        is_default=model.is_default,
        provenance_json=json.dumps(dict(model.provenance)),
        kernels=model.kernels,
    )


def _array(values: NDArray[np.float32] | None) -> pb.Float32Array | None:
    if values is None:
        return None
    return pb.Float32Array(shape=values.shape, data=values.astype("<f4", copy=False).tobytes())


def _span(seconds: float | None) -> duration_pb2.Duration | None:
    if seconds is None:
        return None
    whole, nanos = divmod(round(seconds * 1e9), 1_000_000_000)
    return duration_pb2.Duration(seconds=whole, nanos=nanos)


def _instant(unix_s: float) -> timestamp_pb2.Timestamp:
    whole, nanos = divmod(round(unix_s * 1e9), 1_000_000_000)
    return timestamp_pb2.Timestamp(seconds=whole, nanos=nanos)
