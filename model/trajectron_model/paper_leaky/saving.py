"""Trained networks as files, and those that ship with the package.

The files are a baseline's (`trajectron_model.baselines.saving`), not a model's: nothing that
serves models reads them. Their description carries the warning.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trajectron_model.baselines import saving as baseline_files
from trajectron_model.paper_leaky import NAME, WARNING
from trajectron_model.paper_leaky.network import LeakyNetwork

_FOLDER = Path(__file__).parent / "weights"


def bundled(test_set: str, seed: int) -> Path:
    """Where the network trained without a test set, with a seed, stands; without suffix."""
    return _FOLDER / f"without-{test_set}-seed-{seed}"


def save(path: Path, network: LeakyNetwork, facts: Mapping[str, Any]) -> None:
    """Writes PATH.safetensors and PATH.json."""
    path.parent.mkdir(parents=True, exist_ok=True)
    baseline_files.save(path, NAME, network, {"warning": WARNING, **facts})


def load(path: Path) -> tuple[LeakyNetwork, baseline_files.Description]:
    """A network ready to forecast, and its description.

    Raises:
        CheckpointError: missing, damaged or mismatched files.
    """
    network = LeakyNetwork()
    description = baseline_files.load(path, NAME, network)
    return network, description
