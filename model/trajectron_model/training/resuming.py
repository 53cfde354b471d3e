"""What an interrupted training goes on from: weights, optimiser moments, counters.

Tensors are safetensors, and the counters JSON in their metadata. Random numbers need no
saving: every batch follows from the seed and its number.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open

from trajectron_model.checkpoint import CheckpointError, write_atomically
from trajectron_model.trajectron import Trajectron

_FILE = "resume.safetensors"


@dataclass(frozen=True)
class Run:
    """Where a training stands."""

    step: int
    best_step: int
    best_score: float
    identity: dict[str, Any]  # the settings and data that it was begun with

    def after_step(self) -> Run:
        """One gradient step later."""
        return replace(self, step=self.step + 1)

    def with_best(self, score: float) -> Run:
        """With this step's weights as the best."""
        return replace(self, best_step=self.step, best_score=score)


def save(
    folder: Path,
    model: Trajectron,
    average: Trajectron,
    optimiser: torch.optim.Optimizer,
    run: Run,
) -> None:
    """Writes what ``load`` reads: one file, whole or not at all, so that nothing can be torn."""
    tensors = {f"model.{name}": value for name, value in model.state_dict().items()}
    if average is not model:
        tensors |= {f"average.{name}": value for name, value in average.state_dict().items()}
    for number, moments in optimiser.state_dict()["state"].items():
        for name, value in moments.items():
            tensors[f"optimiser.{number}.{name}"] = torch.as_tensor(value)
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    content = safetensors.torch.save(tensors, metadata={"run": json.dumps(asdict(run))})
    write_atomically(folder / _FILE, content)


def load(
    folder: Path,
    model: Trajectron,
    average: Trajectron,
    optimiser: torch.optim.Optimizer,
    identity: dict[str, Any],
) -> Run:
    """Puts model, averaged model and optimiser where the training in ``folder`` stood.

    Raises:
        ValueError: a training that was begun with other settings or data.
        CheckpointError: a missing or damaged file.
    """
    try:
        with safe_open(folder / _FILE, framework="pt") as file:
            run = Run(**json.loads(file.metadata()["run"]))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
        raise CheckpointError(f"{folder}: no training to resume: {error}") from error
    if run.identity != json.loads(json.dumps(identity)):
        raise ValueError(f"{folder}: the training there was begun with other settings or data")
    model.load_state_dict(_part(tensors, "model."))
    if average is not model:
        average.load_state_dict(_part(tensors, "average."))
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimiser."):
            _, number, field = name.split(".")
            moments.setdefault(int(number), {})[field] = value
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": moments, "param_groups": groups})
    return run


def _part(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
