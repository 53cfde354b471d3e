"""What goes in: agents, frames, and what to forecast."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypedDict

import numpy as np
from numpy.typing import ArrayLike

ForecastMode = Literal["full", "z_best", "gmm"]
Sampling = Literal["iid", "stratified"]
UnknownTypes = Literal["reject", "ignore", "map"]
Delivery = Literal["all", "latest"]


@dataclass(frozen=True, slots=True)
class Agent:
    """One observed agent: ``x`` and ``y`` in metres, in your own world-fixed frame."""

    id: str
    type: str
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Frame:
    """Everything seen in a scene at one instant.

    Args:
        time: seconds on your own clock.
        agents: the agents seen; none is a valid observation.
    """

    time: float
    agents: Sequence[Agent] = ()

    @classmethod
    def from_arrays(
        cls,
        time: float,
        ids: Iterable[object],
        positions: ArrayLike,
        types: str | Iterable[str] = "pedestrian",
    ) -> Frame:
        """A frame from arrays.

        Args:
            time: seconds on your own clock.
            ids: [A] names or numbers of the agents.
            positions: [A, 2] metres.
            types: one type for all, or [A] types.

        Raises:
            ValueError: the lengths differ, or ``positions`` is not [A, 2].
        """
        names = [str(name) for name in ids]
        points = np.asarray(positions, dtype=np.float64).reshape(-1, 2)
        kinds = [types] * len(names) if isinstance(types, str) else list(types)
        if not len(names) == len(points) == len(kinds):
            raise ValueError(
                f"{len(names)} ids, {len(points)} positions and {len(kinds)} types: "
                "every agent needs one of each"
            )
        agents = tuple(
            Agent(name, kind, x, y)
            for name, kind, (x, y) in zip(names, kinds, points.tolist(), strict=True)
        )
        return cls(time, agents)


class ForecastOptions(TypedDict, total=False):
    """What to forecast; what is left out, or None, takes the server's default.

    Attributes:
        mode: ``"full"`` (the default) draws the latent value and the path, ``"z_best"`` the path
            under the most probable latent value, ``"gmm"`` draws nothing and answers with the
            Gaussians of every mode.
        num_samples: futures per agent, 1 to 2000; not for ``"gmm"``.
        horizon: steps of the model's dt, 1 to 60; the model's own horizon by default.
        seed: below 2**63; the same seed gives the same samples. Drawn by the server, and told in
            the forecast, when absent.
        agents: ids of the agents to forecast; all in the scene by default.
        include_modes: whether each mode's mean and covariance are returned; by default for
            ``"gmm"`` only.
        sampling: how one agent's samples go together: ``"iid"`` (the default), or ``"stratified"``:
            spread evenly over the distribution, so that a few cover more of it. Each alone has
            the same distribution, and agents are independent, either way.
        deadline_s: seconds for the service to answer in, from when it received the request or
            frame; what would be late is refused before it costs anything.
        allow_fewer_samples: where all samples would be late, the first ones, as many as are in
            time, at least one; the forecast says that they are fewer. Not for ``"gmm"``.
    """

    mode: ForecastMode
    num_samples: int | None
    horizon: int | None
    seed: int | None
    agents: Sequence[str] | None
    include_modes: bool | None
    sampling: Sampling
    deadline_s: float | None
    allow_fewer_samples: bool


class SessionOptions(TypedDict, total=False):
    """How a session reads its frames; what is left out, or None, takes the server's default.

    Attributes:
        model: a name from ``list_models()``.
        frame_interval_s: expected seconds between frames; the model's dt by default.
        agent_timeout_s: an agent unseen for longer is dropped.
        idle_timeout_s: a session without traffic for longer is closed.
        unknown_types: what happens to an agent whose type the model does not know: its frame is
            refused, it is left out, or it takes the type that ``type_map`` gives.
        type_map: from your types to the model's, for ``unknown_types="map"``.
    """

    model: str | None
    frame_interval_s: float | None
    agent_timeout_s: float | None
    idle_timeout_s: float | None
    unknown_types: UnknownTypes
    type_map: Mapping[str, str] | None


@dataclass(frozen=True, slots=True)
class StreamFrame:
    """A frame of a stream with a number, or options, of its own.

    Args:
        frame: the frame.
        sequence: rising over the session's life; the next number when None. A frame at or below
            the last number that the service acknowledged is answered as a duplicate.
        options: for this frame instead of the stream's; None for the stream's.
    """

    frame: Frame
    sequence: int | None = None
    options: ForecastOptions | None = None


def check_names(kind: type[object], given: Iterable[str]) -> None:
    """Refuses an option that does not exist, as Python does for any other argument.

    Raises:
        TypeError: naming the option and those that exist.
    """
    known = kind.__annotations__
    for name in given:
        if name not in known:
            raise TypeError(f"there is no option {name!r}; there are {', '.join(known)}")
