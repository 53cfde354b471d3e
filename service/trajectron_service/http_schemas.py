"""JSON bodies of requests: their shape only.

What a value must be (finite, in range, known) is the core's to say, and it says the same
to gRPC: so a field that is required in the schema still parses when it is absent. What is
refused here is what protobuf cannot even carry: another type, an unknown field.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema

from trajectron_service import messages as core
from trajectron_service.messages import ForecastMode, Sampling, UnknownTypes

_EXAMPLE_FRAMES: list[dict[str, Any]] = [
    {"time": 0.0, "agents": [{"id": "7", "type": "pedestrian", "x": 8.46, "y": 3.59}]},
    {"time": 0.4, "agents": [{"id": "7", "type": "pedestrian", "x": 9.02, "y": 3.61}]},
]


def _required(*names: str, **extra: Any) -> Callable[[dict[str, Any]], None]:
    """Documents fields as required, whose absence the core and not the parser refuses."""

    def amend(schema: dict[str, Any]) -> None:
        schema["required"] = list(names)
        for name in names:
            schema["properties"][name].pop("default", None)
        schema.update(extra)

    return amend


_Number = Annotated[float | None, WithJsonSchema({"type": "number"})]


class Body(BaseModel):
    """What every request body shares: unknown fields and other types are refused by name."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Agent(Body):
    """One observed agent of a frame."""

    model_config = ConfigDict(json_schema_extra=_required("id", "type", "x", "y"))

    id: str = Field("", description="Stable over frames, unique within a frame; 1 to 128 letters.")
    type: str = Field("", description="An agent type of the model, such as `pedestrian`.")
    x: _Number = Field(None, description="Metres, in your own world-fixed frame; finite.")
    y: _Number = Field(None, description="Metres, in your own world-fixed frame; finite.")

    def to_core(self) -> core.Agent:
        """The agent as the core takes it."""
        return core.Agent(self.id, self.type, self.x, self.y)


class Frame(Body):
    """Everything seen in a scene at one instant; no agents is a valid observation."""

    model_config = ConfigDict(json_schema_extra=_required("time", "agents"))

    time: _Number = Field(None, description="Seconds on your own clock.")
    agents: tuple[Agent, ...] = Field((), description="The agents seen; may be empty.")

    def to_core(self) -> core.Frame:
        """The frame as the core takes it."""
        return core.Frame(self.time, tuple(agent.to_core() for agent in self.agents))


