"""What the encoders see: causal motion of each node, and of its neighbours relative to it.

Velocity is displacement over the time elapsed since the node was last seen, so it uses
positions up to now and nothing later. With ``heading`` features every vector is expressed
in the node's own frame, whose first axis is the direction of a running mean of its
velocity: a shift or a rotation of the scene changes none of them. A node that has not yet
moved has no heading: it sees no directions at all (its vectors are zero, its counts and
distances stay) and its forecast is made isotropic.

With ``world`` features the inputs are the paper's: position, velocity and acceleration,
standardised, and their sums over neighbours.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from trajectron_model.config import ModelConfig

HEADING_NODE_FEATURES = 8
HEADING_NEIGHBOUR_FEATURES = 10
WORLD_FEATURES = 6


class Kinematics(NamedTuple):
    """The causal motion of each node; a blank node has zero observations."""

    position: Tensor  # [N, 2] float64, metres, last observed
    last_seen_s: Tensor  # [N] float64
    observations: Tensor  # [N] int64, steps seen since it (re)appeared
    velocity: Tensor  # [N, 2] m/s; 0 while unknown
    acceleration: Tensor  # [N, 2] m/s^2; 0 while unknown
    smoothed: Tensor  # [N, 2] m/s, running mean of the velocity
    heading: Tensor  # [N, 2] unit vector; (1, 0) while unknown
    turn: Tensor  # [N, 2] the newest heading in the frame of the one before; (1, 0) at rest
    heading_known: Tensor  # [N] bool


def blank_kinematics(nodes: int, device: torch.device | None = None) -> Kinematics:
    """Nodes that have not been seen yet."""
    vector = torch.zeros(nodes, 2, device=device)
    axis = torch.tensor([1.0, 0.0], device=device).repeat(nodes, 1)
    return Kinematics(
        position=torch.zeros(nodes, 2, dtype=torch.float64, device=device),
        last_seen_s=torch.zeros(nodes, dtype=torch.float64, device=device),
        observations=torch.zeros(nodes, dtype=torch.int64, device=device),
        velocity=vector,
        acceleration=vector,
        smoothed=vector,
        heading=axis,
        turn=axis,
        heading_known=torch.zeros(nodes, dtype=torch.bool, device=device),
    )


def to_frame(vector: Tensor, heading: Tensor) -> Tensor:
    """World vectors [..., 2] in the frame whose first axis is ``heading`` [..., 2]."""
    c, s = heading[..., 0], heading[..., 1]
    x, y = vector[..., 0], vector[..., 1]
    return torch.stack([c * x + s * y, c * y - s * x], dim=-1)


def from_frame(vector: Tensor, heading: Tensor) -> Tensor:
    """The inverse of ``to_frame``."""
    c, s = heading[..., 0], heading[..., 1]
    x, y = vector[..., 0], vector[..., 1]
    return torch.stack([c * x - s * y, s * x + c * y], dim=-1)


def advance(
    before: Kinematics, position: Tensor, present: Tensor, time_s: Tensor, config: ModelConfig
) -> Kinematics:
    """The motion of each node after one more frame; absent nodes stay as they were.

    Args:
        before: motion up to the frame before.
        position: [N, 2] float64 metres; anything where absent.
        present: [N] bool.
        time_s: [N] float64, the frame's time.
        config: gives ``dt_s`` and the heading's smoothing.
    """
    seen = before.observations
    again = seen >= 1
    elapsed = torch.where(again, time_s - before.last_seen_s, config.dt_s).clamp_min(1e-3)
    elapsed = elapsed.float().unsqueeze(-1)  # [N, 1]
    velocity = (position - before.position).float() / elapsed
    velocity = torch.where(again.unsqueeze(-1), velocity, 0.0)
    third = (seen >= 2).unsqueeze(-1)
    acceleration = torch.where(third, (velocity - before.velocity) / elapsed, 0.0)
    weight = config.heading_smoothing
    mean = weight * velocity + (1.0 - weight) * before.smoothed
    smoothed = torch.where(third, mean, velocity)
    speed = torch.linalg.vector_norm(smoothed, dim=-1, keepdim=True)
    moves = speed > config.heading_min_speed_mps
    heading = torch.where(moves, smoothed / speed.clamp_min(1e-9), before.heading)
    turned = to_frame(heading, before.heading)
    turn = torch.where(before.heading_known.unsqueeze(-1), turned, before.turn)
    after = Kinematics(
        position=position,
        last_seen_s=time_s,
        observations=seen + 1,
        velocity=velocity,
        acceleration=acceleration,
        smoothed=smoothed,
        heading=heading,
        turn=turn,
        heading_known=before.heading_known | moves.squeeze(-1),
    )
    return Kinematics(*(_where(present, a, b) for a, b in zip(after, before, strict=True)))


def _where(rows: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(rows if new.dim() == 1 else rows.unsqueeze(-1), new, old)


class HeadingFeatures(nn.Module):
    """Features in each node's own heading frame: the default."""

    node_size = HEADING_NODE_FEATURES
    neighbour_size = HEADING_NEIGHBOUR_FEATURES
    isotropic_without_heading = True

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        scale = torch.tensor([t.speed_scale_mps for t in config.types])
        self.register_buffer("speed_scale", scale, persistent=False)
        self.speed_scale: Tensor
        self.dt_s = config.dt_s

    def node(self, motion: Kinematics, node_type: Tensor) -> Tensor:
        """[N, F]: velocity, velocity change a step, turn (cos - 1, sin), what is known."""
        known = motion.heading_known.unsqueeze(-1)
        scale = self.speed_scale[node_type].unsqueeze(-1)
        velocity = to_frame(motion.velocity, motion.heading) / scale
        change = to_frame(motion.acceleration, motion.heading) * (self.dt_s / scale)
        turn = motion.turn - motion.turn.new_tensor([1.0, 0.0])
        vectors = torch.where(known, torch.cat([velocity, change, turn], dim=-1), 0.0)
        flags = torch.stack([motion.observations >= 2, motion.heading_known], dim=-1)
        return torch.cat([vectors, flags.to(vectors.dtype)], dim=-1)

    def neighbours(
        self,
        motion: Kinematics,
        node_type: Tensor,
        receiver: Tensor,
        sender: Tensor,
        radius_m: Tensor,
        kinds: int,
    ) -> Tensor:
        """Sums over the present neighbours of each edge type, relative to the node.

        Args:
            motion: of all nodes.
            node_type: [N].
            receiver, sender: [E] rows of present edges.
            radius_m: [E] radius of each edge's pair of types.
            kinds: K.

        Returns:
            [N, K, G]: relative position over the radius, relative velocity, the same two
            weighted by closeness (1 at contact, 0 at the radius), count, sum of closeness.
        """
        offset = (motion.position[sender] - motion.position[receiver]).float()
        distance = torch.linalg.vector_norm(offset, dim=-1)
        closeness = (1.0 - distance / radius_m).clamp_min(0.0)
        moving = (motion.observations >= 2)[sender] & (motion.observations >= 2)[receiver]
        drift = motion.velocity[sender] - motion.velocity[receiver]
        drift = torch.where(moving.unsqueeze(-1), drift, 0.0)
        drift = drift / self.speed_scale[node_type[receiver]].unsqueeze(-1)
        heading = motion.heading[receiver]
        seen = torch.cat(
            [to_frame(offset, heading) / radius_m.unsqueeze(-1), to_frame(drift, heading)], dim=-1
        )  # [E, 4]
        seen = torch.where(motion.heading_known[receiver].unsqueeze(-1), seen, 0.0)
        weight = closeness.unsqueeze(-1)
        each = torch.cat([seen, seen * weight, torch.ones_like(weight), weight], dim=-1)  # [E, G]
        return sum_by_type(each, receiver, node_type[sender], node_type.shape[0], kinds)

    def frame(self, motion: Kinematics) -> Tensor:
        """[N, 2] the first axis of the frame that forecasts are made in."""
        return motion.heading


