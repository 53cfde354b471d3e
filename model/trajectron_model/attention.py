"""Additive attention over edge types (Bahdanau et al. 2015; paper, equation of s_ik)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trajectron_model.config import ModelConfig


class EdgeAttention(nn.Module):
    """Merges a node's edge encodings; the node's own encoding is the query."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.keys = nn.Linear(config.edge_size, config.attention_size, bias=False)  # W_1
        self.query = nn.Linear(config.history_size, config.attention_size, bias=False)  # W_2
        self.score = nn.Linear(config.attention_size, 1, bias=False)  # v

    def forward(self, edges: Tensor, node: Tensor) -> tuple[Tensor, Tensor]:
        """Total edge influence and the weights that made it.

        Args:
            edges: [N, K, edge_size] modulated edge encodings.
            node: [N, history_size] node encodings.

        Returns:
            influence [N, edge_size] and weights [N, K], which sum to one.
        """
        hidden = torch.tanh(self.keys(edges) + self.query(node).unsqueeze(1))
        weights = torch.softmax(self.score(hidden).squeeze(-1), dim=-1)  # [N, K]
        return (weights.unsqueeze(-1) * edges).sum(dim=1), weights
