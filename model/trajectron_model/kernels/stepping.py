"""One frame into each of many packed scenes, by one call of a kernel (``step.c``)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from trajectron_model.config import ModelConfig
from trajectron_model.encoders import HistoryEncoder
from trajectron_model.kernels.loading import Kernels
from trajectron_model.packed import EDGE, Layout

_START_ROOM = 256


class _Model(ctypes.Structure):
    """As in step.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("kinds", "history", "edge", "record_bytes")),
        *((name, ctypes.c_int64) for name in ("addition_steps", "removal_steps")),
        *((name, ctypes.c_double) for name in ("dt_s", "smoothing", "min_speed_mps", "reach_m")),
        *((name, ctypes.c_void_p) for name in ("radii", "speed_scale", "addition", "removal")),
        *((name, ctypes.c_void_p) for name in ("node_weight", "node_bias")),
        *((name, ctypes.c_void_p) for name in ("edge_weight", "edge_bias")),
    )


@dataclass(frozen=True)
class StepWeights:
    """A model as the kernel reads it; ``arrays`` are what ``model`` points to."""

    model: _Model
    layout: Layout
    arrays: tuple[NDArray[np.generic], ...]


class SceneRows:
    """Scenes one after the other, and what was observed of them, as the kernel wants it.

    Attributes:
        nodes: records of all scenes.
        node_start: [S + 1] the first record of each scene, and the end.
        edges: their edges before.
        edge_start: [S + 1].
        observed_start: [S + 1].
        observed: [A] row of each observed agent in its scene.
        position: [A, 2] metres.
        time_s: [S].
    """

    def __init__(
        self,
        nodes: Sequence[bytes],
        edges: Sequence[bytes],
        observed: Sequence[Sequence[int]],
        positions: Sequence[NDArray[np.float64]],
        times_s: Sequence[float],
        layout: Layout,
    ) -> None:
        """Raises ValueError for a row twice in a frame, or a position that is not finite."""
        self.nodes = nodes
        self.node_start = _starts([len(part) // layout.node.itemsize for part in nodes])
        self.edges = b"".join(edges)
        self.edge_start = _starts([len(part) // EDGE.itemsize for part in edges])
        self.observed_start = _starts([len(rows) for rows in observed])
        self.observed = np.array([row for rows in observed for row in rows], dtype=np.int32)
        self.position = np.ascontiguousarray(np.concatenate(positions), dtype=np.float64)
        self.time_s = np.array(times_s, dtype=np.float64)
        if any(len(set(rows)) != len(rows) for rows in observed):
            raise ValueError("a frame's ids must be distinct")
        if self.position.shape != (len(self.observed), 2) or not np.isfinite(self.position).all():
            raise ValueError("a frame's positions must be finite, one for each id")


def step(library: Kernels, weights: StepWeights, rows: SceneRows) -> list[tuple[bytes, bytes]]:
    """The records of each scene's agents and edges after its frame."""
    function = library.library.trajectron_step
    function.restype = ctypes.c_int64
    scenes = len(rows.time_s)
    room = 2 * (len(rows.edges) // EDGE.itemsize) + _START_ROOM
    after_start = np.empty(scenes + 1, dtype=np.int64)
    while True:
        nodes = np.frombuffer(bytearray().join((*rows.nodes, b"\0")), dtype=np.uint8)
        after = np.empty(room, dtype=EDGE)
        count = function(
            ctypes.byref(weights.model),
            ctypes.c_int64(scenes),
            _pointer(nodes),
            _pointer(rows.node_start),
            ctypes.c_char_p(rows.edges),
            _pointer(rows.edge_start),
            _pointer(rows.observed_start),
            _pointer(rows.observed),
            _pointer(rows.position),
            _pointer(rows.time_s),
            _pointer(after),
            _pointer(after_start),
            ctypes.c_int64(room),
        )
        if count < 0:
            raise MemoryError("no memory to step scenes")
        if count <= room:
            break
        room = count
    size = weights.layout.node.itemsize
    starts, ends = rows.node_start.tolist(), after_start.tolist()
    return [
        (
            nodes[starts[i] * size : starts[i + 1] * size].tobytes(),
            after[ends[i] : ends[i + 1]].tobytes(),
        )
        for i in range(scenes)
    ]


def pack_weights(
    config: ModelConfig, encoders: Sequence[nn.Module], radii: NDArray[np.float64]
) -> StepWeights:
    """The encoders of every type, in the kernel's order."""
    layout = Layout.of(config)
    histories = [encoder for encoder in encoders if isinstance(encoder, HistoryEncoder)]
    edge_cells = [cell for history in histories for cell in history.edges]
    arrays: dict[str, NDArray[np.generic]] = {
        "radii": np.ascontiguousarray(radii, dtype=np.float64),
        "speed_scale": np.array([t.speed_scale_mps for t in config.types], dtype=np.float32),
        "addition": np.array(config.addition_filter, dtype=np.float32),
        "removal": np.array(config.removal_filter or (0.0,), dtype=np.float32),
        "node_weight": np.stack([_weight(history.node) for history in histories]),
        "node_bias": np.stack([_bias(history.node) for history in histories]),
        "edge_weight": np.stack([_weight(cell) for cell in edge_cells]),
        "edge_bias": np.stack([_bias(cell) for cell in edge_cells]),
    }
    model = _Model(
        kinds=layout.kinds,
        history=layout.history_size,
        edge=layout.edge_size,
        record_bytes=layout.node.itemsize,
        addition_steps=len(config.addition_filter),
        removal_steps=len(config.removal_filter),
        dt_s=config.dt_s,
        smoothing=config.heading_smoothing,
        min_speed_mps=config.heading_min_speed_mps,
        reach_m=float(radii.max()),
        **{name: array.ctypes.data for name, array in arrays.items()},
    )
    return StepWeights(model, layout, tuple(arrays.values()))


def _weight(cell: nn.Module) -> NDArray[np.float32]:
    """[F + size, 4 size]: inputs first, then the hidden state."""
    assert isinstance(cell, nn.LSTMCell)
    both: Tensor = torch.cat([cell.weight_ih, cell.weight_hh], dim=1)
    weight: NDArray[np.float32] = both.detach().T.contiguous().numpy()
    return weight


def _bias(cell: nn.Module) -> NDArray[np.float32]:
    assert isinstance(cell, nn.LSTMCell)
    both: Tensor = cell.bias_ih + cell.bias_hh
    bias: NDArray[np.float32] = both.detach().contiguous().numpy()
    return bias


def _starts(sizes: Sequence[int]) -> NDArray[np.int64]:
    starts = np.zeros(len(sizes) + 1, dtype=np.int64)
    np.cumsum(sizes, out=starts[1:])
    return starts


def _pointer(array: NDArray[np.generic]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
