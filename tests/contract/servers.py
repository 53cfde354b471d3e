"""What the tests' servers run: a small real model, free ports, limits that are soon reached."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from trajectron_model import checkpoint
from trajectron_model.config import ModelConfig
from trajectron_model.trajectron import Trajectron
from trajectron_service.settings import Settings

MAX_MESSAGE_BYTES = 4 * 2**20
MAX_REPLY_BYTES = 6 * 2**20
MAX_SESSIONS = 64


def save_small_model(stem: Path, seed: int = 0) -> Path:
    """Writes a checkpoint of default size and gives its path; one seed, one model."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = Trajectron(ModelConfig())
    checkpoint.save(stem, model, {"task": "contract tests", "seed": seed})
    return stem


def small_settings(model: Path, **changes: Any) -> Settings:
    """Free ports on loopback, one model, limits small enough to reach them quickly."""
    values: dict[str, Any] = {
        "http_port": 0,
        "grpc_port": 0,
        "models": (str(model),),
        "max_message_bytes": MAX_MESSAGE_BYTES,
        "max_reply_bytes": MAX_REPLY_BYTES,
        "max_sessions": MAX_SESSIONS,
        "drain_grace_s": 5.0,
    }
    return Settings(**values | changes)
