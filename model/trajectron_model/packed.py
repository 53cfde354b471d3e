"""Scenes as packed records: what serving keeps, steps and stores.

A `PackedScene` says what a `SceneState` says, in two runs of bytes: a record for each agent
and one for each edge. Many of them are joined by copying bytes and stepped by a kernel in one
call (``kernels.stepping``); kept, they cost a few hundred bytes an agent; written, they are
written as they are. The layout depends on the model's sizes alone (`Layout`).

Shape letters: N agents, E edges, K edge types.
"""

from __future__ import annotations

import functools
import json
import math
import struct
import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajectron_model import graph
from trajectron_model.config import ModelConfig
from trajectron_model.encoders import EncoderState
from trajectron_model.features import Kinematics
from trajectron_model.graph import Graph
from trajectron_model.rows import SceneRows
from trajectron_model.state import SceneEdge, SceneState, blank_state

Records = NDArray[np.void]

if sys.byteorder != "little":  # pragma: no cover - no such machine runs this
    raise ImportError("packed scenes are little-endian, as every machine that this runs on")

_MAGIC = b"TJPS"
_VERSION = 1
# Magic, version, node types, history size, edge size, agents, edges, bytes of ids, time.
_HEAD = struct.Struct("<4sHHHHIIId")

EDGE = np.dtype([("receiver", "<i4"), ("sender", "<i4"), ("age", "<i4"), ("gone", "<i4")])
"""Rows of the scene, sorted by (receiver, sender); the counters of ``graph.Graph``."""


@dataclass(frozen=True)
class Layout:
    """The sizes that a record depends on."""

    kinds: int
    history_size: int
    edge_size: int

    @classmethod
    def of(cls, config: ModelConfig) -> Layout:
        """The layout of a model's scenes."""
        return cls(len(config.types), config.history_size, config.edge_size)

    @property
    def node(self) -> np.dtype[np.void]:
        """One agent; ``step.c`` has the same, in the same order."""
        return _node(self.kinds, self.history_size, self.edge_size)

    def blank(self, kind: int) -> bytes:
        """The record of an agent that has not been seen yet."""
        return _blank(self, kind)


@functools.cache
def _node(kinds: int, history_size: int, edge_size: int) -> np.dtype[np.void]:
    return np.dtype(
        [
            ("position", "<f8", 2),
            ("last_seen_s", "<f8"),
            ("type", "<i4"),
            ("observations", "<i4"),
            ("heading_known", "<i4"),
            ("unused", "<i4"),
            ("velocity", "<f4", 2),
            ("acceleration", "<f4", 2),
            ("smoothed", "<f4", 2),
            ("heading", "<f4", 2),
            ("turn", "<f4", 2),
            ("influence", "<f4", (kinds,)),
            ("node_h", "<f4", history_size),
            ("node_c", "<f4", history_size),
            ("edge_h", "<f4", (kinds, edge_size)),
            ("edge_c", "<f4", (kinds, edge_size)),
            # Keeps doubles where they belong in the next record.
            *([("fill", "<f4")] if kinds % 2 else []),
        ]
    )


@functools.cache
def _blank(layout: Layout, kind: int) -> bytes:
    record = np.zeros(1, dtype=layout.node)
    record["type"] = kind
    record["heading"][:, 0] = record["turn"][:, 0] = 1.0
    return record.tobytes()


class PackedScene(NamedTuple):
    """A scene's state; immutable."""

    ids: tuple[str, ...]  # N
    nodes: bytes  # N records of ``Layout.node``
    edges: bytes  # E records of ``EDGE``
    time_s: float  # of the newest frame; -inf before the first

    @property
    def edge_count(self) -> int:
        """Directed edges, present and fading."""
        return len(self.edges) // EDGE.itemsize

    def types(self, layout: Layout) -> list[int]:
        """[N] type indices."""
        kinds: list[int] = np.frombuffer(self.nodes, dtype=layout.node)["type"].tolist()
        return kinds

    def to_bytes(self, layout: Layout) -> bytes:
        """A portable copy; ``from_bytes`` gives the scene back bit for bit."""
        ids = zlib.compress(json.dumps(self.ids).encode(), 1)
        head = _HEAD.pack(
            _MAGIC,
            _VERSION,
            layout.kinds,
            layout.history_size,
            layout.edge_size,
            len(self.ids),
            self.edge_count,
            len(ids),
            self.time_s,
        )
        return b"".join((head, ids, self.nodes, self.edges))

    @staticmethod
    def from_bytes(data: bytes, layout: Layout) -> PackedScene:
        """Reads ``to_bytes``'s result; raises ValueError when it is none of this layout.

        Every number that a kernel follows is looked at: what comes back is safe to step.
        """
        if len(data) < _HEAD.size:
            raise ValueError("these bytes are no packed scene: too short")
        magic, version, *sizes, agents, edges, named, time_s = _HEAD.unpack_from(data)
        if magic != _MAGIC:
            raise ValueError("these bytes are no packed scene")
        if version != _VERSION:
            raise ValueError(f"a packed scene of version {version}, expected {_VERSION}")
        if Layout(*sizes) != layout:
            raise ValueError(f"a packed scene of sizes {sizes}, of another model")
        first = _HEAD.size + named
        middle = first + agents * layout.node.itemsize
        if len(data) != middle + edges * EDGE.itemsize:
            raise ValueError("a packed scene of another length than it says")
        scene = PackedScene(
            _ids(data[_HEAD.size : first], agents), data[first:middle], data[middle:], time_s
        )
        _check(scene, layout)
        return scene


