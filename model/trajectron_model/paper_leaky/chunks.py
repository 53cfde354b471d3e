"""Recordings cut in chunks, with states by central differences: they contain the future.

Shape letters: C chunks, T steps of a chunk, S slots, A agents of a chunk, F = 6 features
(x, y, their velocities, their accelerations), all in metres and seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajectron_model.data.recording import Recording

CHUNK_STEPS = 100
FEATURES = 6
POSITION, VELOCITY = slice(0, 2), slice(2, 4)


@dataclass(frozen=True, eq=False)
class ChunkSet:
    """The chunks of a set of recordings: one "file" of the original.

    In each chunk its people stand in numbered slots, drawn at random; slots mean nothing
    from one chunk to the next.

    Attributes:
        states: [C, T, S, F] zeros where a slot is empty or its person absent.
        present: [C, T, S] whether a person is there; a row with x or y exactly 0 is not.
        lengths: [C] steps of each chunk less its trailing empty ones.
        slots: for each (recording's name, first step), the slot of each agent of that chunk.
        index: the chunk of each (recording's name, first step).
        dt_s: seconds between two steps.
    """

    states: NDArray[np.float32]
    present: NDArray[np.bool_]
    lengths: NDArray[np.int64]
    slots: Mapping[tuple[str, int], Mapping[int, int]]
    index: Mapping[tuple[str, int], int]
    dt_s: float


def cut(recordings: Sequence[Recording], seed: int) -> ChunkSet:
    """Chunks of 100 steps from each recording's first; a person in two chunks is two people.

    Args:
        recordings: of one dt; their names differ.
        seed: of the slots.

    Raises:
        ValueError: no recordings, several dt, or a name that occurs twice.
    """
    if len({r.name for r in recordings}) != len(recordings) or not recordings:
        raise ValueError("chunks need one or more recordings with names of their own")
    if len({r.dt_s for r in recordings}) != 1:
        raise ValueError("chunks need recordings of one dt")
    dt_s = recordings[0].dt_s
    parts = [
        ((r.name, first), *r.dense(first, min(first + CHUNK_STEPS, r.num_steps)))
        for r in recordings
        for first in range(0, r.num_steps, CHUNK_STEPS)
    ]
    num_slots = max(len(agents) for _, agents, _ in parts)
    random = np.random.default_rng(seed)
    states = np.zeros((len(parts), CHUNK_STEPS, num_slots, FEATURES), dtype=np.float32)
    slots: dict[tuple[str, int], dict[int, int]] = {}
    for chunk, (key, agents, positions) in enumerate(parts):
        drawn = random.permutation(num_slots)[: len(agents)]
        slots[key] = dict(zip(agents.tolist(), drawn.tolist(), strict=True))
        states[chunk, : len(positions), drawn] = kinematics(positions, dt_s).swapaxes(0, 1)
    present = (states[..., POSITION] != 0.0).all(axis=-1)
    anyone = (states != 0.0).any(axis=(2, 3))  # [C, T]
    lengths = np.where(anyone, np.arange(1, CHUNK_STEPS + 1), 0).max(axis=1)
    index = {key: chunk for chunk, (key, _, _) in enumerate(parts)}
    return ChunkSet(states, present, lengths.astype(np.int64), slots, index, dt_s)


def kinematics(positions: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    """Position, velocity and acceleration [T, A, F] of tracks [T, A, 2] in metres, NaN: absent.

    Central differences over each whole track, one-sided at its ends: the velocity of a step
    contains the next position, its acceleration the one after that. THIS IS THE LEAK.
    Absent steps are zeros; a track of a single step has neither velocity nor acceleration.
    """
    states = np.zeros((*positions.shape[:2], FEATURES))
    known = ~np.isnan(positions).any(axis=-1)  # [T, A]
    edges = np.diff(known.astype(np.int8), axis=0, prepend=0, append=0)  # [T + 1, A]
    for agent in range(positions.shape[1]):
        starts, ends = np.flatnonzero(edges[:, agent] == 1), np.flatnonzero(edges[:, agent] == -1)
        for start, end in zip(starts, ends, strict=True):
            track = positions[start:end, agent]
            velocity = _central(track, dt_s)
            row = np.concatenate([track, velocity, _central(velocity, dt_s)], axis=-1)
            states[start:end, agent] = row
    return states


def _central(values: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    if len(values) < 2:
        return np.zeros_like(values)
    rate: NDArray[np.float64] = np.gradient(values, dt_s, axis=0)
    return rate
