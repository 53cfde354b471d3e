"""The discrete latent z: its prior p(z|x), its recognition q(z|x,y), their divergence.

With 25 values nothing needs to be sampled or relaxed: expectations are exact sums.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trajectron_model.config import ModelConfig


class DiscreteLatent(nn.Module):
    """p(z|x) and q(z|x,y) over the values of z, as log probabilities (paper, theta and phi)."""

    def __init__(self, config: ModelConfig, encoding_size: int, future_size: int) -> None:
        super().__init__()
        hidden, values = config.latent_hidden_size, config.latent_values
        self.prior_net = nn.Sequential(
            nn.Linear(encoding_size, hidden), nn.ReLU(), nn.Linear(hidden, values)
        )
        self.recognition_net = nn.Sequential(
            nn.Linear(encoding_size + future_size, hidden), nn.ReLU(), nn.Linear(hidden, values)
        )

    def prior(self, encoding: Tensor) -> Tensor:
        """log p(z|x): [N, Z] from h_enc [N, D]."""
        return torch.log_softmax(self.prior_net(encoding), dim=-1)

    def recognition(self, encoding: Tensor, future: Tensor) -> Tensor:
        """log q(z|x,y): [N, Z] from h_enc [N, D] and the future's encoding."""
        logits = self.recognition_net(torch.cat([encoding, future], dim=-1))
        return torch.log_softmax(logits, dim=-1)


def categorical_kl(log_q: Tensor, log_p: Tensor) -> Tensor:
    """KL(q || p) in nats over the last axis of log probabilities [..., Z]."""
    return (log_q.exp() * (log_q - log_p)).sum(dim=-1)