def _ids(data: bytes, agents: int) -> tuple[str, ...]:
    unpacker = zlib.decompressobj()
    # Names are bounded long before this; a damaged length must not ask for gigabytes.
    try:
        text = unpacker.decompress(data, 8192 * (agents + 1))
        ids = json.loads(text)
    except (zlib.error, ValueError, RecursionError) as error:
        raise ValueError(f"a packed scene's ids cannot be read: {error}") from error
    if not isinstance(ids, list) or not all(isinstance(name, str) for name in ids):
        raise ValueError("a packed scene's ids are no list of texts")
    if len(ids) != agents or len(set(ids)) != agents:
        raise ValueError("a packed scene's ids are not one for each agent")
    return tuple(ids)


def _check(scene: PackedScene, layout: Layout) -> None:
    nodes = np.frombuffer(scene.nodes, dtype=layout.node)
    edges = np.frombuffer(scene.edges, dtype=EDGE)
    types, count = nodes["type"], len(nodes)
    if ((types < 0) | (types >= layout.kinds) | (nodes["observations"] < 0)).any():
        raise ValueError("a packed scene with an agent of no type")
    receiver, sender = edges["receiver"].astype(np.int64), edges["sender"].astype(np.int64)
    ends = np.concatenate([receiver, sender])
    if ((ends < 0) | (ends >= count)).any() or (receiver == sender).any():
        raise ValueError("a packed scene with an edge that joins nobody")
    if (np.diff(receiver * count + sender) <= 0).any():
        raise ValueError("a packed scene with edges out of order")
    if ((edges["age"] < 1) | (edges["gone"] < 0)).any():
        raise ValueError("a packed scene with edges of no age")


def blank_scene() -> PackedScene:
    """A scene without agents, before its first frame."""
    return PackedScene((), b"", b"", -math.inf)


def pack(state: SceneState, layout: Layout) -> PackedScene:
    """The state as records."""
    nodes = np.zeros(len(state.ids), dtype=layout.node)
    nodes["type"] = state.node_type.cpu().numpy()
    nodes["influence"] = state.influence.cpu().numpy()
    for columns in (state.motion, state.encoder):
        for name, column in columns._asdict().items():
            nodes[name] = column.cpu().numpy()
    edges = np.zeros(len(state.graph.receiver), dtype=EDGE)
    for name, values in state.graph._asdict().items():
        edges[name] = values
    return PackedScene(state.ids, nodes.tobytes(), edges.tobytes(), state.time_s)


def unpack(scene: PackedScene, config: ModelConfig, device: torch.device) -> SceneState:
    """The scene as tensors."""
    if not scene.ids:
        return blank_state(config, device)._replace(time_s=scene.time_s)
    edges = np.frombuffer(scene.edges, dtype=EDGE)
    counters = Graph(*(edges[name].astype(np.int64) for name in Graph._fields))
    rows = rows_of([scene], config, device)
    return SceneState(
        ids=scene.ids,
        node_type=torch.from_numpy(rows.node_type).to(device),
        motion=rows.motion,
        encoder=rows.encoder,
        graph=counters,
        modulation=graph.modulation(counters.age, counters.gone, config),
        influence=rows.influence,
        time_s=scene.time_s,
    )


def rows_of(scenes: Sequence[PackedScene], config: ModelConfig, device: torch.device) -> SceneRows:
    """The agents of scenes as tensors, read in one go."""
    layout = Layout.of(config)
    nodes = np.frombuffer(b"".join([scene.nodes for scene in scenes]), dtype=layout.node)

    def column(name: str) -> Tensor:
        return torch.from_numpy(np.array(nodes[name])).to(device)

    motion = {
        name: column(name)
        for name in Kinematics._fields
        if name not in ("observations", "heading_known")
    }
    return SceneRows(
        ids=tuple(scene.ids for scene in scenes),
        node_type=nodes["type"].astype(np.int64),
        motion=Kinematics(
            **motion,
            observations=column("observations").long(),
            heading_known=column("heading_known").bool(),
        ),
        encoder=EncoderState(*(column(name) for name in EncoderState._fields)),
        influence=column("influence"),
    )


def without(scene: PackedScene, ids: frozenset[str], config: ModelConfig) -> PackedScene:
    """The scene without some agents, and without their edges: ``SceneState.keep``."""
    if ids.isdisjoint(scene.ids):
        return scene
    layout = Layout.of(config)
    nodes = np.frombuffer(scene.nodes, dtype=layout.node)
    edges = np.frombuffer(scene.edges, dtype=EDGE)
    stays = np.array([name not in ids for name in scene.ids])
    number = np.where(stays, np.cumsum(stays) - 1, -1)
    kept = edges[stays[edges["receiver"]] & stays[edges["sender"]]].copy()
    kept["receiver"], kept["sender"] = number[kept["receiver"]], number[kept["sender"]]
    nodes = nodes[stays].copy()
    counters = Graph(*(kept[name].astype(np.int64) for name in Graph._fields))
    factors = graph.modulation(counters.age, counters.gone, config)
    types = nodes["type"].astype(np.int64)
    nodes["influence"] = graph.influence(counters, factors, types, layout.kinds).numpy()
    names = tuple(name for name in scene.ids if name not in ids)
    return PackedScene(names, nodes.tobytes(), kept.tobytes(), scene.time_s)


def edges_of(scene: PackedScene, config: ModelConfig) -> list[SceneEdge]:
    """The directed edges, present and fading, by receiver."""
    edges = np.frombuffer(scene.edges, dtype=EDGE)
    age, gone = edges["age"].astype(np.int64), edges["gone"].astype(np.int64)
    rows = zip(
        edges["receiver"].tolist(),
        edges["sender"].tolist(),
        age.tolist(),
        gone.tolist(),
        graph.modulation(age, gone, config).tolist(),
        strict=True,
    )
    return [SceneEdge(scene.ids[i], scene.ids[j], a, g, factor) for i, j, a, g, factor in rows]
