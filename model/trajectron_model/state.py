"""The state of a scene: a value that one frame turns into the next.

Rows are the agents in the scene, those missing at the newest frame included: their motion
and encodings are kept, their edges gone, until the caller drops them (``keep``). States
of several scenes stack into one and split again without changing any of them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import safetensors.numpy
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from torch import Tensor

from trajectron_model.config import ModelConfig
from trajectron_model.encoders import EncoderState, blank_encoder_state
from trajectron_model.features import Kinematics, blank_kinematics
from trajectron_model.graph import EMPTY_GRAPH, Graph, influence

_FORMAT = 1


class SceneFrame(NamedTuple):
    """One instant of one scene, checked by the caller: distinct ids, finite positions."""

    time_s: float
    ids: tuple[str, ...]  # A agents
    types: tuple[str, ...]  # A
    positions: NDArray[np.float64]  # [A, 2] metres


class SceneEdge(NamedTuple):
    """A directed edge by the ids of its ends; ages in steps, modulation in [0, 1]."""

    receiver_id: str
    sender_id: str
    age_steps: int
    gone_steps: int
    modulation: float


class SceneState(NamedTuple):
    """Everything the model knows of a scene; immutable by convention."""

    ids: tuple[str, ...]  # N agents
    node_type: Tensor  # [N] int64 index into the model's types
    motion: Kinematics  # of N nodes
    encoder: EncoderState  # of N nodes
    graph: Graph  # E edges over rows
    modulation: NDArray[np.float32]  # [E] the factor M of each edge
    influence: Tensor  # [N, K] min(sum of M over neighbours, 1)
    time_s: float  # of the newest frame; -inf before the first

    @property
    def position(self) -> Tensor:
        """[N, 2] float64, last observed positions in metres."""
        return self.motion.position

    @property
    def last_seen_s(self) -> Tensor:
        """[N] float64, when each agent was last observed."""
        return self.motion.last_seen_s

    @property
    def observations(self) -> Tensor:
        """[N] int64, steps at which each agent was seen since it (re)appeared."""
        return self.motion.observations

    def keep(self, ids: Collection[str]) -> SceneState:
        """This scene without the agents that are not in ``ids``, and without their edges."""
        wanted = set(ids)
        rows = [row for row, agent in enumerate(self.ids) if agent in wanted]
        if len(rows) == len(self.ids):
            return self
        index = torch.tensor(rows, dtype=torch.int64, device=self.node_type.device)
        renumber = np.full(len(self.ids), -1, dtype=np.int64)
        renumber[rows] = np.arange(len(rows))
        receiver, sender = renumber[self.graph.receiver], renumber[self.graph.sender]
        stays = (receiver >= 0) & (sender >= 0)
        graph = Graph(receiver[stays], sender[stays], self.graph.age[stays], self.graph.gone[stays])
        factors, node_type = self.modulation[stays], self.node_type[index]
        kinds = self.influence.shape[1]
        return SceneState(
            ids=tuple(self.ids[row] for row in rows),
            node_type=node_type,
            motion=Kinematics(*(column[index] for column in self.motion)),
            encoder=EncoderState(*(column[index] for column in self.encoder)),
            graph=graph,
            modulation=factors,
            influence=influence(graph, factors, node_type.cpu().numpy(), kinds).to(index.device),
            time_s=self.time_s,
        )

    def edges(self) -> list[SceneEdge]:
        """The directed edges, present and fading, by receiver."""
        columns = zip(*self.graph, self.modulation, strict=True)
        return [
            SceneEdge(self.ids[i], self.ids[j], int(age), int(gone), float(factor))
            for i, j, age, gone, factor in columns
        ]

    def to_bytes(self) -> bytes:
        """A portable copy; ``from_bytes`` gives the state back bit for bit."""
        arrays = {name: tensor.cpu().numpy() for name, tensor in _tensors(self).items()}
        arrays |= {f"graph.{name}": column for name, column in self.graph._asdict().items()}
        arrays["modulation"] = self.modulation
        head = {"format": _FORMAT, "ids": self.ids, "time_s": self.time_s}
        arrays["head"] = np.frombuffer(json.dumps(head).encode(), dtype=np.uint8)
        return safetensors.numpy.save({k: np.ascontiguousarray(v) for k, v in arrays.items()})

    @staticmethod
    def from_bytes(data: bytes) -> SceneState:
        """Reads ``to_bytes``'s result; raises ValueError when it is none."""
        try:
            arrays = safetensors.numpy.load(data)
            head = json.loads(arrays["head"].tobytes())
            if head["format"] != _FORMAT:
                raise ValueError(f"scene state of format {head['format']}, expected {_FORMAT}")
            state = SceneState(
                ids=tuple(map(str, head["ids"])),
                node_type=torch.from_numpy(arrays["node_type"]),
                motion=Kinematics(*(_column(arrays, "motion", n) for n in Kinematics._fields)),
                encoder=EncoderState(
                    *(_column(arrays, "encoder", n) for n in EncoderState._fields)
                ),
                graph=Graph(*(arrays[f"graph.{name}"] for name in Graph._fields)),
                modulation=arrays["modulation"],
                influence=torch.from_numpy(arrays["influence"]),
                time_s=float(head["time_s"]),
            )
        except (SafetensorError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"these bytes are no scene state: {error}") from error
        nodes, edges = len(state.ids), len(state.modulation)
        if any(len(column) != nodes for column in _tensors(state).values()) or any(
            len(column) != edges for column in state.graph
        ):
            raise ValueError("these bytes are no scene state: columns of unequal length")
        return state


