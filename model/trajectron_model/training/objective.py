"""What training minimises, from the exact likelihood under every latent value.

The beta-weighted ELBO (paper, equation 2; Higgins et al. 2017), and the exact marginal
likelihood that it bounds. With a discrete z both are sums, nothing is sampled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from trajectron_model.features import Kinematics
from trajectron_model.latent import categorical_kl
from trajectron_model.likelihood import true_velocity, velocity_likelihood
from trajectron_model.training.examples import Batch
from trajectron_model.trajectron import Trajectron, rows_by_type


@dataclass(frozen=True)
class ObjectiveSettings:
    """Which objective, and how it is weighted.

    Attributes:
        name: ``elbo``: E_q[log p(y|x,z)] - beta KL(q || p). ``marginal``: log sum_z p(z|x)
            p(y|x,z), with the recognition network fitted to the exact posterior beside it.
        beta_start, beta_end: beta at the first step, and after the ramp.
        beta_ramp: share of the training over which beta goes from start to end.
        label_noise_mps: standard deviation of noise on true velocities. Recorded tracks are
            smooth splines: without it the mixture spends itself on exactly equal velocities.
        encoding_dropout: share of h_enc's values that are dropped.
    """

    name: Literal["elbo", "marginal"] = "marginal"
    beta_start: float = 1.0
    beta_end: float = 1.0
    beta_ramp: float = 0.0
    label_noise_mps: float = 0.05
    encoding_dropout: float = 0.1

    def beta(self, progress: float) -> float:
        """beta at a share of the training in [0, 1]."""
        share = 1.0 if self.beta_ramp <= 0.0 else min(progress / self.beta_ramp, 1.0)
        return self.beta_start + (self.beta_end - self.beta_start) * share


class LossTerms(NamedTuple):
    """Means over agents, in nats of a whole future; ``loss`` is what is minimised, per step."""

    loss: Tensor
    nll: Tensor  # exact: -log sum_z p(z|x) p(y|x,z)
    reconstruction: Tensor  # -E_q[log p(y|x,z)]
    kl: Tensor  # KL(q || p)
    prior_entropy: Tensor
    information: Tensor  # entropy of the mean prior less the mean entropy: how much x says of z


def loss_terms(
    model: Trajectron,
    batch: Batch,
    settings: ObjectiveSettings,
    *,
    beta: float,
    random: np.random.Generator,
) -> LossTerms:
    """The loss of a batch, with gradients.

    Args:
        model: in training mode.
        batch: examples.
        settings: the objective.
        beta: weight of the divergence at this step.
        random: of the label noise, and of the frames of agents without a heading.
    """
    targets = _targets(model, batch, settings, random)
    terms = [_terms(model, target, settings.name, beta) for target in targets]
    weights = [len(target.known) / len(batch.rows) for target in targets]
    total = [
        torch.stack([w * value for w, value in zip(weights, column, strict=True)]).sum()
        for column in zip(*terms, strict=True)
    ]
    return LossTerms(*total)


class _Targets(NamedTuple):
    """What the B agents of one type in a batch are trained towards."""

    kind: int
    encoding: Tensor  # [B, D]
    motion: Kinematics  # of the B agents
    axis: Tensor  # [B, 2] the first axis of each agent's frame
    velocity_mps: Tensor  # [B, H, 2] true ones, with label noise
    known: Tensor  # [B, H]


def _targets(
    model: Trajectron, batch: Batch, settings: ObjectiveSettings, random: np.random.Generator
) -> list[_Targets]:
    """The batch encoded, one part for each type in it."""
    device = model.device
    encoded = model.encode(batch.past, batch.rows)
    future = torch.from_numpy(batch.future).to(device)
    velocity = true_velocity(encoded.motion, future, model.config.dt_s)  # [B, H, 2]
    noise = random.normal(0.0, settings.label_noise_mps, velocity.shape).astype(np.float32)
    velocity = velocity + torch.from_numpy(noise).to(device)
    # Without a heading no direction is special: each draws a frame of its own.
    angle = random.uniform(0.0, 2.0 * math.pi, len(batch.rows)).astype(np.float32)
    any_axis = torch.from_numpy(np.stack([np.cos(angle), np.sin(angle)], axis=-1)).to(device)
    axis = model.features.frame(encoded.motion)
    if model.features.isotropic_without_heading:
        axis = torch.where(encoded.motion.heading_known.unsqueeze(-1), axis, any_axis)
    known = torch.from_numpy(batch.known).to(device)
    encoding = encoded.encoding
    if settings.encoding_dropout and model.training:
        kept = random.random(encoding.shape, dtype=np.float32) >= settings.encoding_dropout
        encoding = encoding * torch.from_numpy(kept).to(device) / (1.0 - settings.encoding_dropout)
    return [
        _Targets(
            kind,
            encoding[index],
            Kinematics(*(column[index] for column in encoded.motion)),
            axis[index],
            velocity[index],
            known[index],
        )
        for kind, index in rows_by_type(encoded.node_type)
    ]


def _terms(model: Trajectron, target: _Targets, name: str, beta: float) -> LossTerms:
    part = velocity_likelihood(model, *target)
    log_prob, log_prior, log_q = part.log_prob, part.log_prior, part.log_recognition
    nll = -torch.logsumexp(log_prior + log_prob, dim=-1)
    reconstruction = -(log_q.exp() * log_prob).sum(dim=-1)
    kl = categorical_kl(log_q, log_prior)
    posterior = torch.log_softmax(log_prior + log_prob, dim=-1).detach()
    if name == "marginal":
        objective = nll + categorical_kl(posterior, log_q)
    else:
        objective = reconstruction + beta * kl
    # A common scale whatever the horizon: nats a step, all agents weighing the same.
    loss = objective.mean() / part.steps.float().mean()
    entropy = -(log_prior.exp() * log_prior).sum(dim=-1)
    mean_prior = log_prior.exp().mean(dim=0)
    information = -(mean_prior * mean_prior.clamp_min(1e-12).log()).sum() - entropy.mean()
    return LossTerms(
        loss,
        nll.mean().detach(),
        reconstruction.mean().detach(),
        kl.mean().detach(),
        entropy.mean().detach(),
        information.detach(),
    )
