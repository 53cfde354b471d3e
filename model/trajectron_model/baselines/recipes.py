"""How each learned baseline is made: its network, its losses, its settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from trajectron_model.baselines import kalman_fitting
from trajectron_model.baselines.lstm import Lstm
from trajectron_model.baselines.network import SceneNetwork
from trajectron_model.baselines.sgan import Generator
from trajectron_model.baselines.sgan_training import VARIETY, SganUpdate
from trajectron_model.baselines.social_attention import SocialAttention
from trajectron_model.baselines.social_lstm import SocialLstm
from trajectron_model.baselines.stepping import SteppingNetwork
from trajectron_model.baselines.training import (
    BaselineSettings,
    LikelihoodUpdate,
    Update,
    Validated,
)
from trajectron_model.baselines.training import train as run
from trajectron_model.data.recording import Recording

NETWORKS: dict[str, Callable[[], SceneNetwork]] = {
    "lstm": Lstm,
    "social-lstm": SocialLstm,
    "social-attention": SocialAttention,
    "sgan": Generator,
}
"""The networks by the baselines' names, at the sizes that are trained and shipped."""

SETTINGS = {
    "kalman": BaselineSettings(),
    "lstm": BaselineSettings(windows=32, agents=6, jitter_m=0.03, minutes=2.0),
    "social-lstm": BaselineSettings(agents=12, jitter_m=0.03, minutes=4.0),
    "social-attention": BaselineSettings(agents=9, jitter_m=0.03, minutes=4.0),
    "sgan": BaselineSettings(agents=8, samples=VARIETY, minutes=5.0),
}


def begin(name: str, settings: BaselineSettings) -> tuple[SceneNetwork, Update]:
    """A fresh network, and what takes its gradient steps.

    Raises:
        KeyError: not a baseline with a network.
    """
    torch.manual_seed(settings.seed)
    network = NETWORKS[name]()
    if isinstance(network, Generator):
        return network, SganUpdate(network, settings.seed)
    if isinstance(network, SteppingNetwork):
        return network, LikelihoodUpdate(network)
    raise TypeError(f"{name} has no training")


def train(
    name: str,
    settings: BaselineSettings,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    folder: Path,
    *,
    provenance: dict[str, Any],
    observe: Callable[[Validated], None] = lambda _: None,
) -> Path:
    """Trains a learned baseline from the start; see `training.train`, `kalman_fitting.train`.

    Raises:
        KeyError: not a learned baseline.
        ValueError: data that cannot be trained or validated on.
    """
    if name == "kalman":
        return kalman_fitting.train(name, training, validation, folder, provenance=provenance)
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    network, update = begin(name, settings)
    return run(
        name,
        network,
        update,
        settings,
        training,
        validation,
        folder,
        provenance=provenance,
        observe=observe,
    )
