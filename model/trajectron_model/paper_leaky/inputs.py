"""What the network reads: standardised states, sums over neighbours, the edge mask.

Everything here is taken from the set itself, the test set at test time: THIS LEAKS.

Shape letters: C chunks, T steps, S slots, F features.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajectron_model.paper_leaky.chunks import POSITION, ChunkSet

RADIUS_M = 1.5
ADDITION_QUARTERS = (1, 2, 3, 4)
"""The filter .25, .5, .75, 1, in quarters."""
_STD_FLOOR = 0.01


@dataclass(frozen=True)
class Inputs:
    """A set of chunks, ready for the network.

    Attributes:
        states: [C, T, S, F] standardised by slot; an absent step is -mean / std, not zero.
        present: [C, T, S].
        lengths: [C].
        sums: [C, T, S, F] of the standardised states of each slot's neighbours.
        degree: [S] number of each slot's neighbours.
        mask: [C, T, S] what the edge encoder's output is multiplied by.
        mean, std: [S, F] of the slots.
        position: [C, T, S, 2] metres.
        dt_s: seconds between two steps.
    """

    states: Tensor
    present: Tensor
    lengths: Tensor
    sums: Tensor
    degree: Tensor
    mask: Tensor
    mean: Tensor
    std: Tensor
    position: Tensor
    dt_s: float


def prepare(chunks: ChunkSet) -> Inputs:
    """A set of chunks, standardised by its own statistics, with its own graph."""
    mean, std = slot_statistics(chunks.states)
    adjacency, mask = graph(chunks.states[..., POSITION])
    neighbours = torch.from_numpy(adjacency.astype(np.float32))
    states = torch.from_numpy((chunks.states - mean) / std)
    return Inputs(
        states=states,
        present=torch.from_numpy(chunks.present),
        lengths=torch.from_numpy(chunks.lengths),
        sums=neighbours @ states,
        degree=neighbours.sum(dim=1),
        mask=torch.from_numpy(mask),
        mean=torch.from_numpy(mean),
        std=torch.from_numpy(std),
        position=torch.from_numpy(chunks.states[..., POSITION]),
        dt_s=chunks.dt_s,
    )


def slot_statistics(
    states: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and deviation [S, F] of each slot over all its non-zero entries in all chunks.

    A slot holds the tracks of a few people, so its statistics tell of where they go.
    A deviation is at least 0.01; an entry that is never filled has mean 0 and deviation 1.
    """
    filled = states != 0.0
    count = filled.sum(axis=(0, 1))
    number = np.maximum(count, 1)
    mean = states.sum(axis=(0, 1), dtype=np.float64) / number
    square = (np.where(filled, states - mean, 0.0) ** 2).sum(axis=(0, 1))
    std = np.where(count > 0, np.maximum(np.sqrt(square / number), _STD_FLOOR), 1.0)
    return mean.astype(np.float32), std.astype(np.float32)


def graph(
    position: NDArray[np.float32],
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """The aggregate graph and the edge mask of positions [C, T, S, 2], metres.

    Two slots are neighbours for ever, in every chunk, if they come within 1.5 m at any step
    of any chunk. Absent slots stand at the origin, so they are near each other: in effect all
    slots are neighbours.

    Returns:
        neighbours [S, S] and mask [C, T, S], see `edge_mask`.
    """
    num_slots = position.shape[2]
    neighbours = np.zeros((num_slots, num_slots), dtype=bool)
    mask = np.empty(position.shape[:3], dtype=np.float32)
    apart = ~np.eye(num_slots, dtype=bool)
    for chunk, track in enumerate(position):
        x, y = track[..., 0], track[..., 1]  # [T, S]
        square = (x[:, :, None] - x[:, None, :]) ** 2
        square += (y[:, :, None] - y[:, None, :]) ** 2
        near = (square <= RADIUS_M**2) & apart  # [T, S, S]
        neighbours |= near.any(axis=0)
        mask[chunk] = edge_mask(near)
    return neighbours, mask


def edge_mask(near: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The mask [T, S] of a chunk's adjacency [T, S, S]: it LOOKS AHEAD.

    An edge counts .25, .5 and .75 in the three steps before it begins, 1 from its first step,
    and nothing once it has gone; a slot's mask is the sum over its edges, at most 1.
    """
    # In quarters, as small integers: there are millions of pairs.
    quarters = np.zeros(near.shape, dtype=np.uint8)
    for ahead, weight in enumerate(reversed(ADDITION_QUARTERS)):
        last = len(near) - ahead
        if last > 0:
            quarters[:last] += weight * near[ahead:].view(np.uint8)
    summed = np.minimum(quarters, 4).sum(axis=-1, dtype=np.int64)
    mask: NDArray[np.float32] = np.minimum(summed / 4.0, 1.0).astype(np.float32)
    return mask
