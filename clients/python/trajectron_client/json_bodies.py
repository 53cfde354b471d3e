"""The client's values to and from the JSON bodies of the HTTP API."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Unpack

import numpy as np

from trajectron_client.forecast import AgentForecast, Float64, Forecast, covariance_matrices
from trajectron_client.replies import (
    FrameResult,
    GraphEdge,
    GraphNode,
    ModelInfo,
    Outcome,
    SceneGraph,
    SessionInfo,
    SessionSnapshot,
)
from trajectron_client.scene import ForecastOptions, Frame, SessionOptions, check_names

Json = dict[str, Any]


def frame(value: Frame) -> Json:
    """A frame as JSON."""
    agents = [{"id": a.id, "type": a.type, "x": a.x, "y": a.y} for a in value.agents]
    return {"time": value.time, "agents": agents}


def forecast_options(**options: Unpack[ForecastOptions]) -> Json:
    """Options as JSON; what is absent stays absent."""
    check_names(ForecastOptions, options)
    body: Json = {name: value for name, value in options.items() if value is not None}
    if "agents" in body:
        body["agents"] = list(body["agents"])
    return body


def session_options(**options: Unpack[SessionOptions]) -> Json:
    """A session's configuration as JSON; what is absent stays absent."""
    check_names(SessionOptions, options)
    body: Json = {name: value for name, value in options.items() if value is not None}
    if "type_map" in body:
        body["type_map"] = dict(body["type_map"])
    return body


def to_forecast(body: Json) -> Forecast:
    """A forecast; JSON carries absolute positions."""
    return Forecast(
        model=body["model"],
        model_hash=body["model_hash"],
        mode=body["mode"],
        seed=body["seed"],
        reference_time=body["reference_time"],
        time_offsets_s=np.array(body["time_offsets_s"], dtype=np.float64),
        agents=tuple(_agent_forecast(agent) for agent in body["agents"]),
        sample_semantics=body["sample_semantics"],
        mode_probability_floor=body.get("mode_probability_floor", 0.0),
        num_samples=body.get("num_samples", 0),
        fewer_samples=body.get("fewer_samples", False),
    )


def _agent_forecast(body: Json) -> AgentForecast:
    covariance = _array(body["covariance"])
    modes = body["sample_modes"]
    return AgentForecast(
        id=body["id"],
        type=body["type"],
        position=np.array([body["x"], body["y"]], dtype=np.float64),
        last_observed_time=body["last_observed_time"],
        observations=body["observations"],
        heading_known=body["heading_known"],
        mode_probabilities=np.array(body["mode_probabilities"], dtype=np.float64),
        mean=_array(body["mean"]),
        covariance=None if covariance is None else covariance_matrices(covariance),
        samples=_array(body["samples"]),
        sample_modes=None if modes is None else np.array(modes, dtype=np.int64),
    )


def _array(values: list[Any] | None) -> Float64 | None:
    return None if values is None else np.array(values, dtype=np.float64)


def to_session_info(body: Json) -> SessionInfo:
    """A session as the client shows it."""
    return SessionInfo(
        id=body["id"],
        model=body["model"],
        dt_s=body["dt_s"],
        frame_interval_s=body["frame_interval_s"],
        agent_timeout_s=body["agent_timeout_s"],
        idle_timeout_s=body["idle_timeout_s"],
        unknown_types=body["unknown_types"],
        type_map=body["type_map"],
        version=body["version"],
        created_at=datetime.fromisoformat(body["create_time"]),
        expires_at=datetime.fromisoformat(body["expire_time"]),
        last_frame_time=body["last_frame_time"],
        agent_count=body["agent_count"],
        last_sequence=body["last_sequence"],
    )


def to_session_snapshot(body: Json) -> SessionSnapshot:
    """A session with its graph."""
    graph = body["graph"]
    nodes = tuple(
        GraphNode(n["id"], n["type"], n["x"], n["y"], n["observations"], n["last_observed_time"])
        for n in graph["nodes"]
    )
    edges = tuple(
        GraphEdge(
            e["receiver_id"], e["sender_id"], e["age_steps"], e["gone_steps"], e["modulation"]
        )
        for e in graph["edges"]
    )
    return SessionSnapshot(to_session_info(body), SceneGraph(nodes, edges))


def to_frame_result(body: Json) -> FrameResult:
    """What became of a frame."""
    return FrameResult(
        outcome=Outcome(body["outcome"]),
        version=body["version"],
        gap_agents=tuple(body["gap_agents"]),
        ignored_agents=tuple(body["ignored_agents"]),
        field=body["field"],
        message=body["message"],
    )


def to_model_info(body: Json) -> ModelInfo:
    """A model as the client shows it."""
    return ModelInfo(
        name=body["name"],
        hash=body["hash"],
        agent_types=tuple(body["agent_types"]),
        dt_s=body["dt_s"],
        horizon=body["horizon"],
        latent_values=body["latent_values"],
        is_default=body["is_default"],
        provenance=body["provenance"],
        kernels=body.get("kernels", ""),
    )
