"""The models that ship with the package, by name, and any other by path."""

from __future__ import annotations

from pathlib import Path

from trajectron_model import checkpoint
from trajectron_model.checkpoint import Checkpoint, CheckpointError, Description

DEFAULT = "eth_ucy"
_FOLDER = Path(__file__).parent / "weights"


def names() -> tuple[str, ...]:
    """Names of the bundled models, the default first."""
    found = sorted(file.stem for file in _FOLDER.glob("*.json"))
    return tuple(sorted(found, key=lambda name: (name != DEFAULT, name)))


def locate(name_or_path: str | Path) -> Path:
    """Where a model's files are: a bundled name wins over a path.

    Raises:
        CheckpointError: neither a bundled model nor a checkpoint.
    """
    if str(name_or_path) in names():
        return _FOLDER / str(name_or_path)
    path = Path(name_or_path)
    stem = path.with_suffix("") if path.suffix in (".json", ".safetensors") else path
    if path.is_dir() or stem.with_name(stem.name + ".json").exists():
        return path
    bundled = ", ".join(names()) or "none"
    raise CheckpointError(f"{name_or_path}: neither a bundled model ({bundled}) nor a checkpoint")


def describe(name_or_path: str | Path) -> Description:
    """What a model is, its weights unread; raises CheckpointError."""
    return checkpoint.describe(locate(name_or_path))


def load(name_or_path: str | Path, device: str = "cpu") -> Checkpoint:
    """A model ready to run; raises CheckpointError."""
    return Checkpoint.load(locate(name_or_path), device)