class WorldFeatures(nn.Module):
    """The paper's inputs: x = [X; dX/dt; d2X/dt2] in the world, standardised on training data.

    Neither shift-invariant nor rotation-equivariant: the preset ``paper``.
    """

    node_size = WORLD_FEATURES
    neighbour_size = WORLD_FEATURES
    isotropic_without_heading = False

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        kinds = len(config.types)
        self.register_buffer("mean", torch.zeros(kinds, WORLD_FEATURES, dtype=torch.float64))
        self.register_buffer("std", torch.ones(kinds, WORLD_FEATURES, dtype=torch.float64))
        self.mean: Tensor
        self.std: Tensor

    def node(self, motion: Kinematics, node_type: Tensor) -> Tensor:
        """[N, F]: position, velocity, acceleration, each standardised."""
        state = torch.cat(
            [motion.position, motion.velocity.double(), motion.acceleration.double()], dim=-1
        )
        return ((state - self.mean[node_type]) / self.std[node_type]).float()

    def neighbours(
        self,
        motion: Kinematics,
        node_type: Tensor,
        receiver: Tensor,
        sender: Tensor,
        radius_m: Tensor,
        kinds: int,
    ) -> Tensor:
        """[N, K, G]: the sum of neighbours' standardised states (paper, equation of e_ik)."""
        del radius_m
        each = self.node(motion, node_type)[sender]
        return sum_by_type(each, receiver, node_type[sender], node_type.shape[0], kinds)

    def frame(self, motion: Kinematics) -> Tensor:
        """[N, 2] the world's first axis for everyone."""
        return motion.heading.new_tensor([1.0, 0.0]).expand(motion.heading.shape[0], 2)


def sum_by_type(each: Tensor, receiver: Tensor, kind: Tensor, nodes: int, kinds: int) -> Tensor:
    """Sums edge rows [E, G] over (receiver, sender's type) into [N, K, G]."""
    total = each.new_zeros(nodes * kinds, each.shape[-1])
    total.index_add_(0, receiver * kinds + kind, each)
    return total.reshape(nodes, kinds, each.shape[-1])  # [N, K, G]
