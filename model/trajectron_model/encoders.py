"""The recurrent encoders: a node's history, its edges' influence, and (in training) its future.

Each is written as the paper has it: an LSTM with the weights of its type, stepped once a
frame. Every sequence model here is a cell, so that online one frame costs one cell.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from trajectron_model.config import ModelConfig


class EncoderState(NamedTuple):
    """Hidden and cell states of the history and edge encoders."""

    node_h: Tensor  # [N, history_size]
    node_c: Tensor  # [N, history_size]
    edge_h: Tensor  # [N, K, edge_size]
    edge_c: Tensor  # [N, K, edge_size]


def blank_encoder_state(
    nodes: int, config: ModelConfig, device: torch.device | None = None
) -> EncoderState:
    """States of nodes that have not been seen yet: zeros."""
    node = torch.zeros(nodes, config.history_size, device=device)
    edge = torch.zeros(nodes, len(config.types), config.edge_size, device=device)
    return EncoderState(node, node, edge, edge)


class HistoryEncoder(nn.Module):
    """Encodes the history of one type's nodes, and their edges of every type.

    Node history: h_node = LSTM(h_node, x_i). Edge type k: h_ik = LSTM(h_ik, [x_i; sum of
    neighbours' states]) (paper, "Encoding Trajectory History" and "Encoding Dynamic
    Influence from Neighbors"). Without neighbours the edge LSTM still steps, on [x_i; 0].
    """

    def __init__(self, config: ModelConfig, node_features: int, neighbour_features: int) -> None:
        super().__init__()
        self.node = nn.LSTMCell(node_features, config.history_size)
        self.edges = nn.ModuleList(
            nn.LSTMCell(node_features + neighbour_features, config.edge_size) for _ in config.types
        )

    def forward(self, before: EncoderState, node: Tensor, neighbours: Tensor) -> EncoderState:
        """One step.

        Args:
            before: states of these nodes.
            node: [N, F] features.
            neighbours: [N, K, G] sums over neighbours.
        """
        node_h, node_c = self.node(node, (before.node_h, before.node_c))
        stepped = [
            cell(
                torch.cat([node, neighbours[:, k]], dim=-1),
                (before.edge_h[:, k], before.edge_c[:, k]),
            )
            for k, cell in enumerate(self.edges)
        ]
        edge_h = torch.stack([h for h, _ in stepped], dim=1)  # [N, K, edge_size]
        edge_c = torch.stack([c for _, c in stepped], dim=1)
        return EncoderState(node_h, node_c, edge_h, edge_c)


class FutureEncoder(nn.Module):
    """Encodes the true future for the recognition network: bi-directional, training only."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.lstm = nn.LSTM(2, config.future_size, bidirectional=True)
        self.size = 4 * config.future_size

    def forward(self, velocity: Tensor, known: Tensor) -> Tensor:
        """The last hidden and cell states of both directions.

        Args:
            velocity: [H, N, 2] future velocities in the node's frame, over its speed scale.
            known: [H, N] bool, true on a prefix of the steps: tracks end.

        Returns:
            [N, 4 future_size].
        """
        lengths = known.sum(dim=0).clamp_min(1)
        packed = nn.utils.rnn.pack_padded_sequence(velocity, lengths.cpu(), enforce_sorted=False)
        _, (h, c) = self.lstm(packed)
        return torch.cat([h[0], h[1], c[0], c[1]], dim=-1)
