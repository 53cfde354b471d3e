"""How Social GAN is trained: an adversary, and the best of k samples (the variety loss).

Gupta et al. (CVPR 2018), sections 3.4 and 4; constants are those of the public code unless
noted.

Shape letters: S samples (k of the variety loss), A judged agents, H horizon steps.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from trajectron_model.baselines.scenes import MEMORY_STEPS, SceneBatch
from trajectron_model.baselines.sgan import Generator, mlp

VARIETY = 20


class Discriminator(nn.Module):
    """Scores whole trajectories: an LSTM over their displacements, then an MLP."""

    def __init__(self, embedding: int = 16, hidden: int = 64) -> None:
        super().__init__()
        self.embed = nn.Linear(2, embedding)
        self.encoder = nn.LSTM(embedding, hidden)
        self.score = nn.Sequential(mlp(hidden, hidden, hidden), nn.Linear(hidden, 1))

    def forward(self, displacement: Tensor) -> Tensor:
        """Logits of being real; [T, A, 2] metres a step to [A]."""
        _, (hidden, _) = self.encoder(self.embed(displacement))
        score: Tensor = self.score(hidden[-1]).squeeze(-1)
        return score


def variety_loss(offsets: Tensor, truth: Tensor, scene: Tensor) -> Tensor:
    """Squared error of the best sample, chosen jointly for the agents of each scene.

    Args:
        offsets: [S, A, H, 2] metres.
        truth: [A, H, 2] metres.
        scene: [A] int64, each agent's scene.

    Returns:
        mean over agents and steps, m^2.
    """
    squared = (offsets - truth).square().sum((-1, -2))  # [S, A]
    scenes = int(scene.max()) + 1
    total = squared.new_zeros(len(squared), scenes).index_add(1, scene, squared)
    return total.min(dim=0).values.sum() / truth[..., 0].numel()


class SganUpdate:
    """One step of the discriminator, then one of the generator.

    The public code takes two of the discriminator; one is cheaper and served as well.

    Args:
        generator: is trained in place.
        seed: of its noise.
    """

    def __init__(self, generator: Generator, seed: int) -> None:
        self.generator = generator
        self.discriminator = Discriminator()
        self._random = torch.Generator().manual_seed(seed)
        self._generator_steps = torch.optim.Adam(generator.parameters())
        self._discriminator_steps = torch.optim.Adam(self.discriminator.parameters())

    def __call__(self, batch: SceneBatch, learning_rate: float) -> float:
        """Takes both steps; gives the generator's loss."""
        horizon = len(batch.position) - MEMORY_STEPS
        noise = self._noise(batch)
        offsets = self.generator.sample(batch, horizon, noise)[:, batch.judged]
        past = batch.displacement[:MEMORY_STEPS, batch.judged]  # [T, A, 2]
        real = batch.displacement[:, batch.judged]
        strides = torch.diff(offsets[0], dim=1, prepend=torch.zeros_like(offsets[0, :, :1]))
        fake = torch.cat([past, strides.transpose(0, 1)])  # [T + H, A, 2]
        self._improve_discriminator(real, fake.detach(), learning_rate)
        truth = real[MEMORY_STEPS:].cumsum(0).transpose(0, 1)  # [A, H, 2]
        loss = variety_loss(offsets, truth, batch.scene[batch.judged])
        loss = loss + self._against(self.discriminator(fake), 0.7, 1.2)
        _descend(self._generator_steps, loss, self.generator, learning_rate)
        return float(loss.detach())

    def _improve_discriminator(self, real: Tensor, fake: Tensor, learning_rate: float) -> None:
        loss = self._against(self.discriminator(real), 0.7, 1.2)
        loss = loss + self._against(self.discriminator(fake), 0.0, 0.3)
        _descend(self._discriminator_steps, loss, self.discriminator, learning_rate)

    def _against(self, logits: Tensor, low: float, high: float) -> Tensor:
        """Cross entropy with labels drawn once from an interval, which smooths them."""
        label = low + (high - low) * torch.rand((), generator=self._random)
        return F.binary_cross_entropy_with_logits(logits, label.expand_as(logits))

    def _noise(self, batch: SceneBatch) -> Tensor:
        """[S, N, noise], one vector for each scene and sample."""
        scenes = int(batch.scene.max()) + 1
        size = (VARIETY, scenes, self.generator.noise_size)
        return torch.randn(size, generator=self._random)[:, batch.scene]


def _descend(
    steps: torch.optim.Optimizer, loss: Tensor, network: nn.Module, learning_rate: float
) -> None:
    for group in steps.param_groups:
        group["lr"] = learning_rate
    steps.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), 2.0)
    steps.step()
