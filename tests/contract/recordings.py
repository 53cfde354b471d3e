"""Recordings to be sent along with an evaluation."""

from __future__ import annotations

import numpy as np


def walkers(steps: int = 24, agents: int = 3, seed: int = 0) -> bytes:
    """CSV of people who walk side by side, each with a little noise."""
    rng = np.random.default_rng(seed)
    strides = rng.normal([0.5, 0.0], 0.05, size=(steps, agents, 2))
    places = np.cumsum(strides, axis=0) + np.arange(agents)[:, None] * [0.0, 1.0]  # [T, A, 2]
    rows = [
        f"{0.4 * step:.1f},{agent},pedestrian,{x:.4f},{y:.4f}"
        for step, scene in enumerate(places.tolist())
        for agent, (x, y) in enumerate(scene)
    ]
    return "\n".join(["time,id,type,x,y", *rows, ""]).encode()
