"""The exact likelihood of true futures: what training maximises, and evaluation reports.

A density over velocity in m/s becomes one over position in metres by the Jacobian of
X_t = X_{t-1} + U_t dt: each step's log density less 2 ln(dt).

An agent that has shown no direction has no frame of its own: its forecast is turned by a
uniform angle, so its density is the mean over that angle, taken at evenly spaced ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajectron_model.features import Kinematics, to_frame
from trajectron_model.history import gather
from trajectron_model.modes import start_velocity, without_direction
from trajectron_model.node_model import Likelihood
from trajectron_model.state import SceneState, stack
from trajectron_model.trajectron import Trajectron, rows_by_type

ANGLES = 32
"""Directions that the density of an agent without one is a mean over."""

_ROWS = 256
"""Agents (times angles) whose likelihood is taken at once: about 200 MB under 25 values."""


def true_velocity(motion: Kinematics, future_m: Tensor, dt_s: float) -> Tensor:
    """Velocities [B, H, 2] in m/s that lead from the last positions along a future.

    Args:
        motion: of B agents.
        future_m: [B, H, 2] float64 world positions.
        dt_s: of a step.
    """
    track = torch.cat([motion.position.unsqueeze(1), future_m], dim=1)
    return (track.diff(dim=1) / dt_s).float()


def velocity_likelihood(
    model: Trajectron,
    kind: int,
    encoding: Tensor,
    motion: Kinematics,
    axis: Tensor,
    velocity_mps: Tensor,
    known: Tensor,
) -> Likelihood:
    """The likelihood of velocities under every latent value, as a density over m/s.

    Args:
        model: the model.
        kind: type index of the B agents.
        encoding: [B, D] h_enc.
        motion: of the B agents.
        axis: [B, 2] the first axis of each agent's frame, in the world.
        velocity_mps: [B, H, 2] in the world; anything where unknown.
        known: [B, H] bool, true on a prefix.
    """
    scale = model.config.types[kind].speed_scale_mps
    part = model.node_model(kind).likelihood(
        encoding,
        start_velocity(model, motion, kind),
        to_frame(velocity_mps, axis.unsqueeze(1)) / scale,
        known,
    )
    # Inside, the unit of speed is the type's own.
    jacobian = 2.0 * math.log(scale) * part.steps
    return part._replace(log_prob=part.log_prob - jacobian.unsqueeze(-1))


@torch.inference_mode()
def future_log_prob(
    model: Trajectron,
    states: Sequence[SceneState],
    agents: Sequence[Sequence[str]],
    futures_m: Sequence[NDArray[np.float64]],
    *,
    best_mode_only: bool = False,
) -> list[NDArray[np.float64]]:
    """log p(y|x) of whole futures: log sum_z p(z|x) prod_t p(y_t | y_<t, z, x), nats.

    Args:
        model: the model.
        states: of scenes, at their newest frames.
        agents: of each scene, A ids.
        futures_m: of each scene, [A, H, 2] world positions; NaN where not known.
        best_mode_only: under z = argmax p(z|x) alone.

    Returns:
        for each scene [A], of a density over positions in metres; NaN where a future is not
        complete, and for agents of a type that never moves.

    Raises:
        KeyError: an agent that is not in its scene.
    """
    stacked = stack(states)
    index = torch.tensor(_rows(states, agents), dtype=torch.int64, device=model.device)
    motion = Kinematics(*(column[index] for column in stacked.motion))
    node_type = stacked.node_type[index]
    encoding = model.encoding(gather(stacked.encoder, index), stacked.influence[index], node_type)
    future = torch.from_numpy(np.concatenate(futures_m)).to(model.device)  # [B, H, 2]
    found = np.full(len(index), np.nan)
    whole = ~future.isnan().flatten(1).any(dim=1)
    for kind, of_kind in rows_by_type(node_type):
        if model.config.types[kind].stationary:
            continue
        rows = of_kind[whole[of_kind]]
        for part, axis in _frames(model, motion, rows):
            moving = Kinematics(*(column[part] for column in motion))
            velocity = true_velocity(moving, future[part], model.config.dt_s)
            known = torch.ones(velocity.shape[:2], dtype=torch.bool, device=model.device)
            likelihood = velocity_likelihood(
                model, kind, encoding[part], moving, axis, velocity, known
            )
            each = _marginal(likelihood, best_mode_only).double()  # [agents * angles]
            agent, turns = part.unique_consecutive(return_counts=True)
            angles = int(turns[0])
            mean = torch.logsumexp(each.reshape(-1, angles), dim=1) - math.log(angles)
            found[agent.cpu().numpy()] = mean.cpu().numpy()
    found -= 2.0 * math.log(model.config.dt_s) * future.shape[1]
    return np.split(found, np.cumsum([len(ids) for ids in agents])[:-1])


def _marginal(likelihood: Likelihood, best_mode_only: bool) -> Tensor:
    """[B] over all latent values, or under the most probable one."""
    if not best_mode_only:
        return torch.logsumexp(likelihood.log_prior + likelihood.log_prob, dim=-1)
    best = likelihood.log_prior.argmax(dim=-1, keepdim=True)
    return likelihood.log_prob.gather(-1, best).squeeze(-1)


def _frames(model: Trajectron, motion: Kinematics, rows: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Runs of rows with the first axis of a frame for each; agents without one in all turns.

    Within a run every agent has equally many frames, one after the other.
    """
    axis = model.features.frame(motion)
    turned = without_direction(model, motion)[rows]
    for part in _runs(rows[~turned], _ROWS):
        yield part, axis[part]
    angle = torch.arange(ANGLES, device=rows.device) * (2.0 * math.pi / ANGLES)
    turns = torch.stack([angle.cos(), angle.sin()], dim=-1)  # [ANGLES, 2]
    for part in _runs(rows[turned], _ROWS // ANGLES):
        yield part.repeat_interleave(ANGLES), turns.repeat(len(part), 1)


def _runs(rows: Tensor, most: int) -> Iterator[Tensor]:
    """The rows in order, at most so many at a time."""
    for first in range(0, len(rows), most):
        yield rows[first : first + most]


def _rows(states: Sequence[SceneState], agents: Sequence[Sequence[str]]) -> list[int]:
    """The agents' rows in the stacked states."""
    rows: list[int] = []
    first = 0
    for state, ids in zip(states, agents, strict=True):
        row_of = {agent: row for row, agent in enumerate(state.ids, start=first)}
        rows += [row_of[agent] for agent in ids]
        first += len(state.ids)
    return rows
