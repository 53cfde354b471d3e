"""The original's batch model: encoders, latent, decoder, in its sizes.

Two categoricals of five stand for z (25 combinations). The additive attention over edge
types is left out: there is one type, so it is the identity (820 of 137,448 parameters).

Shape letters: N nodes, T steps, H horizon, S samples, M mixture components.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from trajectron_model.gmm import BivariateMixture, choose, correlated
from trajectron_model.integration import limit_speed
from trajectron_model.paper_leaky.chunks import FEATURES

HISTORY_SIZE, EDGE_SIZE, FUTURE_SIZE, DECODER_SIZE = 32, 8, 32, 128
LATENTS, LATENT_VALUES = 2, 5
LATENT_SIZE = LATENTS * LATENT_VALUES
ENCODING_SIZE = EDGE_SIZE + HISTORY_SIZE
COMPONENTS = 16
SPEED_LIMIT_MPS = 12.4222
_LOG_SIGMA_BOUND = 10.0
# Keeps 1 - rho^2 above float32's rounding where tanh saturates.
_CORRELATION_BOUND = 1.0 - 1e-4
_BLOCK_ROWS = 2048


class Scale(NamedTuple):
    """The statistics that turn standardised velocities into m/s."""

    mean: Tensor  # [N, 2]
    std: Tensor  # [N, 2]


class LeakyNetwork(nn.Module):
    """p(z|x), q(z|x,y) and p(y|x,z) over standardised velocities."""

    def __init__(self) -> None:
        super().__init__()
        self.history = nn.LSTM(FEATURES, HISTORY_SIZE, batch_first=True)
        self.edge = nn.LSTM(2 * FEATURES, EDGE_SIZE, batch_first=True)
        self.future = nn.LSTM(2, FUTURE_SIZE, batch_first=True, bidirectional=True)
        self.future_hidden = nn.Linear(FEATURES, FUTURE_SIZE)
        self.future_cell = nn.Linear(FEATURES, FUTURE_SIZE)
        self.prior_net = nn.Sequential(
            nn.Linear(ENCODING_SIZE, 16), nn.ReLU(), nn.Dropout(0.1), nn.Linear(16, LATENT_SIZE)
        )
        self.recognition_net = nn.Linear(ENCODING_SIZE + 4 * FUTURE_SIZE, LATENT_SIZE)
        self.start_hidden = nn.Linear(LATENT_SIZE + ENCODING_SIZE, DECODER_SIZE)
        self.start_cell = nn.Linear(LATENT_SIZE + ENCODING_SIZE, DECODER_SIZE)
        self.decoder = nn.LSTM(LATENT_SIZE + ENCODING_SIZE + 2, DECODER_SIZE, batch_first=True)
        # Weight logits, means, log deviations, correlations: four linear heads in one.
        self.head = nn.Linear(DECODER_SIZE, 6 * COMPONENTS)
        self.dropout = nn.Dropout(0.25)

    def encode(self, node: Tensor, neighbours: Tensor, lengths: Tensor, mask: Tensor) -> Tensor:
        """h_enc [N, 40] at the end of histories.

        Args:
            node: [N, T, F] standardised states, from the chunk's first step on.
            neighbours: [N, T, F] sums over the neighbours' standardised states.
            lengths: [N] steps of each history.
            mask: [N] the edge mask at each history's last step.
        """
        both = torch.cat([neighbours, node], dim=-1)  # [N, T, 2 F]
        # Padding stands behind a history's end, so what is read there has not seen it.
        rows, last = torch.arange(len(node)), lengths - 1
        history = self.history(node)[0][rows, last]  # [N, 32]
        edge = self.edge(both)[0][rows, last]  # [N, 8]
        influence = self.dropout(edge * mask.unsqueeze(-1))
        return torch.cat([influence, self.dropout(history)], dim=-1)

    def prior(self, encoding: Tensor) -> Tensor:
        """log p(z|x) [N, 2, 5] of both categoricals."""
        return _log_probabilities(self.prior_net(encoding))

    def recognition(self, encoding: Tensor, now: Tensor, future: Tensor) -> Tensor:
        """log q(z|x,y) [N, 2, 5] from h_enc [N, 40], states now [N, F], velocities [N, H, 2]."""
        hidden, cell = self.future_hidden(now), self.future_cell(now)
        start = (
            torch.stack([hidden, torch.zeros_like(hidden)]),
            torch.stack([cell, torch.zeros_like(cell)]),
        )
        _, (hidden, cell) = self.future(future, start)  # [2, N, 32] each
        ends = torch.cat([hidden[0], cell[0], hidden[1], cell[1]], dim=-1)
        return _log_probabilities(
            self.recognition_net(torch.cat([encoding, self.dropout(ends)], dim=-1))
        )

    def decode(self, encoding: Tensor, latent: Tensor, velocity: Tensor) -> BivariateMixture:
        """Mixtures over the next velocity at each step, under teacher forcing.

        Args:
            encoding: [N, 40].
            latent: [N, 10] both (relaxed) one-hot values.
            velocity: [N, H, 2] the previous velocity at each step: now's, then the future's.
        """
        static = torch.cat([latent, encoding], dim=-1)  # [N, 50]
        start = (self.start_hidden(static).unsqueeze(0), self.start_cell(static).unsqueeze(0))
        horizon = velocity.shape[1]
        inputs = torch.cat([static.unsqueeze(1).expand(-1, horizon, -1), velocity], dim=-1)
        hidden, _ = self.decoder(inputs, start)
        return self._mixture(hidden)

    def _mixture(self, hidden: Tensor) -> BivariateMixture:
        logits, raw = self.head(hidden).split([COMPONENTS, 5 * COMPONENTS], dim=-1)
        raw = raw.unflatten(-1, (COMPONENTS, 5))
        scale = raw[..., 2:4].clamp(-_LOG_SIGMA_BOUND, _LOG_SIGMA_BOUND).exp()
        correlation = _CORRELATION_BOUND * torch.tanh(raw[..., 4])
        return BivariateMixture(torch.log_softmax(logits, -1), raw[..., :2], scale, correlation)

    def sample(
        self,
        encoding: Tensor,
        velocity: Tensor,
        scale: Scale,
        *,
        samples: int,
        horizon: int,
        z_best: bool,
        generator: torch.Generator,
    ) -> Tensor:
        """Sampled velocities [N, S, H, 2] in m/s, nodes and samples independent.

        Args:
            encoding: [N, 40].
            velocity: [N, 2] now's, standardised.
            scale: of the nodes.
            z_best: each categorical takes its most probable value; else both are drawn.
        """
        log_prior = self.prior(encoding).repeat_interleave(samples, dim=0)  # [N S, 2, 5]
        if z_best:
            value = log_prior.argmax(dim=-1)
        else:
            value = choose(
                log_prior.exp(), torch.rand(log_prior.shape[:2], generator=generator)
            )  # [N S, 2]
        latent = nn.functional.one_hot(value, LATENT_VALUES).float().flatten(1)  # [N S, 10]
        static = torch.cat([latent, encoding.repeat_interleave(samples, dim=0)], dim=-1)
        uniform = torch.rand(len(static), horizon, generator=generator)
        normal = torch.randn(len(static), horizon, 2, generator=generator)
        start = velocity.repeat_interleave(samples, dim=0)
        blocks = [
            self._rollout(static[rows], start[rows], horizon, _drawn(uniform[rows], normal[rows]))
            for rows in torch.arange(len(static)).split(_BLOCK_ROWS)
        ]
        return _metric(torch.cat(blocks).unflatten(0, (-1, samples)), scale)

    def modes(
        self, encoding: Tensor, velocity: Tensor, scale: Scale, horizon: int
    ) -> tuple[Tensor, Tensor]:
        """The 25 combinations of z: p(z|x) [N, 25] and a rollout of each [N, 25, H, 2] in m/s.

        A rollout feeds back the mean of each step's mixture. Arguments as in `sample`.
        """
        first, second = self.prior(encoding).exp().unbind(dim=1)  # [N, 5] each
        probability = (first.unsqueeze(2) * second.unsqueeze(1)).flatten(1)  # [N, 25]
        one = torch.eye(LATENT_VALUES)
        both = [
            one.repeat_interleave(LATENT_VALUES, dim=0),
            one.repeat(LATENT_VALUES, 1),
        ]
        latent = torch.cat(both, dim=1)  # [25, 10]
        nodes, values = probability.shape
        static = torch.cat(
            [latent.repeat(nodes, 1), encoding.repeat_interleave(values, dim=0)], dim=-1
        )
        start = velocity.repeat_interleave(values, dim=0)
        means = self._rollout(static, start, horizon, lambda mixture, _: mixture.moments()[0])
        return probability, _metric(means.unflatten(0, (nodes, values)), scale)

    def _rollout(self, static: Tensor, velocity: Tensor, horizon: int, pick: _Pick) -> Tensor:
        """Velocities [R, H, 2] from [z; h_enc] [R, 50] and y_0 [R, 2], standardised."""
        inputs, recurrent, *biases = self.decoder.all_weights[0]
        fixed = static.shape[1]
        # What does not change from step to step is multiplied once.
        gates = static @ inputs[:, :fixed].T + biases[0] + biases[1]
        weight = torch.cat([inputs[:, fixed:], recurrent], dim=1).T
        hidden, cell = self.start_hidden(static), self.start_cell(static)
        steps = []
        for t in range(horizon):
            opened = torch.addmm(gates, torch.cat([velocity, hidden], dim=-1), weight)
            i, f, new, o = opened.chunk(4, dim=-1)
            cell = f.sigmoid() * cell + i.sigmoid() * new.tanh()
            hidden = o.sigmoid() * cell.tanh()
            velocity = pick(self._mixture(hidden), t)
            steps.append(velocity)
        return torch.stack(steps, dim=1)


_Pick = Callable[[BivariateMixture, int], Tensor]
"""From the mixtures of R rollouts at a step, the velocities [R, 2] that are fed back."""


def _drawn(uniform: Tensor, normal: Tensor) -> _Pick:
    """Draws with uniforms [R, H] for the component and normals [R, H, 2]."""
    rows = torch.arange(len(uniform))

    def pick(mixture: BivariateMixture, t: int) -> Tensor:
        index = choose(mixture.log_weights.exp(), uniform[:, t])
        mean, scale = mixture.mean[rows, index], mixture.scale[rows, index]
        return correlated(mean, scale, mixture.correlation[rows, index], normal[:, t])

    return pick


def _metric(velocity: Tensor, scale: Scale) -> Tensor:
    """Standardised velocities [N, ., H, 2] in m/s, limited."""
    metric = velocity * scale.std[:, None, None] + scale.mean[:, None, None]
    return limit_speed(metric, SPEED_LIMIT_MPS)


def _log_probabilities(logits: Tensor) -> Tensor:
    """[N, 2, 5] from raw outputs [N, 10]; mean-centred as the original's, which changes nothing."""
    both = logits.unflatten(-1, (LATENTS, LATENT_VALUES))
    return torch.log_softmax(both - both.mean(dim=-1, keepdim=True), dim=-1)


def integrate(velocity: Tensor, dt_s: float) -> Tensor:
    """Offsets [..., H, 2] in metres from the position now, of velocities [..., H, 2] in m/s.

    The original's trapezoid over the NEXT two velocities, the last one standing twice:
    the velocity now is not used.
    """
    after = torch.cat([velocity[..., 1:, :], velocity[..., -1:, :]], dim=-2)
    return (0.5 * dt_s * (velocity + after)).cumsum(dim=-2)
