"""Trained networks as files, and those that ship with the package.

The files are a baseline's (`trajectron_model.baselines.saving`), not a model's: nothing that
serves models reads them. Their description carries the warning.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trajectron_model.baselines import saving
from trajectron_model.paper_leaky import NAME, WARNING
from trajectron_model.paper_leaky.network import LeakyNetwork

_FOLDER = Path(__file__).parent / "weights"


def bundled(test_set: str, seed: int) -> Path:
    """Where the network trained without a test set, with a seed, stands; without suffix."""
    return _FOLDER / f"without-{test_set}-seed-{seed}"


def seeds(test_set: str) -> tuple[int, ...]:
    """The seeds of which a network trained without the test set ships."""
    files = _FOLDER.glob(f"without-{test_set}-seed-*.json")
    return tuple(sorted(int(file.stem.rsplit("-", 1)[1]) for file in files))


def save(path: Path, network: LeakyNetwork, facts: Mapping[str, Any]) -> None:
    """Writes PATH.safetensors and PATH.json."""
    path.parent.mkdir(parents=True, exist_ok=True)
    saving.save(path, NAME, network, {"warning": WARNING, **facts})


def load(path: Path) -> tuple[LeakyNetwork, saving.Description]:
    """A network ready to forecast, and its description.

    Raises:
        CheckpointError: missing, damaged or mismatched files.
    """
    network = LeakyNetwork()
    description = saving.load(path, NAME, network)
    return network, description
