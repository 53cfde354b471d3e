"""The decoder: an LSTM that emits, step by step, a Gaussian mixture over the next velocity.

It is fed [previous velocity; z; h_enc] (paper, "Generating Distributions of Trajectories").
z is one of few values and h_enc does not change over the horizon, so their part of the
gates is computed once for each agent and latent value and kept out of the loop; only the
previous velocity and the hidden state are multiplied at every step.

Velocities here are in the node's frame, in units of its type's speed scale. The mixture
is over the change of velocity, added to the previous velocity: the same family, and a
sensible start.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from trajectron_model.config import ModelConfig
from trajectron_model.gmm import BivariateMixture, choose, correlated
from trajectron_model.integration import limit_speed
from trajectron_model.kernels import decoding
from trajectron_model.kernels.dense import linear
from trajectron_model.teacher_forcing import Bounds, hidden_states, mixture_log_prob

_CORRELATION_BOUND = 0.98
_SCALE_SHIFT = 1.0
# Rows decoded at a time without gradients: the gates of a block stay in the processor's cache,
# and memory is bounded however many rollouts are asked for.
_BLOCK_ROWS = 1024


class Prepared(NamedTuple):
    """The part of h_enc in every rollout of an agent, and what all of them begin with."""

    gates: Tensor  # [N, 4 decoder_size]
    state: Tensor  # [N, 2 decoder_size]
    velocity: Tensor  # [N, 2] the last causal velocity, y_0


class Start(NamedTuple):
    """What a rollout begins with, a row each; the first three are sums over h_enc and z parts."""

    gates: Tensor  # [R, 4 decoder_size]
    hidden: Tensor  # [R, decoder_size]
    cell: Tensor  # [R, decoder_size]
    velocity: Tensor  # [R, 2]


class Decoder(nn.Module):
    """LSTM 128 to a mixture of 16 bivariate Gaussians over velocity, autoregressive."""

    def __init__(self, config: ModelConfig, encoding_size: int) -> None:
        super().__init__()
        size, components = config.decoder_size, config.mixture_components
        self.size = size
        self.components = components
        self.recurrent = nn.Linear(2 + size, 4 * size, bias=False)  # [y_{t-1}; h] -> gates
        self.gates_encoding = nn.Linear(encoding_size, 4 * size)
        self.gates_latent = nn.Embedding(config.latent_values, 4 * size)
        self.start_encoding = nn.Linear(encoding_size, 2 * size)
        self.start_latent = nn.Embedding(config.latent_values, 2 * size)
        # Per component: weight logit, mean x, y, log scale x, y, correlation.
        self.head = nn.Linear(size, 6 * components)
        self.log_sigma_min = math.log(config.sigma_min_mps)
        self.log_sigma_max = math.log(config.sigma_max_mps)
        self._initialise()

    def _initialise(self) -> None:
        nn.init.normal_(self.gates_latent.weight, std=0.3)
        nn.init.normal_(self.start_latent.weight, std=0.3)
        # LSTM practice: remember at first (Jozefowicz et al. 2015).
        with torch.no_grad():
            self.gates_encoding.bias[self.size : 2 * self.size].fill_(1.0)

    def prepare(self, encoding: Tensor, velocity: Tensor) -> Prepared:
        """What rollouts of N agents share, from h_enc [N, D] and last velocities [N, 2]."""
        gates = linear(self.gates_encoding, encoding)
        return Prepared(gates, linear(self.start_encoding, encoding), velocity)

    def start(self, prepared: Prepared, agent: Tensor, latent: Tensor) -> Start:
        """The beginning of R rollouts: of agent [R] (a row of ``prepared``) under z [R].

        h_0 and c_0 are linear in [z; h_enc], h_0 squashed as an LSTM's output is.
        """
        gates = prepared.gates[agent] + self.gates_latent(latent)
        state = prepared.state[agent] + self.start_latent(latent)
        hidden, cell = state.split(self.size, dim=-1)
        return Start(gates, torch.tanh(hidden), cell, prepared.velocity[agent])

    def every_latent(self, nodes: int) -> tuple[Tensor, Tensor]:
        """Agents and latent values of all N Z rollouts, agent by agent: two tensors [N Z]."""
        values, device = self.gates_latent.num_embeddings, self.head.weight.device
        agent = torch.arange(nodes, device=device).repeat_interleave(values)
        return agent, torch.arange(values, device=device).repeat(nodes)

    def cell(self, start: Start, velocity: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """One LSTM step after velocity [R, 2]; gates in the order input, forget, output, new."""
        gates = torch.addmm(start.gates, torch.cat([velocity, h], dim=-1), self.recurrent.weight.T)
        open_, new = gates.split([3 * self.size, self.size], dim=-1)
        i, f, o = torch.sigmoid(open_).chunk(3, dim=-1)
        c = torch.addcmul(f * c, i, torch.tanh(new))
        return o * torch.tanh(c), c

    def mixture(self, h: Tensor, velocity: Tensor) -> BivariateMixture:
        """The mixture over the next velocity, from hidden states [..., size]."""
        raw = self.head(h)
        logits, raw = raw.split([self.components, 5 * self.components], dim=-1)
        raw = raw.unflatten(-1, (self.components, 5))  # [..., M, 5]
        mean, scale, rho = self.components_of(raw)
        weights = torch.log_softmax(logits, dim=-1)
        return BivariateMixture(weights, velocity.unsqueeze(-2) + mean, scale, rho)

    def components_of(self, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean change, scale and correlation of components from raw outputs [..., 5]."""
        span = self.log_sigma_max - self.log_sigma_min
        scale = torch.exp(self.log_sigma_min + span * torch.sigmoid(raw[..., 2:4] - _SCALE_SHIFT))
        return raw[..., :2], scale, _CORRELATION_BOUND * torch.tanh(raw[..., 4])

    def log_prob(self, start: Start, future: Tensor) -> Tensor:
        """Log density of each step of a future under teacher forcing: [R, H] nats.

        Args:
            start: R rollouts.
            future: [R, H, 2] velocities; the density is the unclipped one.
        """
        previous = torch.cat([start.velocity.unsqueeze(1), future[:, :-1]], dim=1)
        weight = self.recurrent.weight
        hidden = hidden_states(start.gates, start.hidden, start.cell, previous, weight)
        # By field instead of by component, as `mixture` has them.
        change = self.head.weight.shape[0] - self.components
        fields = torch.arange(change).reshape(self.components, 5).T.reshape(-1) + self.components
        order = torch.cat([torch.arange(self.components), fields]).to(hidden.device)
        log_prob = mixture_log_prob(
            hidden.flatten(0, 1),
            self.head.weight[order],
            self.head.bias[order],
            (future - previous).flatten(0, 1),
            Bounds(self.log_sigma_min, self.log_sigma_max, _CORRELATION_BOUND, _SCALE_SHIFT),
        )
        return log_prob.reshape(future.shape[:2])

    def sample(
        self,
        prepared: Prepared,
        agent: Tensor,
        latent: Tensor,
        uniform: Tensor,
        normal: Tensor,
        limit: float,
        horizons: Tensor | None = None,
    ) -> Tensor:
        """Sampled velocities [R, H, 2].

        Args:
            prepared: N agents.
            agent, latent: [R] of each rollout.
            uniform: [R, H] chooses components.
            normal: [R, H, 2] standard normals.
            limit: on speed, in units of the speed scale; what is fed back is limited too.
            horizons: [N] steps that are wanted of each agent, at most H, by default H: later
                ones may be anything.
        """
        if horizons is None:
            horizons = torch.full_like(prepared.velocity[:, 0], uniform.shape[1]).long()
        done = decoding.sample(self, prepared, agent, latent, uniform, normal, limit, horizons)
        if done is not None:
            return done
        sampled = torch.empty_like(normal)
        for rows in _blocks(len(agent)):
            start = self.start(prepared, agent[rows], latent[rows])
            sampled[rows] = self._sample_block(start, uniform[rows], normal[rows], limit)
        return sampled

    def _sample_block(self, start: Start, uniform: Tensor, normal: Tensor, limit: float) -> Tensor:
        h, c, velocity = start.hidden, start.cell, start.velocity
        rows = torch.arange(uniform.shape[0], device=uniform.device)
        steps = []
        for t in range(uniform.shape[1]):
            h, c = self.cell(start, velocity, h, c)
            raw = self.head(h)
            weights = torch.softmax(raw[:, : self.components], dim=-1)
            index = choose(weights, uniform[:, t])
            chosen = raw[:, self.components :].unflatten(-1, (self.components, 5))[rows, index]
            change, scale, rho = self.components_of(chosen)
            velocity = correlated(velocity + change, scale, rho, normal[:, t])
            velocity = limit_speed(velocity, limit)
            steps.append(velocity)
        return torch.stack(steps, dim=1)

    def moments(
        self, prepared: Prepared, agent: Tensor, latent: Tensor, horizons: Tensor, limit: float
    ) -> tuple[Tensor, Tensor]:
        """Rollouts on the mixture's mean, of agent [R] under latent value [R] each.

        At each step the mixture is merged to one Gaussian and its mean, limited to ``limit``
        (in units of the speed scale), is fed back.

        Args:
            prepared: N agents.
            agent, latent: [R] of each rollout.
            horizons: [N] steps of each agent, H the most of them.
            limit: on speed.

        Returns:
            velocity means [R, H, 2] and the covariances of the changes of velocity [R, H, 3];
            behind an agent's own steps they may be anything finite.
        """
        done = decoding.moments(self, prepared, agent, latent, horizons, limit)
        if done is not None:
            return done
        horizon = int(horizons.max()) if horizons.numel() else 0
        means = prepared.velocity.new_empty(len(agent), horizon, 2)
        covariances = prepared.velocity.new_empty(len(agent), horizon, 3)
        for rows in _blocks(len(agent)):
            start = self.start(prepared, agent[rows], latent[rows])
            h, c, velocity = start.hidden, start.cell, start.velocity
            for t in range(horizon):
                h, c = self.cell(start, velocity, h, c)
                mean, covariances[rows, t] = self.mixture(h, velocity).moments()
                velocity = limit_speed(mean, limit)
                means[rows, t] = velocity
        return means, covariances


def _blocks(rows: int) -> Iterator[slice]:
    """Runs of rows that are decoded together."""
    for first in range(0, rows, _BLOCK_ROWS):
        yield slice(first, first + _BLOCK_ROWS)
