"""Trained baselines as files: NAME.safetensors for the weights, NAME.json for all else.

As the model's own checkpoints (`trajectron_model.checkpoint`): the JSON names the sha256 of the
weights, and nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import nn

from trajectron_model.checkpoint import CheckpointError, write_atomically

FORMAT = 1


@dataclass(frozen=True)
class Description:
    """What the JSON of a trained baseline says.

    Attributes:
        baseline: its name in the registry.
        sha256: of the weights' file, hexadecimal.
        provenance: data, settings, seed, selection, as JSON values.
    """

    baseline: str
    sha256: str
    provenance: Mapping[str, Any]


def save(path: Path, baseline: str, network: nn.Module, provenance: Mapping[str, Any]) -> None:
    """Writes PATH.safetensors and PATH.json, each whole or not at all."""
    weights = {name: t.detach().cpu().contiguous() for name, t in network.state_dict().items()}
    content = safetensors.torch.save(weights)
    values = {
        "format": FORMAT,
        "baseline": baseline,
        "sha256": hashlib.sha256(content).hexdigest(),
        "provenance": provenance,
    }
    write_atomically(_beside(path, ".safetensors"), content)
    text = json.dumps(values, indent=1, allow_nan=False) + "\n"
    write_atomically(_beside(path, ".json"), text.encode())


def describe(path: Path) -> Description:
    """What a trained baseline's JSON says, its weights unread.

    Raises:
        CheckpointError: a missing or damaged file.
    """
    file = _beside(path, ".json")
    try:
        values = json.loads(_read(file))
        if values["format"] != FORMAT:
            raise CheckpointError(f"{file}: format {values['format']}, expected {FORMAT}")
        return Description(
            str(values["baseline"]), str(values["sha256"]), dict(values["provenance"])
        )
    except CheckpointError:
        raise
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{file}: not the JSON of a baseline: {error!r}") from error


def load(path: Path, baseline: str, network: nn.Module) -> Description:
    """Reads weights into a network, which is then ready to forecast.

    Args:
        path: of the files, without suffix.
        baseline: the name that the files must bear.
        network: of the shape that was saved.

    Raises:
        CheckpointError: missing, damaged or mismatched files.
    """
    description = describe(path)
    file = _beside(path, ".safetensors")
    if description.baseline != baseline:
        raise CheckpointError(f"{file}: is of {description.baseline}, not of {baseline}")
    content = _read(file)
    if hashlib.sha256(content).hexdigest() != description.sha256:
        raise CheckpointError(
            f"{file}: its sha256 is not the one that {path.name}.json names: the file is "
            "damaged, truncated or of another baseline"
        )
    try:
        network.load_state_dict(safetensors.torch.load(content))
    except (SafetensorError, RuntimeError) as error:
        raise CheckpointError(f"{file}: the weights do not fit {baseline}: {error}") from error
    for name, tensor in network.state_dict().items():
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{file}: {name} holds values that are not finite")
    network.eval().requires_grad_(False)
    return description


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{file}: {error.strerror or error}") from error


def _beside(path: Path, suffix: str) -> Path:
    # Not Path.with_suffix: a name may hold a dot.
    return path.with_name(path.name + suffix)
