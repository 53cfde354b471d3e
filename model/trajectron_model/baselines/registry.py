"""The baselines by name, and the weights of the learned ones that ship with the package."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trajectron_model.baselines import saving
from trajectron_model.baselines.constant_velocity import ConstantVelocity
from trajectron_model.baselines.kalman import Kalman, LevelsModule
from trajectron_model.baselines.linear import Linear
from trajectron_model.baselines.lstm import Lstm, LstmPredictor
from trajectron_model.baselines.network import NetworkPredictor
from trajectron_model.baselines.recipes import NETWORKS
from trajectron_model.checkpoint import CheckpointError
from trajectron_model.predictor import Predictor

LEARNED = ("kalman", "lstm", "social-lstm", "social-attention", "sgan")
"""Those fitted to data: one for each test set, which it has not seen."""

NAMES = ("constant-velocity", "constant-velocity-noise", "linear", *LEARNED)
"""Every baseline."""

HEADING_NOISE_DEG = 25.0
"""Of constant velocity with noise, as published (Schoeller et al., RA-L 2020)."""

_FOLDER = Path(__file__).parent / "weights"


def baseline(name: str, test_set: str | None = None) -> Predictor:
    """A baseline, ready to forecast.

    Args:
        name: one of `NAMES`.
        test_set: of ETH/UCY: a learned baseline is the one trained without it; None for the one
            trained on all recordings. It makes no difference to the others.

    Raises:
        CheckpointError: no such baseline, or no weights of it for the test set.
    """
    if name == "constant-velocity":
        return ConstantVelocity()
    if name == "constant-velocity-noise":
        return ConstantVelocity(HEADING_NOISE_DEG)
    if name == "linear":
        return Linear()
    return load(name, _located(name, test_set))


def load(name: str, path: Path) -> Predictor:
    """A learned baseline from its files; ``path`` is theirs, without suffix.

    Raises:
        CheckpointError: not a learned baseline, or files that are missing, damaged or another's.
    """
    if name == "kalman":
        levels = LevelsModule()
        saving.load(path, name, levels)
        return Kalman(levels.value(), name)
    if name not in NETWORKS:
        raise CheckpointError(f"{name}: the learned baselines are {', '.join(LEARNED)}")
    network = NETWORKS[name]()
    saving.load(path, name, network)
    if isinstance(network, Lstm):
        return LstmPredictor(network, name)
    return NetworkPredictor(network, name)


def provenance(name: str, test_set: str | None = None) -> Mapping[str, Any]:
    """What a baseline was fitted and selected on, as a checkpoint's provenance says it.

    Returns:
        ``training`` and ``validation`` with their ``recordings``, settings, outcome; empty for
        a baseline that has learned nothing.

    Raises:
        CheckpointError: as `baseline`.
    """
    if name in NAMES and name not in LEARNED:
        return {}
    return saving.describe(_located(name, test_set)).provenance


def sha256(name: str, test_set: str | None = None) -> str:
    """Of a baseline's weights, hexadecimal; empty for one that has learned nothing.

    Raises:
        CheckpointError: as `baseline`.
    """
    if name in NAMES and name not in LEARNED:
        return ""
    return saving.describe(_located(name, test_set)).sha256


def file_name(name: str, test_set: str | None) -> str:
    """What the files of a learned baseline are called, without suffix."""
    return name if test_set is None else f"{name}-without-{test_set}"


def _located(name: str, test_set: str | None) -> Path:
    if name not in LEARNED:
        raise CheckpointError(f"{name}: the baselines are {', '.join(NAMES)}")
    path = _FOLDER / file_name(name, test_set)
    if path.with_name(path.name + ".json").exists():
        return path
    found = sorted(file.stem for file in _FOLDER.glob(f"{name}*.json"))
    wanted = "all recordings" if test_set is None else f"all recordings but test set {test_set}"
    raise CheckpointError(
        f"{name}: no weights trained on {wanted} are bundled (there are: "
        f"{', '.join(found) or 'none'}); train them with `trajectron train-baseline`"
    )
