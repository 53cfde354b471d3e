"""Networks that read a scene step by step and foretell each agent's next displacement.

What LSTM, Social LSTM and Social Attention have in common: they are trained to give the next
displacement a high likelihood when fed the true one before it, and foretell by feeding back
their own.

Shape letters: S samples, N agents of all scenes, T steps, H horizon steps.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from trajectron_model.baselines.gaussian import OUTPUTS, BivariateGaussian, from_outputs
from trajectron_model.baselines.network import SceneNetwork
from trajectron_model.baselines.scenes import MEMORY_STEPS, SceneBatch

State = tuple[Tensor, ...]
"""What a network remembers, each tensor [S, rows, D]; the first is the agents' hidden state."""


class SteppingNetwork(SceneNetwork):
    """A recurrent network over the agents of scenes.

    Links are whatever says who sees whom; they stay the same for a whole window.

    Args:
        hidden: size of the agents' hidden states.
    """

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.hidden_size = hidden
        self.head = nn.Linear(hidden, OUTPUTS)

    @abstractmethod
    def links(self, batch: SceneBatch) -> tuple[Tensor, ...]:
        """Who sees whom, from the observed steps of a batch."""

    @abstractmethod
    def blank(self, batch: SceneBatch, links: tuple[Tensor, ...]) -> State:
        """The state before the first step, S = 1."""

    @abstractmethod
    def advance(
        self,
        state: State,
        links: tuple[Tensor, ...],
        position: Tensor,
        displacement: Tensor,
        present: Tensor,
    ) -> State:
        """The state after one more step; that of absent agents stays.

        Args:
            state: before it.
            links: of the batch.
            position: [S, N, 2] metres.
            displacement: [S, N, 2] metres, since the step before.
            present: [N] bool.
        """

    def gaussian(self, hidden: Tensor) -> BivariateGaussian:
        """Of the next displacement, [...], from the agents' hidden states [..., D]."""
        return from_outputs(self.head(hidden))

    def log_likelihood(self, batch: SceneBatch) -> Tensor:
        """Log density of every next displacement, the true ones before it given.

        Returns:
            [T - 1, N] nats; 0 where an agent is absent at either step.
        """
        links = self.links(batch)
        state = self.blank(batch, links)
        hidden = []
        for step in range(len(batch.position) - 1):
            state = self._advance_on(batch, step, state, links)
            hidden.append(state[0])
        density = self.gaussian(torch.cat(hidden)).log_prob(batch.displacement[1:])
        return torch.where(batch.present[:-1] & batch.present[1:], density, 0.0)

    def draw_noise(
        self, random: np.random.Generator, agents: int, samples: int, horizon: int
    ) -> NDArray[np.float32]:
        """[S, N, H, 2]: of each agent's every step."""
        return random.standard_normal((samples, agents, horizon, 2), dtype=np.float32)

    def sample(self, batch: SceneBatch, horizon: int, noise: Tensor) -> Tensor:
        """See `SceneNetwork`; sampled displacements are fed back."""
        return self._roll_out(batch, horizon, noise)

    def point_forecast(self, batch: SceneBatch, horizon: int) -> Tensor:
        """See `SceneNetwork`; the Gaussians' means are fed back."""
        return self._roll_out(batch, horizon, None)[0]

    def _roll_out(self, batch: SceneBatch, horizon: int, normal: Tensor | None) -> Tensor:
        """[S, N, H, 2] offsets; without normal numbers S = 1, by means."""
        links = self.links(batch)
        state = self.blank(batch, links)
        for step in range(MEMORY_STEPS):
            state = self._advance_on(batch, step, state, links)
        samples = 1 if normal is None else len(normal)
        state = tuple(part.expand(samples, *part.shape[1:]) for part in state)
        present = batch.present[MEMORY_STEPS - 1]
        start = batch.position[MEMORY_STEPS - 1][None]
        offset = torch.zeros(samples, *start.shape[1:])
        offsets = []
        for step in range(horizon):
            gaussian = self.gaussian(state[0])
            stride = gaussian.mean if normal is None else gaussian.sample(normal[:, :, step])
            offset = offset + stride
            offsets.append(offset)
            if step + 1 < horizon:
                state = self.advance(state, links, start + offset, stride, present)
        return torch.stack(offsets, dim=2)

    def _advance_on(
        self, batch: SceneBatch, step: int, state: State, links: tuple[Tensor, ...]
    ) -> State:
        return self.advance(
            state,
            links,
            batch.position[step][None],
            batch.displacement[step][None],
            batch.present[step],
        )


def stepped(
    cell: nn.LSTMCell, inputs: Tensor, hidden: Tensor, memory: Tensor, present: Tensor
) -> tuple[Tensor, Tensor]:
    """An LSTM's step over rows of samples; absent rows keep what they had.

    Args:
        cell: of the LSTM.
        inputs, hidden, memory: [S, rows, ...].
        present: [rows] bool.
    """
    shape = hidden.shape
    new_hidden, new_memory = cell(
        inputs.flatten(0, 1), (hidden.flatten(0, 1), memory.flatten(0, 1))
    )
    here = present[:, None]
    return (
        torch.where(here, new_hidden.view(shape), hidden),
        torch.where(here, new_memory.view(shape), memory),
    )
