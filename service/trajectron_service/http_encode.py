"""The core's answers as JSON values (numpy arrays included: orjson writes them).

Positions are absolute here: the last position, a double, plus the model's float32 offsets.
Wall-clock times are RFC 3339 in UTC.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajectron_service.messages import (
    AgentForecast,
    Forecast,
    FrameResult,
    GraphEdge,
    GraphNode,
    ModelInfo,
    SceneGraph,
    SessionInfo,
)


def forecast_json(forecast: Forecast) -> dict[str, Any]:
    """A scene's futures in absolute positions."""
    return {
        "model": forecast.model,
        "model_hash": forecast.model_hash,
        "mode": forecast.mode.value,
        "seed": forecast.seed,
        "reference_time": forecast.reference_time,
        "time_offsets_s": forecast.time_offsets_s,
        "sample_semantics": forecast.sample_semantics,
        "mode_probability_floor": forecast.mode_probability_floor,
        "num_samples": forecast.num_samples,
        "fewer_samples": forecast.fewer_samples,
        "agents": [_agent_json(agent) for agent in forecast.agents],
    }


def _agent_json(agent: AgentForecast) -> dict[str, Any]:
    position = np.array([agent.x, agent.y])
    return {
        "id": agent.id,
        "type": agent.type,
        "x": agent.x,
        "y": agent.y,
        "last_observed_time": agent.last_observed_time,
        "observations": agent.observations,
        "heading_known": agent.heading_known,
        "mode_probabilities": np.ascontiguousarray(agent.mode_probabilities),
        "mean": _absolute(agent.mean, position),
        "covariance": None if agent.covariance is None else np.ascontiguousarray(agent.covariance),
        "samples": _absolute(agent.samples, position),
        "sample_modes": None if agent.sample_modes is None else agent.sample_modes.tolist(),
    }


def _absolute(
    offsets: NDArray[np.float32] | None, position: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    return None if offsets is None else np.ascontiguousarray(offsets + position)  # [..., H, 2]


def session_json(session: SessionInfo) -> dict[str, Any]:
    """A session as clients see it."""
    config = session.config
    return {
        "id": session.id,
        "model": config.model,
        "frame_interval_s": config.frame_interval_s,
        "agent_timeout_s": config.agent_timeout_s,
        "idle_timeout_s": config.idle_timeout_s,
        "unknown_types": config.unknown_types.value,
        "type_map": dict(config.type_map),
        "dt_s": session.dt_s,
        "version": session.version,
        "create_time": rfc3339(session.created_at),
        "expire_time": rfc3339(session.expires_at),
        "last_frame_time": session.last_frame_time,
        "agent_count": session.agent_count,
        "last_sequence": session.last_sequence,
    }


def graph_json(graph: SceneGraph) -> dict[str, Any]:
    """A scene's graph."""
    return {
        "nodes": [_node_json(node) for node in graph.nodes],
        "edges": [_edge_json(edge) for edge in graph.edges],
    }


def _node_json(node: GraphNode) -> dict[str, Any]:
    return {
        "id": node.id,
        "type": node.type,
        "x": node.x,
        "y": node.y,
        "observations": node.observations,
        "last_observed_time": node.last_observed_time,
    }


def _edge_json(edge: GraphEdge) -> dict[str, Any]:
    return {
        "receiver_id": edge.receiver_id,
        "sender_id": edge.sender_id,
        "age_steps": edge.age_steps,
        "gone_steps": edge.gone_steps,
        "modulation": edge.modulation,
    }


def result_json(result: FrameResult) -> dict[str, Any]:
    """What became of a frame."""
    return {
        "outcome": result.outcome.value,
        "version": result.version,
        "gap_agents": result.gap_agents,
        "ignored_agents": result.ignored_agents,
        "field": result.field,
        "message": result.message,
    }


def model_json(model: ModelInfo) -> dict[str, Any]:
    """A model that this server can run."""
    return {
        "name": model.name,
        "hash": model.hash,
        "agent_types": model.agent_types,
        "dt_s": model.dt_s,
        "horizon": model.horizon,
        "latent_values": model.latent_values,
        "is_default": model.is_default,
        "provenance": dict(model.provenance),
        "kernels": model.kernels,
    }


def rfc3339(unix_s: float) -> str:
    """An instant for JSON."""
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds")
