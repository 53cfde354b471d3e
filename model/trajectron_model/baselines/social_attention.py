"""Social Attention: Vemula, Muelling & Oh, "Social attention: Modeling attention in human crowds".

ICRA 2018. A crowd is a spatio-temporal graph (after Jain et al., "Structural-RNN", 2016): each
agent is a node, with a temporal edge to itself a step before and spatial edges from the others.
Every edge has an LSTM (its section III-B1); an agent weighs its spatial edges by dot-product
attention against its temporal one (III-B2), scaled by m / sqrt(d) for m spatial edges; the
node's LSTM reads all of it (III-B3) and gives a bivariate Gaussian over the next step.

Where it differs, and why: nodes read displacements in place of positions, so that forecasts move
with the scene; spatial edges come from the nearest eight others at the newest observed step in
place of everyone (most scenes have fewer; a crowd of 40 would cost 1600 edges for every sample),
with a hidden state of 32 in place of 256, since their number sets the cost; nodes and temporal
edges have 64 in place of 128 and 256.

Shape letters: S samples, N agents, K others that an agent attends to, D hidden sizes.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from trajectron_model.baselines.scenes import MEMORY_STEPS, SceneBatch, pairs_of
from trajectron_model.baselines.stepping import State, SteppingNetwork, stepped


def nearest(batch: SceneBatch, count: int) -> tuple[Tensor, Tensor]:
    """The nearest others of each agent at the newest observed step, both being present.

    Returns:
        [N, K] int64 their rows (0 where there are fewer) and [N, K] bool whether there is one;
        K is at most ``count`` and at least 1.
    """
    pairs = pairs_of(batch.scene)
    position, present = batch.position[MEMORY_STEPS - 1], batch.present[MEMORY_STEPS - 1]
    both = present[pairs.receiver] & present[pairs.sender]
    receiver, sender = pairs.receiver[both], pairs.sender[both]
    distance = torch.linalg.vector_norm(position[sender] - position[receiver], dim=-1)
    order = torch.argsort(distance, stable=True)
    order = order[torch.argsort(receiver[order], stable=True)]
    receiver, sender = receiver[order], sender[order]
    others = torch.bincount(receiver, minlength=len(batch.scene))  # [N]
    rank = torch.arange(len(receiver)) - (torch.cumsum(others, 0) - others)[receiver]
    width = max(1, min(count, int(others.max()) if len(others) else 0))
    row = torch.zeros(len(batch.scene), width, dtype=torch.int64)
    exists = torch.zeros(len(batch.scene), width, dtype=torch.bool)
    kept = rank < width
    row[receiver[kept], rank[kept]] = sender[kept]
    exists[receiver[kept], rank[kept]] = True
    return row, exists


class SocialAttention(SteppingNetwork):
    """See the module.

    Args:
        embedding: size of embedded inputs of nodes and temporal edges.
        hidden: hidden size of nodes and temporal edges.
        edge_embedding, edge_hidden: the same of spatial edges.
        attention: size in which edges are compared.
        others: K at most.
    """

    def __init__(
        self,
        embedding: int = 32,
        hidden: int = 64,
        edge_embedding: int = 16,
        edge_hidden: int = 32,
        attention: int = 32,
        others: int = 8,
    ) -> None:
        super().__init__(hidden)
        self.edge_size, self.others = edge_hidden, others
        self.embed_spatial = nn.Sequential(nn.Linear(2, edge_embedding), nn.ReLU())
        self.embed_temporal = nn.Sequential(nn.Linear(2, embedding), nn.ReLU())
        self.embed_node = nn.Sequential(nn.Linear(2, embedding), nn.ReLU())
        self.embed_edges = nn.Sequential(nn.Linear(hidden + edge_hidden, embedding), nn.ReLU())
        self.spatial_cell = nn.LSTMCell(edge_embedding, edge_hidden)
        self.temporal_cell = nn.LSTMCell(embedding, hidden)
        self.node_cell = nn.LSTMCell(2 * embedding, hidden)
        self.query = nn.Linear(hidden, attention, bias=False)
        self.key = nn.Linear(edge_hidden, attention, bias=False)

    def links(self, batch: SceneBatch) -> tuple[Tensor, ...]:
        """Rows of the nearest others [N, K], and whether there is one."""
        return nearest(batch, self.others)

    def blank(self, batch: SceneBatch, links: tuple[Tensor, ...]) -> State:
        """Hidden states and memories of nodes, temporal and spatial edges, zero."""
        row, _ = links
        zero = torch.zeros(1, len(batch.scene), self.hidden_size)
        edge = torch.zeros(1, row.numel(), self.edge_size)
        return zero, zero, zero, zero, edge, edge

    def advance(
        self,
        state: State,
        links: tuple[Tensor, ...],
        position: Tensor,
        displacement: Tensor,
        present: Tensor,
    ) -> State:
        """See `SteppingNetwork`."""
        node, node_memory, temporal, temporal_memory, spatial, spatial_memory = state
        row, exists = links
        seen = exists & present[:, None] & present[row]  # [N, K]
        offset = position[:, row] - position[:, :, None]  # [S, N, K, 2]
        spatial, spatial_memory = stepped(
            self.spatial_cell,
            self.embed_spatial(offset).flatten(1, 2),
            spatial,
            spatial_memory,
            seen.flatten(),
        )
        temporal, temporal_memory = stepped(
            self.temporal_cell,
            self.embed_temporal(displacement),
            temporal,
            temporal_memory,
            present,
        )
        edges = spatial.view(*offset.shape[:3], self.edge_size)  # [S, N, K, D]
        weight = self.attention(temporal, edges, seen)
        attended = (weight[..., None] * edges).sum(2)  # [S, N, D]
        inputs = [
            self.embed_node(displacement),
            self.embed_edges(torch.cat([temporal, attended], dim=-1)),
        ]
        node, node_memory = stepped(
            self.node_cell, torch.cat(inputs, dim=-1), node, node_memory, present
        )
        return node, node_memory, temporal, temporal_memory, spatial, spatial_memory

    def attention(self, temporal: Tensor, edges: Tensor, seen: Tensor) -> Tensor:
        """How much each agent attends to each other one; section III-B2.

        Args:
            temporal: [S, N, D] of the temporal edges.
            edges: [S, N, K, D'] of the spatial edges.
            seen: [N, K] which of them there are.

        Returns:
            [S, N, K], summing to one over those there are; all zero where there is none.
        """
        key = self.key(edges)
        score = torch.einsum("snd,snkd->snk", self.query(temporal), key)
        score = score * (seen.sum(1)[:, None] / math.sqrt(key.shape[-1]))
        score = score.masked_fill(~seen, -torch.inf)
        score = score.masked_fill(~seen.any(1)[:, None], 0.0)
        return torch.where(seen, score.softmax(dim=-1), 0.0)
