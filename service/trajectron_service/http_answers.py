"""What the JSON answers look like: the schemas of the OpenAPI page.

The answers themselves are written by ``http_encode``; a contract test holds every one of
them against these models. Shape letters: Z latent values, H horizon steps, S samples.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from trajectron_service.messages import ForecastMode, Outcome, UnknownTypes

Pair = tuple[float, float]
Triple = tuple[float, float, float]


class Answer(BaseModel):
    """What every answer shares: exactly the fields described."""

    model_config = ConfigDict(extra="forbid")


class AgentForecast(Answer):
    """The futures of one agent."""

    id: str = Field(description="As sent.")
    type: str = Field(description="The model's type of the agent.")
    x: float = Field(description="Last observed position, metres.")
    y: float = Field(description="Last observed position, metres.")
    last_observed_time: float = Field(description="When it was observed, seconds on your clock.")
    observations: int = Field(description="Steps at which it was seen since it (re)appeared.")
    heading_known: bool = Field(
        description="False when the agent has shown no direction yet: its forecast is isotropic."
    )
    mode_probabilities: list[float] = Field(description="[Z], sums to one.")
    mean: list[list[Pair]] | None = Field(
        description="[Z, H, 2] mean position of each mode, metres, absolute; null unless asked for."
    )
    covariance: list[list[Triple]] | None = Field(
        description="[Z, H, 3] covariance of each mode: xx, xy, yy in square metres."
    )
    samples: list[list[Pair]] | None = Field(
        description="[S, H, 2] sampled positions, metres, absolute; null for `gmm`."
    )
    sample_modes: list[int] | None = Field(
        description="[S] the latent value that each sample came from; null for `gmm`."
    )


class Forecast(Answer):
    """The futures of a scene."""

    model: str = Field(description="The model's name.")
    model_hash: str = Field(description="sha256 of the model's weights, hexadecimal.")
    mode: ForecastMode = Field(description="As asked for.")
    seed: int = Field(description="Ask with it again to get the same samples.")
    reference_time: float = Field(
        description="Of the frame that the forecast starts from, seconds on your clock."
    )
    time_offsets_s: list[float] = Field(
        description="[H] seconds after `reference_time` of every step, the first above zero."
    )
    sample_semantics: str = Field(
        description="Samples of different agents are independent of each other given the "
        "histories. Those of one agent: `independent_agents`: independent too; "
        "`independent_agents_stratified`: spread evenly, each with the same distribution."
    )
    mode_probability_floor: float = Field(
        description="Modes that were less probable than this are left out: their probability is "
        "zero, the others' sum to one, and their mean and covariance repeat the most probable "
        "mode's. Above zero for `gmm` only."
    )
    num_samples: int = Field(description="Samples of each agent; 0 for `gmm`.")
    fewer_samples: bool = Field(
        description="Whether they are fewer than asked for: `allow_fewer_samples`."
    )
    agents: list[AgentForecast] = Field(description="In the order asked for.")


class Session(Answer):
    """A scene that the service keeps between frames."""

    id: str = Field(description="As chosen, or assigned by the server.")
    model: str = Field(description="The model's name.")
    frame_interval_s: float = Field(description="Expected seconds between frames.")
    agent_timeout_s: float = Field(description="An agent unseen for longer (s) is dropped.")
    idle_timeout_s: float = Field(description="Without traffic for longer (s) it is closed.")
    unknown_types: UnknownTypes = Field(description="What happens to agents of unknown types.")
    type_map: dict[str, str] = Field(description="From your agent types to the model's.")
    dt_s: float = Field(description="The model's step, seconds.")
    version: int = Field(description="Frames accepted so far.")
    create_time: datetime = Field(description="RFC 3339, UTC.")
    expire_time: datetime = Field(description="When it closes unless it is used before; UTC.")
    last_frame_time: float | None = Field(
        description="Of the newest accepted frame, seconds on your clock; null before the first."
    )
    agent_count: int = Field(description="Agents in the scene, missing ones not yet timed out too.")
    last_sequence: int | None = Field(
        description="The highest sequence number acknowledged on a stream; null before one."
    )


class GraphNode(Answer):
    """An agent in the scene."""

    id: str = Field(description="As sent.")
    type: str = Field(description="The model's type of the agent.")
    x: float = Field(description="Last observed position, metres.")
    y: float = Field(description="Last observed position, metres.")
    observations: int = Field(description="Steps at which it was seen since it (re)appeared.")
    last_observed_time: float = Field(description="Seconds on your clock.")


class GraphEdge(Answer):
    """A directed edge: what the sender means to the receiver."""

    receiver_id: str = Field(description="The agent that is influenced.")
    sender_id: str = Field(description="The agent that influences.")
    age_steps: int = Field(description="Steps for which it has been present; kept while it fades.")
    gone_steps: int = Field(description="Steps since it went; 0 while present.")
    modulation: float = Field(description="The factor M in [0, 1].")


class SceneGraph(Answer):
    """The spatiotemporal graph at the newest frame."""

    nodes: list[GraphNode] = Field(description="The agents in the scene.")
    edges: list[GraphEdge] = Field(description="Pairs within reach, and those that fade.")


class SessionWithGraph(Session):
    """A session and its graph."""

    graph: SceneGraph = Field(description="The graph at the newest frame.")


class Sessions(Answer):
    """A page of open sessions, in order of id."""

    sessions: list[Session] = Field(description="In order of id.")
    next_page_token: str = Field(description="Empty on the last page.")


class FrameResult(Answer):
    """What became of one frame."""

    outcome: Outcome = Field(
        description="`accepted`; `accepted_with_gaps`: `gap_agents` were away for longer than the "
        "agent timeout and start anew; `duplicate`: as the newest frame, nothing changed; refused, "
        "the state untouched: `conflict` (same time, other content), `out_of_order`, `invalid`."
    )
    version: int = Field(description="The session's version after this frame.")
    gap_agents: list[str] = Field(description="Ids of agents that start anew.")
    ignored_agents: list[str] = Field(description="Left out under `unknown_types: ignore`.")
    field: str = Field(description="Of a refused frame: the field at fault; else empty.")
    message: str = Field(description="Of a refused frame: what was wrong; else empty.")


class FrameResults(Answer):
    """What became of the frames."""

    results: list[FrameResult] = Field(description="One for each frame, in order.")


class Model(Answer):
    """A model that this server can run."""

    name: str = Field(description="What `model` takes.")
    hash: str = Field(description="sha256 of the weights, hexadecimal.")
    agent_types: list[str] = Field(description="The agent types it knows.")
    dt_s: float = Field(description="Its step, seconds.")
    horizon: int = Field(description="Steps that it was trained for; up to 60 can be asked.")
    latent_values: int = Field(description="Z, the number of modes.")
    is_default: bool = Field(description="Whether requests that name no model get this one.")
    provenance: dict[str, Any] = Field(description="Task, data, split, seed, metrics, licence.")
    kernels: str = Field(
        description="What computes it: the instruction set of the kernels, or torch and why."
    )


class Models(Answer):
    """The models that this server can run."""

    models: list[Model] = Field(description="The default one among them is marked.")


class Status(Answer):
    """How the process is."""

    status: str = Field(description="`ok`, or what it is doing instead.")
