"""What the application core takes and returns: frozen dataclasses that know no transport.

Metres, seconds; positions in the client's world-fixed frame. Shape letters as in
``trajectron_model.shapes``: A agents, Z latent values, H horizon steps, S samples.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from trajectron_model.config import MODE_PROBABILITY_FLOOR
from trajectron_service.errors import ServiceError

Float32 = NDArray[np.float32]


class ForecastMode(enum.Enum):
    """How futures are drawn (the paper's two configurations, and the analytic mixture)."""

    FULL = "full"
    Z_BEST = "z_best"
    GMM = "gmm"


class Sampling(enum.Enum):
    """How the samples of one agent go together; each alone has the same distribution."""

    IID = "iid"
    STRATIFIED = "stratified"


class UnknownTypes(enum.Enum):
    """What happens to an agent whose type the model does not know."""

    REJECT = "reject"
    IGNORE = "ignore"
    MAP = "map"


class Outcome(enum.Enum):
    """What became of a frame."""

    ACCEPTED = "accepted"
    ACCEPTED_WITH_GAPS = "accepted_with_gaps"
    DUPLICATE = "duplicate"
    CONFLICT = "conflict"
    OUT_OF_ORDER = "out_of_order"
    INVALID = "invalid"


class Delivery(enum.Enum):
    """Which forecasts a slow reader of a stream still gets."""

    ALL = "all"
    LATEST = "latest"


@dataclass(frozen=True, slots=True)
class Agent:
    """One observed agent, as the client sent it: checked by the core, not by the adapters.

    ``x`` and ``y`` are metres, None when the client left them out.
    """

    id: str
    type: str
    x: float | None
    y: float | None


@dataclass(frozen=True, slots=True)
class Frame:
    """A scene at one instant; ``time`` in seconds, None when the client left it out."""

    time: float | None
    agents: tuple[Agent, ...]


@dataclass(frozen=True, slots=True)
class ForecastOptions:
    """What to forecast; None asks for the default.

    ``agents`` None means all. ``include_modes`` None means: for ``gmm`` only. ``deadline_s`` counts
    from when the request was received. ``allow_fewer_samples`` takes the first samples where all
    would be late.
    """

    mode: ForecastMode = ForecastMode.FULL
    num_samples: int | None = None
    horizon: int | None = None
    seed: int | None = None
    agents: tuple[str, ...] | None = None
    include_modes: bool | None = None
    sampling: Sampling = Sampling.IID
    deadline_s: float | None = None
    allow_fewer_samples: bool = False


@dataclass(frozen=True, slots=True)
class SessionConfig:
    """How a session reads its frames, as asked for; None asks for the default."""

    model: str | None = None
    frame_interval_s: float | None = None
    agent_timeout_s: float | None = None
    idle_timeout_s: float | None = None
    unknown_types: UnknownTypes = UnknownTypes.REJECT
    type_map: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """A session as clients see it; every field of ``config`` is resolved.

    ``created_at`` and ``expires_at`` are Unix seconds; ``last_frame_time`` is on the
    client's clock, None before the first frame.
    """

    id: str
    config: SessionConfig
    dt_s: float
    version: int
    created_at: float
    expires_at: float
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
    """What the sender means to the receiver; ages in steps, modulation in [0, 1]."""

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
class FrameResult:
    """The answer to one frame; ``field`` and ``message`` are set when it was refused."""

    outcome: Outcome
    version: int
    gap_agents: tuple[str, ...] = ()
    ignored_agents: tuple[str, ...] = ()
    field: str = ""
    message: str = ""

    @property
    def refused(self) -> bool:
        """Whether the frame left the state untouched because of a fault of its own."""
        return self.outcome in (Outcome.CONFLICT, Outcome.OUT_OF_ORDER, Outcome.INVALID)


@dataclass(frozen=True, slots=True)
class AgentForecast:
    """One agent's futures; arrays are float32 offsets from ``(x, y)``, which are doubles."""

    id: str
    type: str
    x: float
    y: float
    last_observed_time: float
    observations: int
    heading_known: bool
    mode_probabilities: Float32  # [Z]
    mean: Float32 | None  # [Z, H, 2]
    covariance: Float32 | None  # [Z, H, 3] xx, xy, yy
    samples: Float32 | None  # [S, H, 2]
    sample_modes: NDArray[np.int64] | None  # [S]


@dataclass(frozen=True, slots=True)
class Forecast:
    """A scene's futures from ``reference_time`` on; see ``sample_semantics``."""

    model: str
    model_hash: str
    mode: ForecastMode
    seed: int
    reference_time: float
    time_offsets_s: tuple[float, ...]  # [H], the first > 0
    agents: tuple[AgentForecast, ...]
    sampling: Sampling = Sampling.IID
    num_samples: int = 0  # of each agent; 0 for ``gmm``
    fewer_samples: bool = False  # than asked for, to be in time

    @property
    def sample_semantics(self) -> str:
        """How samples go together: between agents always independent, within one as asked."""
        stratified = self.sampling is Sampling.STRATIFIED
        return "independent_agents_stratified" if stratified else "independent_agents"

    @property
    def mode_probability_floor(self) -> float:
        """Modes that were less probable are left out: their probability is zero."""
        return MODE_PROBABILITY_FLOOR if self.mode is ForecastMode.GMM else 0.0


@dataclass(frozen=True, slots=True)
class StreamOptions:
    """What a stream asks for (StreamOpen): ``forecast`` None sends results only."""

    forecast: ForecastOptions | None
    delivery: Delivery = Delivery.ALL
    close_session_at_end: bool = False
    must_exist: bool = False


@dataclass(frozen=True, slots=True)
class StreamFrame:
    """One frame of a stream; ``options`` overrides the stream's for this frame.

    ``fault`` is set instead where it brought options that mean nothing: the frame counts,
    and its reply says what was wrong.
    """

    sequence: int
    frame: Frame
    options: ForecastOptions | None = None
    fault: ServiceError | None = None


@dataclass(frozen=True, slots=True)
class StreamReply:
    """The reply to one frame of a stream."""

    sequence: int
    result: FrameResult
    forecast: Forecast | None = None
    superseded: bool = False
    error: ServiceError | None = None


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """A model that this server can run; ``provenance`` is its checkpoint's, as JSON values.

    ``kernels`` says what computes it: an instruction set's name, or torch and why.
    """

    name: str
    hash: str
    agent_types: tuple[str, ...]
    dt_s: float
    horizon: int
    latent_values: int
    is_default: bool
    provenance: Mapping[str, object]
    kernels: str = "torch"
