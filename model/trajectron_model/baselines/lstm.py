"""An LSTM for each agent, the others unseen: the plain LSTM of Alahi et al. (CVPR 2016).

As the paper's section 3.1 without its pooling: a bivariate Gaussian out, the sampled position
fed back in. Where it differs: embedding of 32 and hidden state of 64, half of the paper's;
displacements in place of positions, so that a forecast moves with the scene (as the public code
of Social GAN has it); and the likelihood of every step from an agent's second on is trained, not
of the foretold ones alone, so that short histories are met in training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from trajectron_model.baselines.network import NetworkPredictor, require_dt
from trajectron_model.baselines.scenes import MEMORY_STEPS, SceneBatch, observed_scene, stack
from trajectron_model.baselines.stepping import State, SteppingNetwork, stepped
from trajectron_model.data.windows import Window


class Lstm(SteppingNetwork):
    """Weights are shared by all agents.

    Args:
        embedding: size of an embedded displacement.
        hidden: size of the hidden state.
    """

    context = False

    def __init__(self, embedding: int = 32, hidden: int = 64) -> None:
        super().__init__(hidden)
        self.embed = nn.Sequential(nn.Linear(2, embedding), nn.ReLU())
        self.cell = nn.LSTMCell(embedding, hidden)

    def links(self, batch: SceneBatch) -> tuple[Tensor, ...]:
        """Nobody sees anybody."""
        del batch
        return ()

    def blank(self, batch: SceneBatch, links: tuple[Tensor, ...]) -> State:
        """Hidden state and memory, zero; [1, N, D] each."""
        del links
        zero = torch.zeros(1, len(batch.scene), self.hidden_size)
        return zero, zero

    def advance(
        self,
        state: State,
        links: tuple[Tensor, ...],
        position: Tensor,
        displacement: Tensor,
        present: Tensor,
    ) -> State:
        """See `SteppingNetwork`."""
        del links, position
        hidden, memory = state
        return stepped(self.cell, self.embed(displacement), hidden, memory, present)


class LstmPredictor(NetworkPredictor):
    """The plain LSTM on windows; its trajectories have an exact density.

    Those that pool have one of all agents together only: an agent's next step depends on where
    the others went.
    """

    def __init__(self, network: Lstm, name: str) -> None:
        super().__init__(network, name)
        self._lstm = network

    def log_prob(self, windows: Sequence[Window]) -> list[NDArray[np.float64]]:
        """See `DensityPredictor`; the product of each step's density given those before.

        Raises:
            ValueError: as `predict`.
        """
        require_dt(windows, self.name)
        return [self._log_prob_of(window) for window in windows]

    def _log_prob_of(self, window: Window) -> NDArray[np.float64]:
        scene = observed_scene(window, context=False)
        future = window.future().transpose(1, 0, 2)  # [H, A, 2]
        position = np.concatenate([scene.position, future - scene.origin])
        with torch.no_grad():
            steps = self._lstm.log_likelihood(stack([replace(scene, position=position)]))
        total = steps[MEMORY_STEPS - 1 :].double().sum(0).numpy()  # [A]
        return np.where(np.isnan(future).any((0, 2)), np.nan, total)
