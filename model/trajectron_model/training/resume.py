"""What an interrupted training goes on from: weights, optimiser moments, counters.

Tensors are safetensors and the rest is JSON. Random numbers need no saving: every batch
follows from the seed and its number.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError

from trajectron_model.checkpoint import CheckpointError, write_atomically
from trajectron_model.trajectron import Trajectron

_TENSORS = "resume.safetensors"
_COUNTERS = "resume.json"


@dataclass(frozen=True)
class Run:
    """Where a training stands."""

    step: int
    best_step: int
    best_score: float
    identity: dict[str, Any]  # the settings that it was begun with

    def after_step(self) -> Run:
        """One gradient step later."""
        return replace(self, step=self.step + 1)

    def with_best(self, score: float) -> Run:
        """With this step's weights as the best."""
        return replace(self, best_step=self.step, best_score=score)


def save(folder: Path, model: Trajectron, optimiser: torch.optim.Optimizer, run: Run) -> None:
    """Writes what ``load`` reads; the counters last, so that a torn write is not taken up."""
    tensors = {f"model.{name}": value for name, value in model.state_dict().items()}
    for number, moments in optimiser.state_dict()["state"].items():
        for name, value in moments.items():
            tensors[f"optimiser.{number}.{name}"] = torch.as_tensor(value)
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    write_atomically(folder / _TENSORS, safetensors.torch.save(tensors))
    counters = {
        "step": run.step,
        "best_step": run.best_step,
        "best_score": run.best_score,
        "identity": run.identity,
    }
    write_atomically(folder / _COUNTERS, json.dumps(counters, indent=1).encode())


def load(
    folder: Path, model: Trajectron, optimiser: torch.optim.Optimizer, identity: dict[str, Any]
) -> Run:
    """Puts model and optimiser where the training in ``folder`` stood.

    Raises:
        ValueError: a training that was begun with other settings.
        CheckpointError: missing or damaged files.
    """
    try:
        counters = json.loads((folder / _COUNTERS).read_text())
        tensors = safetensors.torch.load((folder / _TENSORS).read_bytes())
        run = Run(
            step=int(counters["step"]),
            best_step=int(counters["best_step"]),
            best_score=float(counters["best_score"]),
            identity=counters["identity"],
        )
    except (OSError, KeyError, ValueError, SafetensorError) as error:
        raise CheckpointError(f"{folder}: no training to resume: {error}") from error
    if run.identity != json.loads(json.dumps(identity)):
        raise ValueError(f"{folder}: the training there was begun with other settings")
    model.load_state_dict(
        {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
    )
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimiser."):
            _, number, field = name.split(".")
            moments.setdefault(int(number), {})[field] = value
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": moments, "param_groups": groups})
    return run
