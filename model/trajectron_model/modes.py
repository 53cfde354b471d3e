"""The modes of a forecast: one for each latent value, a Gaussian over position at every step.

A latent value's velocity mixture is merged to one Gaussian at each step of a rollout on its
mean, and carried to position space as a random walk in velocity (``integration.walk``). Two
approximations: the identity of mixture components is not followed from step to step, and
increments of velocity are taken as independent of the velocity reached.

Latent values of negligible probability need no rollout: their probability becomes zero and the
others' still sum to one. In the arrays such a mode repeats the most probable one, so that
every sum weighted by probabilities leaves it out and every covariance is positive definite.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from trajectron_model.config import Dispersion
from trajectron_model.dispersion import disperse
from trajectron_model.features import Kinematics, from_frame, to_frame
from trajectron_model.integration import integrate, walk
from trajectron_model.kernels import placing

if TYPE_CHECKING:
    from trajectron_model.trajectron import Trajectron

# A position is never known better than this: keeps covariances positive definite. As placing.c.
_VARIANCE_FLOOR_M2 = 1e-6


def without_negligible(log_prior: Tensor, floor: Tensor) -> Tensor:
    """log p(z|x) [N, Z] without the values whose probability is below the agent's floor [N].

    They become -inf and the others are normalised again; the most probable one always stays.
    Where all stay, nothing changes.
    """
    probability = log_prior.exp()
    most = probability.amax(dim=-1, keepdim=True)
    stays = (probability >= floor.unsqueeze(-1)) | (probability == most)
    kept = torch.where(stays, log_prior, -torch.inf)
    kept = kept - kept.logsumexp(dim=-1, keepdim=True)
    return torch.where(stays.all(dim=-1, keepdim=True), log_prior, kept)


def start_velocity(model: Trajectron, motion: Kinematics, kind: int) -> Tensor:
    """y_0 [N, 2]: the last causal velocity in the node's frame, over the type's speed scale."""
    frame = model.features.frame(motion)
    velocity = to_frame(motion.velocity, frame) / model.config.types[kind].speed_scale_mps
    if not model.features.isotropic_without_heading:
        return velocity
    return torch.where(motion.heading_known.unsqueeze(-1), velocity, 0.0)


def without_direction(model: Trajectron, motion: Kinematics) -> Tensor:
    """[N] whether the agent's forecast has no direction of its own."""
    if model.features.isotropic_without_heading:
        return ~motion.heading_known
    return torch.zeros_like(motion.heading_known)


def mode_moments(
    model: Trajectron,
    kind: int,
    encoding: Tensor,
    log_prior: Tensor,
    motion: Kinematics,
    horizons: Tensor,
) -> tuple[Tensor, Tensor]:
    """Position-space Gaussian of every latent value at every step.

    Args:
        kind: type index of the N nodes.
        encoding: [N, D] h_enc.
        log_prior: [N, Z] log p(z|x); a mode of -inf repeats the most probable one.
        motion: of the N nodes.
        horizons: [N] steps of each node, H the most of them.

    Returns:
        mean [N, Z, H, 2] as offsets in metres and covariance [N, Z, H, 3], world axes; behind
        a node's own steps they mean nothing.
    """
    agent_type, dt_s = model.config.types[kind], model.config.dt_s
    decoder, scale = model.node_model(kind).decoder, agent_type.speed_scale_mps
    prepared = decoder.prepare(encoding, start_velocity(model, motion, kind))
    stays = log_prior > -torch.inf
    agent, latent = stays.nonzero(as_tuple=True)  # [R]
    limit = agent_type.speed_limit_mps / scale
    velocity, increment = decoder.moments(prepared, agent, latent, horizons, limit)
    if agent_type.stationary:
        increment = torch.zeros_like(increment)
    rollouts = Rollouts(
        velocity,
        increment,
        _rows_of(stays, log_prior),
        log_prior.exp(),
        model.features.frame(motion),
        without_direction(model, motion),
    )
    return place(rollouts, dt_s * scale, agent_type.dispersion)


class Rollouts(NamedTuple):
    """R rollouts on the mixture's mean, and whose modes they are."""

    velocity: Tensor  # [R, H, 2] in units of the speed scale, in the agent's frame
    increment: Tensor  # [R, H, 3] covariances of its changes
    row: Tensor  # [N, Z] the rollout of each mode
    probability: Tensor  # [N, Z]
    axis: Tensor  # [N, 2] the first axis of the agent's frame
    turned: Tensor  # [N] whether any direction is as likely as any other


def place(
    rollouts: Rollouts, unit_m: float, dispersion: Sequence[Dispersion]
) -> tuple[Tensor, Tensor]:
    """Modes in position space, world axes.

    Args:
        rollouts: of N nodes.
        unit_m: metres that one unit of velocity makes in a step.
        dispersion: see ``dispersion``.

    Returns:
        mean [N, Z, H, 2] as offsets in metres and covariance [N, Z, H, 3].
    """
    done = placing.place(rollouts, unit_m, dispersion)
    if done is not None:
        return done
    mean = integrate(rollouts.velocity, unit_m)[rollouts.row]  # [N, Z, H, 2]
    covariance = walk(rollouts.increment, unit_m)[rollouts.row]  # [N, Z, H, 3]
    floor = covariance.new_tensor([_VARIANCE_FLOOR_M2, 0.0, _VARIANCE_FLOOR_M2])
    covariance = disperse(covariance + floor, rollouts.probability, dispersion)
    axis = rollouts.axis[:, None, None, :]
    turned = rollouts.turned[:, None, None, None]
    spread = torch.where(turned, _every_direction(mean, covariance), _rotate(covariance, axis))
    return torch.where(turned, 0.0, from_frame(mean, axis)), spread


def _rows_of(stays: Tensor, log_prior: Tensor) -> Tensor:
    """[N, Z] the row of each mode's rollout among those that stay, or of the most probable's."""
    own = stays.flatten().cumsum(0).reshape(stays.shape) - 1
    best = own.gather(1, log_prior.argmax(dim=-1, keepdim=True))
    return torch.where(stays, own, best)


def _every_direction(mean: Tensor, covariance: Tensor) -> Tensor:
    """Covariances [..., 3] of a Gaussian turned by a uniform angle."""
    square = mean.square().sum(-1) + covariance[..., 0] + covariance[..., 2]
    return torch.stack([0.5 * square, torch.zeros_like(square), 0.5 * square], dim=-1)


def _rotate(covariance: Tensor, axis: Tensor) -> Tensor:
    """Covariances [..., 3] from the frame with first axis ``axis`` [..., 2] to the world's."""
    c, s = axis[..., 0], axis[..., 1]
    xx, xy, yy = covariance.unbind(dim=-1)
    cc, cs, ss = c * c, c * s, s * s
    twice = 2.0 * cs * xy
    return torch.stack(
        [cc * xx - twice + ss * yy, cs * (xx - yy) + (cc - ss) * xy, ss * xx + twice + cc * yy],
        dim=-1,
    )
