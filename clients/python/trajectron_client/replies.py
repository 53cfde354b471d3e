"""What else comes out: sessions, their graphs, outcomes of frames, models."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from trajectron_client.exceptions import ServiceError
from trajectron_client.forecast import Forecast
from trajectron_client.scene import UnknownTypes


class Outcome(enum.StrEnum):
    """What became of a frame."""

    ACCEPTED = "accepted"
    ACCEPTED_WITH_GAPS = "accepted_with_gaps"
    DUPLICATE = "duplicate"
    CONFLICT = "conflict"
    OUT_OF_ORDER = "out_of_order"
    INVALID = "invalid"


@dataclass(frozen=True, slots=True)
class FrameResult:
    """The answer to one frame.

    Attributes:
        outcome: what became of it.
        version: the session's version after it.
        gap_agents: ids of agents that were away for too long and start anew.
        ignored_agents: ids left out under ``unknown_types="ignore"``.
        field: for a refused frame, the path of the field at fault, such as ``agents[3].x``.
        message: for a refused frame, what was wrong and what to do.
    """

    outcome: Outcome
    version: int
    gap_agents: tuple[str, ...] = ()
    ignored_agents: tuple[str, ...] = ()
    field: str = ""
    message: str = ""

    @property
    def refused(self) -> bool:
        """Whether the frame left the session untouched because of a fault of its own."""
        return self.outcome in (Outcome.CONFLICT, Outcome.OUT_OF_ORDER, Outcome.INVALID)


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """A session, with every option resolved.

    Attributes:
        id: its name.
        model: the model it runs.
        dt_s: the model's step.
        frame_interval_s: expected seconds between frames.
        agent_timeout_s: an agent unseen for longer is dropped.
        idle_timeout_s: without traffic for longer the session is closed.
        unknown_types: what happens to agents of types that the model does not know.
        type_map: from your types to the model's.
        version: frames accepted so far.
        created_at: when it was opened.
        expires_at: when it closes unless it is used before.
        last_frame_time: of the newest frame, on your clock; None before the first.
        agent_count: agents in the scene, those out of sight but not timed out included.
        last_sequence: the highest number acknowledged on a stream; None before one.
    """

    id: str
    model: str
    dt_s: float
    frame_interval_s: float
    agent_timeout_s: float
    idle_timeout_s: float
    unknown_types: UnknownTypes
    type_map: Mapping[str, str]
    version: int
    created_at: datetime
    expires_at: datetime
    last_frame_time: float | None
    agent_count: int
    last_sequence: int | None


@dataclass(frozen=True, slots=True)
class GraphNode:
    """An agent in the scene; ``observations`` counts steps since it (re)appeared."""

    id: str
    type: str
    x: float
    y: float
    observations: int
    last_observed_time: float


@dataclass(frozen=True, slots=True)
class GraphEdge:
    """A directed edge: what the sender means to the receiver.

    Attributes:
        receiver_id: the agent that is influenced.
        sender_id: the agent that influences it.
        age_steps: steps for which the edge has been present.
        gone_steps: steps since it went; 0 while present.
        modulation: the factor M in [0, 1].
    """

    receiver_id: str
    sender_id: str
    age_steps: int
    gone_steps: int
    modulation: float


@dataclass(frozen=True, slots=True)
class SceneGraph:
    """The spatiotemporal graph at the newest frame."""

    nodes: tuple[GraphNode, ...]
    edges: tuple[GraphEdge, ...]


@dataclass(frozen=True, slots=True)
class SessionSnapshot:
    """A session and its graph at one moment."""

    info: SessionInfo
    graph: SceneGraph


@dataclass(frozen=True, slots=True)
class StreamReply:
    """The reply to one frame of a stream.

    Attributes:
        sequence: the number of the frame that this answers.
        result: what became of the frame.
        forecast: None when not asked for, superseded, or failed.
        superseded: whether a newer frame made this forecast needless (``delivery="latest"``).
        error: why the forecast failed, where it did.
    """

    sequence: int
    result: FrameResult
    forecast: Forecast | None = None
    superseded: bool = False
    error: ServiceError | None = None


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """A model that the server can run.

    Attributes:
        name: what to ask for it by.
        hash: sha256 of its weights.
        agent_types: the types that it knows.
        dt_s: its step.
        horizon: the steps that it was trained for; up to 60 can be asked.
        latent_values: the number of modes Z.
        is_default: whether requests that name no model get this one.
        provenance: task, data, split, seed, metrics, licence note: JSON values.
        kernels: what computes it: the instruction set of the server's compiled kernels, or
            torch and why; empty from a server that does not say.
    """

    name: str
    hash: str
    agent_types: tuple[str, ...]
    dt_s: float
    horizon: int
    latent_values: int
    is_default: bool
    provenance: Mapping[str, object]
    kernels: str = ""
