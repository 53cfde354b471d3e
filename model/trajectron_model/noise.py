"""Noise keyed by (seed, agent, step): a counter-based generator (Salmon et al. 2011).

The same request gives an agent the same samples whatever else is in the scene or batch,
in whatever order agents stand, on whichever machine. Asking for another number of samples
or steps is another request: fewer samples are not the first of more.
"""

from __future__ import annotations

import hashlib
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class AgentNoise(NamedTuple):
    """The random numbers of one agent's samples."""

    latent: NDArray[np.float32]  # [S] uniform: chooses z
    turn: NDArray[np.float32]  # [S] uniform: the direction of an agent without a heading
    component: NDArray[np.float32]  # [S, H] uniform: chooses mixture components
    normal: NDArray[np.float32]  # [S, H, 2] standard normal


def agent_noise(seed: int, agent_id: str, step: int, samples: int, horizon: int) -> AgentNoise:
    """Draws an agent's noise.

    Args:
        seed: of the request, 0 <= seed < 2**63.
        agent_id: the client's id.
        step: of the session: its count of accepted frames.
        samples: S.
        horizon: H.
    """
    digest = hashlib.blake2b(
        struct.pack("<QQ", seed, step) + agent_id.encode("utf-8", "surrogatepass"), digest_size=16
    ).digest()
    key = np.frombuffer(digest, dtype=np.uint64)
    generator = np.random.Generator(np.random.Philox(key=key))
    uniform = generator.random((samples, 2 + horizon), dtype=np.float32)
    normal = generator.standard_normal((samples, horizon, 2), dtype=np.float32)
    return AgentNoise(uniform[:, 0], uniform[:, 1], uniform[:, 2:], normal)
