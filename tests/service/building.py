"""What the tests of the service's core build: frames, a real small model, an application."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from trajectron_model.config import ModelConfig, NodeType
from trajectron_model.trajectron import Trajectron
from trajectron_service.application import Application
from trajectron_service.engine import Engine
from trajectron_service.messages import (
    Agent,
    Forecast,
    ForecastOptions,
    Frame,
    SessionConfig,
    UnknownTypes,
)
from trajectron_service.metrics import Metrics
from trajectron_service.settings import Settings
from trajectron_service.stores import SessionStore
from trajectron_service.timebase import Observation

DT_S = 0.4
# Few samples, short: what is tested here does not depend on how many there are.
QUICK = ForecastOptions(num_samples=3, horizon=4, seed=7)


@dataclass
class Loaded:
    """A network as the engine wants it."""

    model: Trajectron
    name: str = "small"
    sha256: str = "0" * 64
    provenance: Mapping[str, object] = field(default_factory=dict)


class Clock:
    """A clock that stands until it is moved."""

    def __init__(self, now: float = 1_000_000.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now


def random_network(**config: Any) -> Trajectron:
    """A network of default size with weights of one seed, large enough that inputs matter."""
    with torch.random.fork_rng():
        torch.manual_seed(5)
        network = Trajectron(ModelConfig(**config))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(1.5)
    return network.eval().requires_grad_(False)


def mixed_network() -> Trajectron:
    """Pedestrians, and obstacles that never move."""
    types = (NodeType("pedestrian"), NodeType("obstacle", speed_limit_mps=0.0))
    return random_network(types=types)


def observation(time_s: float, **places: tuple[float, float]) -> Observation:
    """A checked frame of pedestrians: ``observation(0.4, ann=(1.0, 2.0))``."""
    positions = np.array(list(places.values()), dtype=np.float64).reshape(-1, 2)
    return Observation(time_s, tuple(places), ("pedestrian",) * len(places), positions)


def frame(time: float | None, **places: tuple[float, float]) -> Frame:
    """A client's frame of pedestrians."""
    agents = (Agent(name, "pedestrian", x, y) for name, (x, y) in places.items())
    return Frame(time, tuple(agents))


def walk(
    steps: Iterable[int], agents: Iterable[str] = ("ann", "bob", "cat"), dt_s: float = DT_S
) -> list[Frame]:
    """People who walk past each other, each on a gentle curve; equal times give equal places."""
    frames = []
    for step in steps:
        t = step * dt_s
        places = {
            name: (1.1 * t + row, row * 0.8 + 0.3 * float(np.sin(t + row)))
            for row, name in enumerate(agents)
        }
        frames.append(frame(t, **places))
    return frames


def application(
    network: Trajectron,
    *,
    store: SessionStore | None = None,
    clock: Clock | None = None,
    engine: Engine | None = None,
    **changes: Any,
) -> Application:
    """The application over a real network; not started, so nothing runs by itself."""
    settings = Settings(**{"warm_up": False, **changes})
    return Application(
        settings,
        engine or Engine([Loaded(network)]),
        Metrics(),
        store=store,
        clock=clock or Clock(),
        draw_seed=lambda: 11,
    )


async def predict(
    app: Application, frames: Iterable[Frame], options: ForecastOptions = QUICK, **changes: Any
) -> Forecast:
    """A stateless forecast with everything else at its default."""
    asked: dict[str, Any] = {
        "model": None,
        "unknown_types": UnknownTypes.REJECT,
        "type_map": {},
        "frame_interval_s": None,
        "deadline": None,
    }
    return await app.predict(frames=tuple(frames), options=options, **asked | changes)


async def observe_all(app: Application, session_id: str, frames: Iterable[Frame]) -> None:
    """Pushes frames one call each."""
    for one in frames:
        await app.observe(session_id, (one,), None)


def same_forecast(first: Forecast, second: Forecast, tolerance_m: float = 0.0) -> bool:
    """Whether two forecasts are of the same agents with the same numbers."""
    if [a.id for a in first.agents] != [a.id for a in second.agents]:
        return False
    for a, b in zip(first.agents, second.agents, strict=True):
        for name in ("samples", "mean", "covariance", "mode_probabilities", "sample_modes"):
            x, y = getattr(a, name), getattr(b, name)
            if (x is None) != (y is None):
                return False
            if x is not None and not np.allclose(x, y, rtol=0.0, atol=tolerance_m):
                return False
        if (a.x, a.y, a.last_observed_time) != (b.x, b.y, b.last_observed_time):
            return False
    return first.reference_time == second.reference_time


async def turns(count: int = 5) -> None:
    """Lets whatever is ready on the loop go on."""
    for _ in range(count):
        await asyncio.sleep(0)


def config(**changes: Any) -> SessionConfig:
    """A session's configuration."""
    return dataclasses.replace(SessionConfig(), **changes)