class ForecastOptions(Body):
    """What to forecast."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"mode": "full", "num_samples": 20, "horizon": 12}]},
    )

    mode: ForecastMode = Field(
        ForecastMode.FULL,
        description="`full`: z ~ p(z|x), y ~ p(y|x,z). `z_best`: z = argmax p(z|x). `gmm`: no "
        "sampling, every latent value as a Gaussian in position space per step.",
    )
    num_samples: int | None = Field(
        None,
        description="Futures per agent, 1 to 2000; default 20. Ignored by `gmm`.",
    )
    horizon: int | None = Field(
        None, description="Steps of the model's dt, 1 to 60; default: the model's horizon."
    )
    seed: int | None = Field(
        None,
        description="0 to 2^63 - 1. The same seed gives the same samples whatever else is asked "
        "of the service; drawn by the server, and returned, when absent.",
    )
    agents: tuple[str, ...] | None = Field(
        None, description="Only agents with these ids; all agents in the scene when empty."
    )
    include_modes: bool | None = Field(
        None,
        description="Whether mean and covariance of every mode are returned; default: only for "
        "`gmm`. Mode probabilities are always returned.",
    )
    sampling: Sampling = Field(
        Sampling.IID,
        description="How one agent's samples go together; each alone has the same distribution. "
        "`iid`: independent. `stratified`: spread evenly over the distribution (latent values in "
        "their probabilities' shares, quasi-random noise), so that a few cover more of it. Agents "
        "are independent of each other either way.",
    )

    deadline_s: float | None = Field(
        None,
        description="Seconds to answer in, from when the request was received, at most the "
        "server's limit. What would be late is refused with 504, before it costs anything where "
        "that is certain.",
    )
    allow_fewer_samples: bool = Field(
        False,
        description="Where all samples would be late: as many as are in time, at least one, "
        "instead of 504. They are the first ones of all that were asked for. Ignored by `gmm`.",
    )

    def to_options(self) -> core.ForecastOptions:
        """The options as the core takes them."""
        return core.ForecastOptions(
            mode=self.mode,
            num_samples=self.num_samples,
            horizon=self.horizon,
            seed=self.seed,
            agents=self.agents or None,
            include_modes=self.include_modes,
            sampling=self.sampling,
            deadline_s=self.deadline_s,
            allow_fewer_samples=self.allow_fewer_samples,
        )


_Model = Annotated[
    str | None,
    Field(description="A name from `GET /v1/models`; the server's default model when absent."),
]
_FrameInterval = Annotated[
    float | None,
    Field(
        description="Expected seconds between frames; default: the model's dt. At an integer "
        "fraction of dt every forecast starts at the newest frame."
    ),
]
_UnknownTypes = Annotated[
    UnknownTypes,
    Field(
        description="What happens to an agent whose type the model does not know. `reject`: its "
        "frame is invalid. `ignore`: it is left out. `map`: it takes the type in `type_map`."
    ),
]
_TypeMap = Annotated[
    dict[str, str],
    Field(
        description="From your agent types to the model's, for `unknown_types: map`; at most 100 "
        "entries, names of 1 to 128 characters."
    ),
]


class PredictRequest(ForecastOptions):
    """A scene's history, and what to forecast from it."""

    model_config = ConfigDict(
        json_schema_extra=_required(
            "frames",
            examples=[
                {
                    "frames": _EXAMPLE_FRAMES,
                    "mode": "full",
                    "num_samples": 20,
                    "horizon": 12,
                    "seed": 7,
                }
            ],
        ),
    )

    frames: tuple[Frame, ...] = Field((), description="At least one, in order of time.")
    model: _Model = None
    unknown_types: _UnknownTypes = UnknownTypes.REJECT
    type_map: _TypeMap = {}
    frame_interval_s: _FrameInterval = None

    def to_frames(self) -> tuple[core.Frame, ...]:
        """The history as the core takes it."""
        return tuple(frame.to_core() for frame in self.frames)


class CreateSessionRequest(Body):
    """A new session, and how it reads its frames."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"session_id": "crossing-4", "agent_timeout_s": 4.0}]},
    )

    session_id: str | None = Field(
        None,
        description="1 to 128 of `A-Z a-z 0-9 . _ -`; assigned by the server when absent.",
    )
    model: _Model = None
    frame_interval_s: _FrameInterval = None
    agent_timeout_s: float | None = Field(
        None,
        description="An agent unseen for longer (seconds) is dropped; default from the server.",
    )
    idle_timeout_s: float | None = Field(
        None,
        description="A session without traffic for longer (seconds) is closed; default from the "
        "server.",
    )
    unknown_types: _UnknownTypes = UnknownTypes.REJECT
    type_map: _TypeMap = {}

    def to_config(self) -> core.SessionConfig:
        """The configuration as the core takes it."""
        return core.SessionConfig(
            model=self.model or None,
            frame_interval_s=self.frame_interval_s,
            agent_timeout_s=self.agent_timeout_s,
            idle_timeout_s=self.idle_timeout_s,
            unknown_types=self.unknown_types,
            type_map=self.type_map,
        )


class ObserveRequest(Body):
    """Frames for a session, in order of time."""

    model_config = ConfigDict(
        json_schema_extra=_required("frames", examples=[{"frames": _EXAMPLE_FRAMES}]),
    )

    frames: tuple[Frame, ...] = Field((), description="At least one, in order of time.")

    def to_frames(self) -> tuple[core.Frame, ...]:
        """The frames as the core takes them."""
        return tuple(frame.to_core() for frame in self.frames)


class PredictSessionRequest(ForecastOptions):
    """What to forecast from the session's newest frame; an empty body asks for the defaults."""
