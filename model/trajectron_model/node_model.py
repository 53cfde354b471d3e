"""The networks of one node type: every agent of the type shares their weights."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from trajectron_model.attention import EdgeAttention
from trajectron_model.config import ModelConfig
from trajectron_model.decoder import Decoder
from trajectron_model.encoders import EncoderState, FutureEncoder, HistoryEncoder
from trajectron_model.latent import DiscreteLatent


class Likelihood(NamedTuple):
    """What the training objectives are made of, for B agents."""

    log_prob: Tensor  # [B, Z] log p(y|x,z), summed over the known steps
    log_prior: Tensor  # [B, Z] log p(z|x)
    log_recognition: Tensor  # [B, Z] log q(z|x,y)
    steps: Tensor  # [B] known future steps


class NodeModel(nn.Module):
    """Encoders, attention, latent and decoder of one type (paper, figure 2)."""

    def __init__(self, config: ModelConfig, node_features: int, neighbour_features: int) -> None:
        super().__init__()
        self.history = HistoryEncoder(config, node_features, neighbour_features)
        self.attention = EdgeAttention(config)
        self.future = FutureEncoder(config)
        size = config.edge_size + config.history_size
        self.latent = DiscreteLatent(config, size, self.future.size)
        self.decoder = Decoder(config, size)

    def encoding(self, state: EncoderState, influence: Tensor) -> Tensor:
        """h_enc = [h_edges; h_node]: [N, D].

        Args:
            state: of N nodes of this type.
            influence: [N, K] min(sum of M, 1), which scales the edge encodings.
        """
        modulated = state.edge_h * influence.unsqueeze(-1)
        edges, _ = self.attention(modulated, state.node_h)
        return torch.cat([edges, state.node_h], dim=-1)

    def likelihood(
        self, encoding: Tensor, velocity: Tensor, future: Tensor, known: Tensor
    ) -> Likelihood:
        """The exact conditional likelihood of a future under every latent value.

        Args:
            encoding: [B, D].
            velocity: [B, 2] last velocity, in the node's frame over its speed scale, as is
                the next.
            future: [B, H, 2] velocities, fed back as they are; anything where unknown.
            known: [B, H] bool, true on a prefix.
        """
        nodes, horizon = known.shape
        agent, latent = self.decoder.every_latent(nodes)
        start = self.decoder.start(self.decoder.prepare(encoding, velocity), agent, latent)
        values = self.decoder.gates_latent.num_embeddings
        each = self.decoder.log_prob(start, future.repeat_interleave(values, 0))  # [B Z, H]
        each = each.reshape(nodes, values, horizon)
        log_prob = torch.where(known.unsqueeze(1), each, 0.0).sum(dim=-1)  # [B, Z]
        future_encoding = self.future(future.transpose(0, 1), known.transpose(0, 1))
        return Likelihood(
            log_prob,
            self.latent.prior(encoding),
            self.latent.recognition(encoding, future_encoding),
            known.sum(dim=1),
        )
