"""Noise of the baselines, keyed by (seed, window): nothing else about a request changes it."""

from __future__ import annotations

import hashlib

import numpy as np

from trajectron_model.data.windows import Window


def window_generator(window: Window, seed: int) -> np.random.Generator:
    """A generator that depends on the window alone, not on those beside it."""
    recording = window.recording
    key = f"{seed}/{recording.name}/{recording.part}/{window.first}/{window.now}".encode()
    digest = hashlib.sha256(key).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "big"))
