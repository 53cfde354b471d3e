"""Social GAN: Gupta et al., "Social GAN: Socially acceptable trajectories with GANs" (CVPR 2018).

The variant SGAN-20VP-20: with pooling, trained with the variety loss of k = 20. The generator is
an LSTM encoder, the pooling of section 3.3 (an MLP over each pair's relative position and the
other's hidden state, then a maximum) once after the observed steps, and an LSTM decoder
initialised from both and from noise that a whole scene shares (equation 3 and following; noise
of 8 numbers, as the public code has it). The discriminator (`sgan_training`) is an LSTM over
whole trajectories.

Sizes are those of the public code (embedding 16, hidden states 32, pooled 32, noise 8), but for
the pooling MLP's hidden layer: 64 in place of 512, since it is paid for every pair. The point
forecast is the mean of the samples drawn.

Shape letters: S samples, N agents, E ordered pairs, T observed steps, H horizon steps.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from trajectron_model.baselines.network import SceneNetwork
from trajectron_model.baselines.scenes import MEMORY_STEPS, Pairs, SceneBatch, pairs_of
from trajectron_model.baselines.stepping import stepped


class Generator(SceneNetwork):
    """Trajectories of all agents of a scene from one noise vector.

    Args:
        embedding: size of embedded displacements and relative positions.
        hidden: of encoder and decoder.
        pooling_hidden, pooled: sizes of the pooling MLP.
        context_hidden: of the MLP that makes the decoder's first state.
        noise: size of z.
    """

    def __init__(
        self,
        embedding: int = 16,
        hidden: int = 32,
        pooling_hidden: int = 64,
        pooled: int = 32,
        context_hidden: int = 64,
        noise: int = 8,
    ) -> None:
        super().__init__()
        self.hidden_size, self.pooled_size, self.noise_size = hidden, pooled, noise
        self.embed = nn.Linear(2, embedding)
        self.encoder = nn.LSTMCell(embedding, hidden)
        self.embed_offset = nn.Linear(2, embedding)
        self.pooling = mlp(embedding + hidden, pooling_hidden, pooled)
        self.start = mlp(hidden + pooled, context_hidden, hidden - noise)
        self.embed_stride = nn.Linear(2, embedding)
        self.decoder = nn.LSTMCell(embedding, hidden)
        self.head = nn.Linear(hidden, 2)

    def draw_noise(
        self, random: np.random.Generator, agents: int, samples: int, horizon: int
    ) -> NDArray[np.float32]:
        """[S, N, noise]: one z for each sample, shared by the scene's agents."""
        del horizon
        z = random.standard_normal((samples, 1, self.noise_size), dtype=np.float32)
        return np.repeat(z, agents, axis=1)

    def point_forecast(self, batch: SceneBatch, horizon: int) -> None:
        """The mean of the samples drawn."""

    def sample(self, batch: SceneBatch, horizon: int, noise: Tensor) -> Tensor:
        """See `SceneNetwork`."""
        encoded = self._encode(batch)  # [1, N, D]
        present = batch.present[MEMORY_STEPS - 1]
        pooled = self.pool(encoded[0], batch.position[MEMORY_STEPS - 1], present, batch.scene)
        start = self.start(torch.cat([encoded[0], pooled], dim=-1))  # [N, D - noise]
        hidden = torch.cat([start.expand(len(noise), *start.shape), noise], dim=-1)  # [S, N, D]
        memory = torch.zeros_like(hidden)
        stride = batch.displacement[MEMORY_STEPS - 1].expand(len(noise), -1, -1)
        strides = []
        for _ in range(horizon):
            inputs = self.embed_stride(stride)
            hidden, memory = stepped(self.decoder, inputs, hidden, memory, present)
            stride = self.head(hidden)
            strides.append(stride)
        return torch.stack(strides, dim=2).cumsum(dim=2)

    def _encode(self, batch: SceneBatch) -> Tensor:
        hidden = memory = torch.zeros(1, len(batch.scene), self.hidden_size)
        for step in range(MEMORY_STEPS):
            inputs = self.embed(batch.displacement[step])[None]
            hidden, memory = stepped(self.encoder, inputs, hidden, memory, batch.present[step])
        return hidden

    def pool(self, encoded: Tensor, position: Tensor, present: Tensor, scene: Tensor) -> Tensor:
        """Section 3.3: the maximum, over all others present and oneself, of what the MLP gives.

        Args:
            encoded: [N, D] hidden states.
            position: [N, 2] metres.
            present: [N] bool.
            scene: [N] int64, ascending.

        Returns:
            [N, pooled].
        """
        others = pairs_of(scene)
        both = present[others.receiver] & present[others.sender]
        oneself = torch.arange(len(scene))
        pairs = Pairs(
            torch.cat([oneself, others.receiver[both]]), torch.cat([oneself, others.sender[both]])
        )
        offset = position[pairs.sender] - position[pairs.receiver]  # [E, 2]
        each = self.pooling(
            torch.cat([self.embed_offset(offset), encoded[pairs.sender]], dim=-1)
        )  # [E, pooled]
        blank = each.new_zeros(len(scene), self.pooled_size)
        receiver = pairs.receiver[:, None].expand_as(each)
        highest: Tensor = blank.scatter_reduce(0, receiver, each, "amax", include_self=False)
        return highest


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two layers, a rectifier after each, as in the public code."""
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs), nn.ReLU()
    )
