"""Whole histories in one pass: the batched form of ``Trajectron.step`` that training uses.

Motion is scanned with the same ``advance``, ages with ``scan_ages`` (equal to the online
counters), encoders with the same cells; only the nodes that are trained on are encoded,
the others give their motion to their neighbours. A test proves it equal to folding
``step``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajectron_model import graph
from trajectron_model.config import ModelConfig
from trajectron_model.encoders import EncoderState
from trajectron_model.features import Kinematics, advance, blank_kinematics


class History(NamedTuple):
    """Observed steps of one or several scenes, rows scene by scene."""

    position: NDArray[np.float64]  # [T, N, 2] metres; anything where absent
    present: NDArray[np.bool_]  # [T, N]
    node_type: NDArray[np.int64]  # [N]
    scene: NDArray[np.int64]  # [N] rising


class Edges(NamedTuple):
    """The edges of a history: every pair that was ever near, and when."""

    receiver: NDArray[np.int64]  # [E]
    sender: NDArray[np.int64]  # [E]
    mask: NDArray[np.bool_]  # [T, E]


def find_edges(history: History, config: ModelConfig) -> Edges:
    """The edge mask E of the paper, sparse: only pairs that were ever within their radius."""
    nodes = history.node_type.size
    radii = graph.radius_table(config)
    keys = []
    for position, present in zip(history.position, history.present, strict=True):
        receiver, sender = graph.find_edges(
            position, present, history.node_type, history.scene, radii
        )
        keys.append(receiver * nodes + sender)
    union = np.unique(np.concatenate(keys)) if keys else np.empty(0, dtype=np.int64)
    mask = np.zeros((len(keys), union.size), dtype=bool)
    for t, key in enumerate(keys):
        mask[t, np.searchsorted(union, key)] = True
    return Edges(union // max(nodes, 1), union % max(nodes, 1), mask)


def scan_motion(history: History, config: ModelConfig, device: torch.device) -> list[Kinematics]:
    """The motion of all nodes after each of T steps."""
    motion = blank_kinematics(history.node_type.size, device)
    position = torch.from_numpy(history.position).to(device)
    present = torch.from_numpy(history.present).to(device)
    scanned = []
    for t in range(position.shape[0]):
        time_s = torch.full_like(motion.last_seen_s, t * config.dt_s)
        motion = advance(motion, position[t], present[t], time_s, config)
        scanned.append(motion)
    return scanned


def scan_influence(history: History, edges: Edges, config: ModelConfig) -> Tensor:
    """min(sum of M, 1) of each node and edge type after each step: [T, N, K]."""
    kinds, nodes = len(config.types), history.node_type.size
    age, gone = graph.scan_ages(edges.mask)
    factors = graph.modulation(age, gone, config)  # [T, E]
    column = edges.receiver * kinds + history.node_type[edges.sender]
    total = np.stack([np.bincount(column, weights=row, minlength=nodes * kinds) for row in factors])
    clipped = np.minimum(total, 1.0).astype(np.float32)
    return torch.from_numpy(clipped).reshape(-1, nodes, kinds)


def gather(state: EncoderState, rows: Tensor) -> EncoderState:
    """The encoder states of some rows."""
    return EncoderState(*(column[rows] for column in state))
