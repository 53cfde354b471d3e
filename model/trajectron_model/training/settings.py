"""The settings of a training, and the named combinations of settings (presets)."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from trajectron_model.config import ModelConfig, NodeType
from trajectron_model.training.examples import ExampleSettings
from trajectron_model.training.objective import ObjectiveSettings


@dataclass(frozen=True)
class TrainSettings:
    """How a model is trained.

    Attributes:
        steps: gradient steps in all.
        learning_rate: at its peak; it warms up and then falls to zero along a cosine.
        warm_up: share of the steps until the peak.
        clip_norm: bound on the gradient's norm.
        average_steps: about how many steps the weights are averaged over, by an exponential
            decay of 1 - 1 / n; the average is what is validated and kept. 0 averages nothing.
        validate_every: steps between validations; the best of them is kept.
        seed: of weights, examples and noise.
        threads: of torch; None leaves them as they are.
        calibrate: whether the spread of the modes is fitted to validation data at the end.
    """

    steps: int = 1100
    learning_rate: float = 2e-3
    warm_up: float = 0.1
    clip_norm: float = 1.0
    average_steps: int = 0
    validate_every: int = 100
    seed: int = 0
    threads: int | None = None
    calibrate: bool = True
    examples: ExampleSettings = field(default_factory=ExampleSettings)
    objective: ObjectiveSettings = field(default_factory=ObjectiveSettings)

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of a step, counted from 0."""
        warm = max(1, round(self.warm_up * self.steps))
        if step < warm:
            return self.learning_rate * (step + 1) / warm
        share = (step - warm) / max(1, self.steps - warm)
        return self.learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))

    def to_json(self) -> dict[str, Any]:
        """As JSON values, for provenance and for checking what is resumed."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class Preset:
    """A named model configuration with the settings it is trained with."""

    model: ModelConfig
    train: TrainSettings


def presets() -> dict[str, Preset]:
    """All presets by name.

    ``default``: the model this project ships, trained on the exact marginal likelihood, its
    weights averaged.
    ``elbo``: the same model on the beta-weighted ELBO. ``paper``: the paper's own inputs
    (raw positions, velocities and accelerations) and radius, on the ELBO. ``traffic``:
    pedestrians, vehicles and cyclists on ApolloScape's 0.5 s grid.
    """
    elbo = ObjectiveSettings(name="elbo", beta_start=0.02, beta_end=1.0, beta_ramp=0.7)
    traffic = ModelConfig(
        types=(
            NodeType("pedestrian"),
            NodeType("vehicle", speed_limit_mps=60.0, speed_scale_mps=5.0),
            NodeType("cyclist", speed_limit_mps=20.0, speed_scale_mps=3.0),
        ),
        dt_s=0.5,
        horizon=10,
        observed_steps=6,
        radius_m=10.0,
    )
    paper = ModelConfig(features="world", radius_m=1.5)
    return {
        "default": Preset(ModelConfig(), TrainSettings(steps=1800, average_steps=120)),
        "elbo": Preset(ModelConfig(), TrainSettings(objective=elbo)),
        "paper": Preset(paper, TrainSettings(objective=elbo)),
        "traffic": Preset(traffic, TrainSettings(examples=ExampleSettings(agents=96))),
    }
