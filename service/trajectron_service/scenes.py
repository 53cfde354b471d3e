"""What the engine is asked and answers: work on one scene as plain values, without torch.

States of scenes are opaque here (``State``): the engine makes and reads them. They are
named by serial numbers, as in ``timebase``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NewType, Protocol

from trajectron_service.messages import AgentForecast, ForecastMode, ModelInfo, Sampling, SceneGraph
from trajectron_service.timebase import Head, Step
from trajectron_service.tracing import Ticket

State = NewType("State", object)
# Live states, or the bytes that the engine packed them into.
States = tuple[State, ...] | bytes


@dataclass(frozen=True)
class ModelFacts:
    """What the core needs to know of a loaded model; limits in m/s by type.

    ``radii_m`` holds the distance up to which two agents are joined, for each pair of types.
    """

    info: ModelInfo
    speed_limits_mps: Mapping[str, float]
    radii_m: Mapping[tuple[str, str], float]


@dataclass(frozen=True, eq=False)
class ForecastTask:
    """A forecast from one head, every choice made.

    ``step`` is the session's version, part of the key of the noise. ``agents`` None is all.
    ``share`` (k, n) asks only for the k-th of n runs of these agents, from 0, and ``run`` (first,
    last) only for these of the samples: long forecasts are made in slices. ``deadline`` is on
    ``time.monotonic``; ``allow_fewer`` lets the first samples do where all would be late.
    """

    head: Head
    mode: ForecastMode
    num_samples: int
    horizon: int
    seed: int
    step: int
    agents: tuple[str, ...] | None
    include_modes: bool
    sampling: Sampling
    share: tuple[int, int] = (0, 1)
    run: tuple[int, int] | None = None
    deadline: float | None = None
    allow_fewer: bool = False

    @property
    def made(self) -> int:
        """Samples of each agent that are made: none for ``gmm``."""
        if self.mode is ForecastMode.GMM:
            return 0
        return self.num_samples if self.run is None else self.run[1] - self.run[0]


@dataclass(frozen=True, eq=False)
class SceneJob:
    """Work on one scene: steps in order, then forecasts from states before or after them.

    ``serials`` names ``states`` (also when they are bytes); ``keep`` the states wanted back.
    ``ticket`` says to tracing whose work it is.
    """

    model: str
    serials: tuple[int, ...]
    states: States
    steps: tuple[Step, ...] = ()
    keep: tuple[int, ...] = ()
    forecasts: tuple[ForecastTask, ...] = ()
    graph: Head | None = None
    pack: bool = False
    ticket: Ticket | None = None


@dataclass(frozen=True, eq=False)
class SceneResult:
    """The states of ``keep``, their bytes if asked for, the forecasts in order, the graph.

    ``edge_count`` is that of the newest state kept.
    """

    states: tuple[State, ...]
    packed: bytes | None
    forecasts: tuple[tuple[AgentForecast, ...], ...]
    graph: SceneGraph | None
    edge_count: int


class SceneEngine(Protocol):
    """What the application needs of the engine."""

    @property
    def models(self) -> Mapping[str, ModelFacts]:
        """The loaded models by name."""
        ...

    @property
    def default_model(self) -> str:
        """The model of requests that name none."""
        ...

    def warm_up(self) -> None:
        """Runs every model once, so that the first request is no slower than the rest."""
        ...

    def run(self, jobs: Sequence[SceneJob]) -> list[SceneResult]:
        """Does all jobs together; called from the inference thread only."""
        ...


def no_states() -> tuple[State, ...]:
    """The states of a scene before its first frame."""
    return ()
