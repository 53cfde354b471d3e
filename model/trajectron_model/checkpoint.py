"""Checkpoints: NAME.safetensors for the weights, NAME.json for configuration and provenance.

The JSON names the sha256 of the weights, so a pair that does not belong together, a
truncated or a damaged file is refused with what is wrong. Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError

from trajectron_model.config import ModelConfig
from trajectron_model.trajectron import Trajectron

FORMAT = 1


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message names the file and what is wrong with it."""


@dataclass(frozen=True)
class Description:
    """What the JSON of a checkpoint says.

    Attributes:
        name: the files' name without suffix; of a folder's ``model``, the folder's name.
        weights_sha256: of the weights' file, hexadecimal.
        config: of the model.
        provenance: task, data, split, seed, metrics, licence note, as JSON values.
    """

    name: str
    weights_sha256: str
    config: ModelConfig
    provenance: Mapping[str, Any]

    @property
    def sha256(self) -> str:
        """Of all that forecasts follow from, hexadecimal: the weights and the configuration."""
        settings = json.dumps(self.config.to_json(), sort_keys=True)
        return hashlib.sha256((self.weights_sha256 + settings).encode()).hexdigest()


@dataclass(frozen=True)
class Checkpoint:
    """A model with its description, ready to run."""

    model: Trajectron
    description: Description

    @property
    def name(self) -> str:
        """See ``Description``."""
        return self.description.name

    @property
    def sha256(self) -> str:
        """Of the weights' file, hexadecimal."""
        return self.description.sha256

    @property
    def provenance(self) -> Mapping[str, Any]:
        """See ``Description``."""
        return self.description.provenance

    @staticmethod
    def load(path: str | Path, device: str = "cpu") -> Checkpoint:
        """Reads a checkpoint.

        Args:
            path: of either file, or of both without their suffix, or of a folder that holds
                ``model.json``.
            device: where the weights go.

        Raises:
            CheckpointError: missing, damaged, truncated or mismatched files.
        """
        stem = _stem(path)
        description = describe(stem)
        file = _with_suffix(stem, ".safetensors")
        content = _read(file)
        if hashlib.sha256(content).hexdigest() != description.weights_sha256:
            raise CheckpointError(
                f"{file}: its sha256 is not the one that {stem.name}.json names: the file is "
                "damaged, truncated or of another model"
            )
        model = Trajectron(description.config)
        try:
            model.load_state_dict(safetensors.torch.load(content))
        except (SafetensorError, RuntimeError) as error:
            raise CheckpointError(
                f"{file}: the weights do not fit the configuration in {stem.name}.json: {error}"
            ) from error
        for name, tensor in model.state_dict().items():
            if not torch.isfinite(tensor).all():
                raise CheckpointError(f"{file}: {name} holds values that are not finite")
        model.eval().requires_grad_(False)
        return Checkpoint(model.to(device), description)


def describe(path: str | Path) -> Description:
    """What a checkpoint's JSON says, its weights unread.

    Raises:
        CheckpointError: a missing or damaged file.
    """
    stem = _stem(path)
    file = _with_suffix(stem, ".json")
    try:
        values = json.loads(_read(file))
        if values["format"] != FORMAT:
            raise CheckpointError(f"{file}: format {values['format']}, expected {FORMAT}")
        return Description(
            name=_name(stem),
            weights_sha256=str(values["sha256"]),
            config=ModelConfig.from_json(values["model"]),
            provenance=dict(values["provenance"]),
        )
    except CheckpointError:
        raise
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{file}: not the JSON of a checkpoint: {error!r}") from error


def save(path: str | Path, model: Trajectron, provenance: Mapping[str, Any]) -> None:
    """Writes PATH.safetensors and PATH.json, each whole or not at all."""
    stem = _stem(path)
    weights = {name: t.detach().cpu().contiguous() for name, t in model.state_dict().items()}
    content = safetensors.torch.save(weights)
    values = {
        "format": FORMAT,
        "sha256": hashlib.sha256(content).hexdigest(),
        "model": model.config.to_json(),
        "provenance": provenance,
    }
    write_atomically(_with_suffix(stem, ".safetensors"), content)
    text = json.dumps(values, indent=1, allow_nan=False) + "\n"
    write_atomically(_with_suffix(stem, ".json"), text.encode())


def write_atomically(file: Path, content: bytes) -> None:
    """Writes a file so that a reader sees the old content or the new, never a part."""
    partial = file.with_name(file.name + ".partial")
    with partial.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    partial.replace(file)


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{file}: {error.strerror or error}") from error


def _stem(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix in (".json", ".safetensors"):
        return path.with_suffix("")
    return path / "model" if path.is_dir() else path


def _name(stem: Path) -> str:
    # Training calls every model "model"; its folder tells them apart.
    return stem.resolve().parent.name if stem.name == "model" else stem.name


def _with_suffix(stem: Path, suffix: str) -> Path:
    # Not Path.with_suffix: a name may hold a dot.
    return stem.with_name(stem.name + suffix)