def _column(arrays: dict[str, NDArray[np.generic]], group: str, name: str) -> Tensor:
    return torch.from_numpy(arrays[f"{group}.{name}"])


def _tensors(state: SceneState) -> dict[str, Tensor]:
    named = {f"motion.{name}": column for name, column in state.motion._asdict().items()}
    named |= {f"encoder.{name}": column for name, column in state.encoder._asdict().items()}
    return {"node_type": state.node_type, "influence": state.influence, **named}


def blank_state(config: ModelConfig, device: torch.device | None = None) -> SceneState:
    """An empty scene."""
    return SceneState(
        ids=(),
        node_type=torch.zeros(0, dtype=torch.int64, device=device),
        motion=blank_kinematics(0, device),
        encoder=blank_encoder_state(0, config, device),
        graph=EMPTY_GRAPH,
        modulation=np.empty(0, dtype=np.float32),
        influence=torch.zeros(0, len(config.types), device=device),
        time_s=-math.inf,
    )


def admit(state: SceneState, frame: SceneFrame, config: ModelConfig) -> SceneState:
    """The scene with a blank row for each agent of the frame that it does not hold yet.

    An agent that comes back under another type starts anew: nothing of the other type's
    encoding would mean anything. Raises ValueError for a type the model does not know.
    """
    types = [config.type_index(name) for name in frame.types]
    held = dict(zip(state.ids, state.node_type.tolist(), strict=True))
    changed = {i for i, t in zip(frame.ids, types, strict=True) if held.get(i, t) != t}
    if changed:
        state = state.keep([i for i in state.ids if i not in changed])
    new = [(i, t) for i, t in zip(frame.ids, types, strict=True) if i not in held or i in changed]
    if not new:
        return state
    device = state.node_type.device
    added = len(new)
    motion = blank_kinematics(added, device)
    encoder = blank_encoder_state(added, config, device)
    return state._replace(
        ids=state.ids + tuple(i for i, _ in new),
        node_type=torch.cat([state.node_type, torch.tensor([t for _, t in new], device=device)]),
        motion=Kinematics(*map(_append, state.motion, motion)),
        encoder=EncoderState(*map(_append, state.encoder, encoder)),
        influence=_append(state.influence, torch.zeros(added, len(config.types), device=device)),
    )


def _append(rows: Tensor, more: Tensor) -> Tensor:
    return torch.cat([rows, more])


def stack(states: Sequence[SceneState]) -> SceneState:
    """One state whose rows are those of all, scene by scene; ids may repeat between scenes."""
    if len(states) == 1:
        return states[0]
    first_row = np.cumsum([0, *(len(s.ids) for s in states)])[:-1]
    graphs = [
        Graph(s.graph.receiver + row, s.graph.sender + row, s.graph.age, s.graph.gone)
        for s, row in zip(states, first_row, strict=True)
    ]
    return SceneState(
        ids=tuple(agent for s in states for agent in s.ids),
        node_type=torch.cat([s.node_type for s in states]),
        motion=Kinematics(*map(torch.cat, zip(*(s.motion for s in states), strict=True))),
        encoder=EncoderState(*map(torch.cat, zip(*(s.encoder for s in states), strict=True))),
        graph=Graph(*map(np.concatenate, zip(*graphs, strict=True))),
        modulation=np.concatenate([s.modulation for s in states]),
        influence=torch.cat([s.influence for s in states]),
        time_s=max(s.time_s for s in states),
    )


def split(stacked: SceneState, nodes: Sequence[int], times_s: Sequence[float]) -> list[SceneState]:
    """The inverse of ``stack``: scenes of ``nodes`` rows each, with their own times."""
    if len(nodes) == 1:
        return [stacked._replace(time_s=times_s[0])]
    ends = np.cumsum(nodes)
    edge_ends = np.searchsorted(stacked.graph.receiver, ends)
    # Cloned, so that a scene does not keep the memory of all it was stacked with.
    sizes = list(nodes)
    motion = zip(*(column.split(sizes) for column in stacked.motion), strict=True)
    encoder = zip(*(column.split(sizes) for column in stacked.encoder), strict=True)
    types, influence = stacked.node_type.split(sizes), stacked.influence.split(sizes)
    scenes = []
    for scene, (columns, encodings) in enumerate(zip(motion, encoder, strict=True)):
        last = int(ends[scene])
        first = last - nodes[scene]
        rows = slice(int(edge_ends[scene - 1]) if scene else 0, int(edge_ends[scene]))
        graph = Graph(
            stacked.graph.receiver[rows] - first,
            stacked.graph.sender[rows] - first,
            stacked.graph.age[rows].copy(),
            stacked.graph.gone[rows].copy(),
        )
        scenes.append(
            SceneState(
                ids=stacked.ids[first:last],
                node_type=types[scene].clone(),
                motion=Kinematics(*(column.clone() for column in columns)),
                encoder=EncoderState(*(column.clone() for column in encodings)),
                graph=graph,
                modulation=stacked.modulation[rows].copy(),
                influence=influence[scene].clone(),
                time_s=times_s[scene],
            )
        )
    return scenes
