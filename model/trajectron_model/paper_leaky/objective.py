"""The evidence lower bound as the original trained it: relaxed samples, next to no KL term."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from trajectron_model.latent import categorical_kl
from trajectron_model.paper_leaky.chunks import VELOCITY
from trajectron_model.paper_leaky.inputs import Inputs
from trajectron_model.paper_leaky.network import LeakyNetwork

HORIZON = 12
MIN_NOW = 7
"""The first step of a chunk at which a training example may stand: eight steps of history."""

RELAXED_SAMPLES = 3
NOISE_SD = 0.05
_LOG_PROB_BOUND = 50.0
_FREE_NATS = 0.07
_BETA_CENTRE = 8000.0


class Terms(NamedTuple):
    """The loss of a batch and its parts, nats; a mean over nodes."""

    loss: Tensor
    log_prob: Tensor
    kl: Tensor


def beta(step: int) -> float:
    """Weight of the KL term: 0.0025 at step 0, 0.011 at step 2000."""
    return 1.0 / (1.0 + math.exp(-(step - _BETA_CENTRE) / (_BETA_CENTRE / 6.0)))


def temperature(step: int) -> float:
    """Of the relaxed samples of z: 2 at step 0, 1.64 at step 2000."""
    return float(0.001 + 1.999 * 0.9999**step)


def loss_terms(
    network: LeakyNetwork,
    inputs: Inputs,
    chunk: Tensor,
    now: Tensor,
    step: int,
    generator: torch.Generator,
) -> Terms:
    """The negative ELBO of the people present at one step of each chunk of a batch.

    The original also averages over empty slots, which cost most of its time; they are left out
    (docs/paper-leaky.md says what that seems to change). A person who leaves within the
    horizon keeps, as there, the absent steps' constant (0 - mean) / std as target.

    Args:
        chunk: [B] chunks, repeats allowed.
        now: [B] the present step in each, shared by its slots.
        step: of the training, for the schedules.
    """
    row, slot = inputs.present[chunk, now].nonzero(as_tuple=True)  # [N]
    longest = int(now.max()) + 1
    nodes, lengths = torch.arange(len(row)), now[row] + 1
    history = inputs.states[chunk[row], : longest + HORIZON, slot]  # [N, T + H, F]
    history = history + NOISE_SD * torch.randn(history.shape, generator=generator)
    sums = inputs.sums[chunk[row], :longest, slot]  # [N, T, F]
    # As many independent noises as neighbours are summed.
    noise_sd = NOISE_SD * inputs.degree[slot].sqrt()[:, None, None]
    sums = sums + noise_sd * torch.randn(sums.shape, generator=generator)
    mask = inputs.mask[chunk[row], now[row], slot]
    encoding = network.encode(history[:, :longest], sums, lengths, mask)
    ahead = lengths.unsqueeze(1) + torch.arange(HORIZON)  # [N, H]
    future = history[nodes.unsqueeze(1), ahead][..., VELOCITY]  # [N, H, 2]
    present = history[nodes, now[row]]  # [N, F]
    log_q = network.recognition(encoding, present, future)
    log_p = network.prior(encoding)
    latent = _relaxed(log_q, temperature(step), generator)  # [k, N, 10]
    previous = torch.cat([present[:, None, VELOCITY], future[:, :-1]], dim=1)
    count = len(latent)
    mixture = network.decode(
        encoding.repeat(count, 1), latent.flatten(0, 1), previous.repeat(count, 1, 1)
    )
    per_step = mixture.log_prob(future.repeat(count, 1, 1)).clamp_max(_LOG_PROB_BOUND)
    log_prob = per_step.sum(dim=-1).mean()
    kl = categorical_kl(log_q, log_p).mean(dim=0).clamp_min(_FREE_NATS).sum()
    return Terms(beta(step) * kl - log_prob, log_prob.detach(), kl.detach())


def _relaxed(log_q: Tensor, heat: float, generator: torch.Generator) -> Tensor:
    """Relaxed one-hot samples [k, N, 10] of both categoricals (Gumbel-softmax)."""
    uniform = torch.rand(RELAXED_SAMPLES, *log_q.shape, generator=generator)
    gumbel = -(-uniform.clamp(1e-9, 1.0 - 1e-7).log()).log()
    return torch.softmax((log_q + gumbel) / heat, dim=-1).flatten(2)
