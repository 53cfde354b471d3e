"""Scenes and small models for the tests of the model package."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from trajectron_model.config import ModelConfig, NodeType
from trajectron_model.state import SceneFrame, SceneState
from trajectron_model.trajectron import Trajectron

SceneMaker = Callable[..., list[SceneFrame]]


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def model() -> Trajectron:
    """A default model with weights large enough that every input matters."""
    return random_model(ModelConfig())


@pytest.fixture(scope="session")
def mixed_model() -> Trajectron:
    """Pedestrians, vehicles, and obstacles that never move; edges that fade."""
    return random_model(
        ModelConfig(
            types=(
                NodeType("pedestrian"),
                NodeType("vehicle", speed_limit_mps=60.0, speed_scale_mps=5.0),
                NodeType("obstacle", speed_limit_mps=0.0),
            ),
            radius_m=4.0,
            removal_filter=(0.6, 0.3),
        )
    )


def random_model(config: ModelConfig) -> Trajectron:
    torch.manual_seed(3)
    built = Trajectron(config)
    with torch.no_grad():
        for parameter in built.parameters():
            parameter.mul_(1.5)
    return built.eval().requires_grad_(False)


@pytest.fixture(scope="session")
def crowd() -> SceneMaker:
    """Random walkers that appear, go missing, come back and leave."""

    def make(
        steps: int = 14,
        agents: int = 12,
        seed: int = 0,
        types: tuple[str, ...] = ("pedestrian",),
        missing: float = 0.25,
        prefix: str = "",
    ) -> list[SceneFrame]:
        random = np.random.default_rng(seed)
        position = random.uniform(0.0, 7.0, (agents, 2))
        velocity = random.normal(0.0, 1.0, (agents, 2))
        kinds = [types[i % len(types)] for i in range(agents)]
        velocity[[kind == "obstacle" for kind in kinds]] = 0.0
        frames = []
        for step in range(steps):
            velocity += random.normal(0.0, 0.15, velocity.shape) * (velocity != 0.0)
            position = position + 0.4 * velocity
            seen = np.flatnonzero(random.random(agents) >= missing)
            order = random.permutation(seen)
            frames.append(
                SceneFrame(
                    0.4 * step,
                    tuple(f"{prefix}{i}" for i in order),
                    tuple(kinds[i] for i in order),
                    position[order].copy(),
                )
            )
        return frames

    return make


@pytest.fixture(scope="session")
def fold() -> Callable[[Trajectron, list[SceneFrame]], SceneState]:
    """The state after a scene's frames, one at a time."""

    def run(network: Trajectron, frames: list[SceneFrame]) -> SceneState:
        state = network.initial_state()
        for frame in frames:
            (state,) = network.step([state], [frame])
        return state

    return run
