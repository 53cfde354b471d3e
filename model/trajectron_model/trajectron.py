"""The Trajectron (Ivanovic & Pavone, ICCV 2019): a scene's past to its agents' futures.

    frames -> motion -> graph -> history and edge encoders -> attention -> h_enc
    h_enc -> p(z|x);   [y_{t-1}; z; h_enc] -> decoder -> mixture over velocity -> positions

``step`` folds one frame into a scene's state, ``forecast`` draws futures from a state,
``encode`` is the batched form of folding ``step`` that training uses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from trajectron_model import graph, history
from trajectron_model.config import ModelConfig
from trajectron_model.encoders import EncoderState, blank_encoder_state
from trajectron_model.features import HeadingFeatures, Kinematics, WorldFeatures, advance
from trajectron_model.forecast import ForecastRequest, SceneForecast, forecast_scenes
from trajectron_model.history import History
from trajectron_model.node_model import NodeModel
from trajectron_model.state import SceneFrame, SceneState, admit, blank_state, split, stack


class Encoded(NamedTuple):
    """What is known of some nodes at the end of a history."""

    encoding: Tensor  # [B, D] h_enc
    motion: Kinematics  # of B nodes
    node_type: Tensor  # [B]


class Trajectron(nn.Module):
    """Probabilistic trajectories of many agents from a dynamic spatiotemporal graph.

    Raises:
        ValueError: a configuration that does not hold together.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.features: HeadingFeatures | WorldFeatures = (
            HeadingFeatures(config) if config.features == "heading" else WorldFeatures(config)
        )
        self.nodes = nn.ModuleList(
            NodeModel(config, self.features.node_size, self.features.neighbour_size)
            for _ in config.types
        )
        self._radii = graph.radius_table(config)

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device

    def node_model(self, kind: int) -> NodeModel:
        """The networks of the type with this index."""
        model = self.nodes[kind]
        assert isinstance(model, NodeModel)
        return model

    def initial_state(self) -> SceneState:
        """An empty scene."""
        return blank_state(self.config, self.device)

    @torch.inference_mode()
    def step(self, states: Sequence[SceneState], frames: Sequence[SceneFrame]) -> list[SceneState]:
        """Folds one frame into each scene; scenes never influence each other.

        An agent in the state but not in the frame is carried on. Velocity is displacement
        over the time elapsed since the agent was last seen, so frames need not be exactly
        ``dt_s`` apart.

        Raises:
            ValueError: an agent type that the model does not know, an id twice in a frame, a
                position that is not finite.
        """
        if not states:
            return []
        admitted = [
            admit(state, frame, self.config) for state, frame in zip(states, frames, strict=True)
        ]
        sizes = [len(state.ids) for state in admitted]
        stacked = stack(admitted)
        position, present, time_s = self._align(admitted, frames)
        scene = np.repeat(np.arange(len(sizes)), sizes)
        after = self._step_rows(stacked, position, present, time_s, scene)
        return split(after, sizes, [frame.time_s for frame in frames])

    def _align(
        self, states: Sequence[SceneState], frames: Sequence[SceneFrame]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Frames as rows of the stacked states: position [N, 2], present [N], time [N]."""
        nodes = sum(len(state.ids) for state in states)
        position = np.zeros((nodes, 2))
        present = np.zeros(nodes, dtype=bool)
        time_s = np.zeros(nodes)
        first = 0
        for state, frame in zip(states, frames, strict=True):
            row_of = {agent: row for row, agent in enumerate(state.ids, start=first)}
            rows = [row_of[agent] for agent in frame.ids]
            if len(set(rows)) != len(rows) or not np.isfinite(frame.positions).all():
                raise ValueError("a frame's ids must be distinct and its positions finite")
            position[rows] = frame.positions
            present[rows] = True
            last = first + len(state.ids)
            time_s[first:last] = frame.time_s
            first = last
        return position, present, time_s

    def _step_rows(
        self,
        before: SceneState,
        position: np.ndarray,
        present: np.ndarray,
        time_s: np.ndarray,
        scene: np.ndarray,
    ) -> SceneState:
        config, device = self.config, self.device
        node_type = before.node_type.cpu().numpy()
        receiver, sender = graph.find_edges(position, present, node_type, scene, self._radii)
        after = graph.update(
            before.graph, receiver, sender, node_type.size, len(config.removal_filter)
        )
        observed = torch.from_numpy(present).to(device)
        motion = advance(
            before.motion,
            torch.from_numpy(position).to(device),
            observed,
            torch.from_numpy(time_s).to(device),
            config,
        )
        encoder = self._encode_step(
            before.encoder, motion, before.node_type, receiver, sender, None
        )
        encoder = EncoderState(
            *(
                torch.where(observed.reshape(-1, *[1] * (new.dim() - 1)), new, old)
                for new, old in zip(encoder, before.encoder, strict=True)
            )
        )
        factors = graph.modulation(after.age, after.gone, config)
        return before._replace(
            motion=motion,
            encoder=encoder,
            graph=after,
            modulation=factors,
            influence=graph.influence(after, factors, node_type, len(config.types)).to(device),
        )

    def _encode_step(
        self,
        before: EncoderState,
        motion: Kinematics,
        node_type: Tensor,
        receiver: np.ndarray,
        sender: np.ndarray,
        rows: Tensor | None,
    ) -> EncoderState:
        """One step of the encoders for all nodes, or for ``rows`` only (states are of those)."""
        config, device = self.config, motion.position.device
        to = torch.from_numpy(receiver).to(device)
        of = torch.from_numpy(sender).to(device)
        radius = torch.from_numpy(self._radii).float().to(device)[node_type[to], node_type[of]]
        node = self.features.node(motion, node_type)
        around = self.features.neighbours(motion, node_type, to, of, radius, len(config.types))
        if rows is not None:
            node, around, node_type = node[rows], around[rows], node_type[rows]
        if len(config.types) == 1:
            only: EncoderState = self.node_model(0).history(before, node, around)
            return only
        after = [torch.zeros_like(column) for column in before]
        for kind, index in rows_by_type(node_type):
            part = self.node_model(kind).history(
                history.gather(before, index), node[index], around[index]
            )
            after = [c.index_copy(0, index, p) for c, p in zip(after, part, strict=True)]
        return EncoderState(*after)

    def encode(self, past: History, rows: np.ndarray) -> Encoded:
        """Encodes whole histories for some of their nodes, with gradients.

        Equal to folding ``step`` over the frames ``dt_s`` apart.

        Args:
            past: T steps of N nodes.
            rows: [B] the nodes wanted.
        """
        device = self.device
        edges = history.find_edges(past, self.config)
        motions = history.scan_motion(past, self.config, device)
        influence = history.scan_influence(past, edges, self.config)
        index = torch.from_numpy(rows).to(device)
        node_type = torch.from_numpy(past.node_type).to(device)
        wanted = np.isin(edges.receiver, rows)
        observed = torch.from_numpy(past.present[:, rows]).to(device)
        state = blank_encoder_state(rows.size, self.config, device)
        for t, motion in enumerate(motions):
            now = wanted & edges.mask[t]
            after = self._encode_step(
                state, motion, node_type, edges.receiver[now], edges.sender[now], index
            )
            seen = observed[t]
            state = EncoderState(
                *(
                    torch.where(seen.reshape(-1, *[1] * (new.dim() - 1)), new, old)
                    for new, old in zip(after, state, strict=True)
                )
            )
        last = influence[-1].to(device)[index]
        motion = Kinematics(*(column[index] for column in motions[-1]))
        return Encoded(self.encoding(state, last, node_type[index]), motion, node_type[index])

    def encoding(self, state: EncoderState, influence: Tensor, node_type: Tensor) -> Tensor:
        """h_enc [N, D] of nodes of any types from their encoder states and influence [N, K]."""
        if len(self.config.types) == 1:
            return self.node_model(0).encoding(state, influence)
        size = self.config.edge_size + self.config.history_size
        encoding = state.node_h.new_zeros(node_type.shape[0], size)
        for kind, index in rows_by_type(node_type):
            part = self.node_model(kind).encoding(history.gather(state, index), influence[index])
            encoding = encoding.index_copy(0, index, part)
        return encoding

    @torch.inference_mode()
    def forecast(
        self, states: Sequence[SceneState], requests: Sequence[ForecastRequest]
    ) -> list[SceneForecast]:
        """Futures of each scene from its newest frame, batched over scenes.

        Raises:
            KeyError: an agent asked for that is not in its scene.
            ValueError: numbers of samples or steps out of bounds.
        """
        return forecast_scenes(self, states, requests)


def rows_by_type(node_type: Tensor) -> Iterator[tuple[int, Tensor]]:
    """Each type that occurs, with the rows [n] of its nodes."""
    for kind in torch.unique(node_type).tolist():
        yield kind, torch.nonzero(node_type == kind).squeeze(-1)
