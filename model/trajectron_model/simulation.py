"""A crowd that walks by social forces: scenes for demonstrations, tests and load.

The model of Helbing & Molnár, "Social force model for pedestrian dynamics", Physical
Review E 51, 4282 (1995); equation numbers below are of that paper. Metres and seconds
throughout; forces are per unit of mass, in m/s². One thing is added, because the paper's
forces alone let bodies overlap: a linear contact force between bodies that touch (as
Helbing, Farkas & Vicsek, Nature 407, 487 (2000), equation 2). Attractions (6) are left out.

A crowd is a value: ``advance`` gives the next one. Neighbours come from a k-d tree, so the
cost grows nearly linearly with the number of agents.
"""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from trajectron_model.state import SceneFrame

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

_TINY_M = 1e-9
_SPACING_M = 0.7  # between agents that are set into the scene
_WALL_MARGIN_M = 0.5  # gates end this far from the walls beside them


class Scenario(enum.Enum):
    """The layouts that a crowd can walk in."""

    CORRIDOR = "corridor"
    CROSSING = "crossing"
    SQUARE = "square"


@dataclass(frozen=True)
class Layout:
    """Where agents walk: walls they keep off, gates they come from, pass and go to.

    The scene's middle is the origin. Agents choose evenly among the routes: an entrance,
    L gates in turn, the last of which is the exit.
    """

    walls: Float64  # [W, 2, 2] the ends of each wall, metres
    gates: Float64  # [G, 2, 2] the ends of each gate, metres
    routes: Int64  # [R, 1 + L] indices of gates


@dataclass(frozen=True)
class SocialForce:
    """The parameters; defaults are the paper's (its section III) unless noted."""

    desired_speed_mps: float = 1.34
    desired_speed_std_mps: float = 0.26
    max_speed_ratio: float = 1.3  # of the desired speed
    relaxation_s: float = 0.5  # tau
    repulsion_m2ps2: float = 2.1  # V0
    repulsion_range_m: float = 0.3  # sigma
    border_m2ps2: float = 10.0  # U0
    border_range_m: float = 0.2  # R
    # Delta t in (4), the time ahead for which a walker claims room. The paper has 2 s; with it
    # walkers zigzag, since the force on those within a stride flips from side to side: a mean turn
    # of 13 degrees in 0.4 s in the corridor, where recordings of real crowds show 2 to 7.
    stride_s: float = 0.5
    sight_cosine: float = math.cos(math.radians(100.0))
    unseen_weight: float = 0.5  # c
    fluctuation_mps: float = 0.03  # ours: spread of the velocity that (10)'s noise causes
    body_m: float = 0.4  # ours: contact distance of two bodies
    contact_ps2: float = 120.0  # ours: contact force per metre of overlap
    cutoff_m: float = 5.0  # ours: at the mean speed repulsion is below 0.001 m/s² there


class Crowd(NamedTuple):
    """Everyone in the scene at one instant; A agents."""

    ids: Int64  # [A] ascending, never used twice
    position: Float64  # [A, 2] metres
    velocity: Float64  # [A, 2] m/s
    desired_speed: Float64  # [A] m/s
    route: Int64  # [A] row of ``Layout.routes``
    leg: Int64  # [A] gates passed on it, the entrance included: 1 .. L


def corridor(num_agents: int) -> Layout:
    """A corridor five times as long as wide, walked in both directions; 0.3 agents/m²."""
    width = max(math.sqrt(num_agents / (0.3 * 5.0)), 3.0)
    x, y = 2.5 * width, width / 2
    walls = [[(-x, -y), (x, -y)], [(-x, y), (x, y)]]
    inner = y - _WALL_MARGIN_M
    gates = [[(-x, -inner), (-x, inner)], [(x, -inner), (x, inner)]]
    return Layout(np.array(walls), np.array(gates), np.array([(0, 1), (1, 0)]))


def crossing(num_agents: int) -> Layout:
    """Two corridors that cross at right angles, each walked in both directions; 0.2 agents/m²."""
    width = max(math.sqrt(num_agents / (0.2 * 9.0)), 3.0)
    far, near = 2.5 * width, width / 2
    corners = [
        [[(sx * near, sy * near), end] for end in ((sx * far, sy * near), (sx * near, sy * far))]
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    inner = near - _WALL_MARGIN_M
    gates = [[(s * far, -inner), (s * far, inner)] for s in (-1, 1)]
    gates += [[(-inner, s * far), (inner, s * far)] for s in (-1, 1)]
    # Whoever is pushed into the other corridor finds back through the mouth of the right one.
    gates += [[(s * near, -inner), (s * near, inner)] for s in (-1, 1)]
    gates += [[(-inner, s * near), (inner, s * near)] for s in (-1, 1)]
    walls = np.array(corners).reshape(-1, 2, 2)  # [4, 2, 2, 2] -> [W, 2, 2]
    routes = [(0, 5, 1), (1, 4, 0), (2, 7, 3), (3, 6, 2)]
    return Layout(walls, np.array(gates), np.array(routes))


def square(num_agents: int) -> Layout:
    """An open square: from any part of a side to any part of another; 0.1 agents/m²."""
    half = max(math.sqrt(num_agents / 0.1), 10.0) / 2
    cuts = np.linspace(-half, half, 6)
    sides = [
        ((s * half, a), (s * half, b)) if upright else ((a, s * half), (b, s * half))
        for upright in (True, False)
        for s in (-1, 1)
        for a, b in itertools.pairwise(cuts)
    ]
    side = np.arange(len(sides)) // (len(cuts) - 1)
    return Layout(np.empty((0, 2, 2)), np.array(sides), np.argwhere(side[:, None] != side[None, :]))


LAYOUTS = {Scenario.CORRIDOR: corridor, Scenario.CROSSING: crossing, Scenario.SQUARE: square}


def nearest_on_segment(point: Float64, segment: Float64) -> Float64:
    """The point of each segment ``[..., 2, 2]`` nearest to each point ``[..., 2]``, broadcast."""
    start, along = segment[..., 0, :], segment[..., 1, :] - segment[..., 0, :]
    squared = np.maximum((along**2).sum(-1), _TINY_M)
    share = np.clip(((point - start) * along).sum(-1) / squared, 0.0, 1.0)
    return np.asarray(start + share[..., None] * along)


def goal_offset(crowd: Crowd, layout: Layout) -> Float64:
    """From each agent to the nearest point of the gate it walks to; ``[A, 2]`` metres."""
    gate = layout.gates[layout.routes[crowd.route, crowd.leg]]  # [A, 2, 2]
    return nearest_on_segment(crowd.position, gate) - crowd.position


def acceleration(crowd: Crowd, layout: Layout, force: SocialForce) -> Float64:
    """Equation (9), without fluctuations: the total motivation ``[A, 2]`` in m/s²."""
    direction = _unit(goal_offset(crowd, layout))  # equation (1)
    wanted = crowd.desired_speed[:, None] * direction
    drive = (wanted - crowd.velocity) / force.relaxation_s  # equation (2)
    return drive + _borders(crowd.position, layout.walls, force) + _others(crowd, direction, force)


def _unit(vector: Float64) -> Float64:
    length = np.sqrt((vector**2).sum(-1, keepdims=True))
    return np.asarray(vector / np.maximum(length, _TINY_M))


def _borders(position: Float64, walls: Float64, force: SocialForce) -> Float64:
    """Equation (5) with the potential of (13), summed over the walls; ``[A, 2]``."""
    away = position[:, None] - nearest_on_segment(position[:, None], walls[None])  # [A, W, 2]
    distance = np.sqrt((away**2).sum(-1, keepdims=True))
    strength = force.border_m2ps2 / force.border_range_m * np.exp(-distance / force.border_range_m)
    return np.asarray((strength * away / np.maximum(distance, _TINY_M)).sum(1))


def _others(crowd: Crowd, direction: Float64, force: SocialForce) -> Float64:
    """Equations (3), (4), (7), (8): repulsion by the others within the cutoff; ``[A, 2]``."""
    count = len(crowd.ids)
    if count < 2:
        return np.zeros((count, 2))
    pairs = cKDTree(crowd.position).query_pairs(force.cutoff_m, output_type="ndarray")
    on = np.concatenate([pairs[:, 0], pairs[:, 1]])  # [P] whom the force acts on: alpha
    by = np.concatenate([pairs[:, 1], pairs[:, 0]])  # [P] who exerts it: beta
    apart = crowd.position[on] - crowd.position[by]  # [P, 2]
    social = _repulsion(apart, crowd.velocity[by] * force.stride_s, force)
    ahead = -(direction[on] * social).sum(-1)  # against the force is where beta stands
    seen = ahead >= np.sqrt((social**2).sum(-1)) * force.sight_cosine
    total = np.where(seen, 1.0, force.unseen_weight)[:, None] * social + _contact(apart, force)
    return np.stack([np.bincount(on, total[:, axis], count) for axis in (0, 1)], axis=1)


def _repulsion(apart: Float64, stride: Float64, force: SocialForce) -> Float64:
    """Equation (3): minus the gradient of V(b), b being the ellipse's semi-minor axis (4).

    The ellipse has its foci at the other walker and at the end of that one's stride. On the line
    between them b is zero and its gradient unbounded: the force is held to what a circle
    (no stride) gives at most, V0 / sigma.

    Args:
        apart: ``[P, 2]`` from the walker who repels to the one repelled.
        stride: ``[P, 2]`` the way that the walker who repels claims ahead.
        force: the parameters.
    """
    near = np.sqrt((apart**2).sum(-1, keepdims=True))
    far = np.sqrt(((apart - stride) ** 2).sum(-1, keepdims=True))
    squared = (near + far) ** 2 - (stride**2).sum(-1, keepdims=True)
    b = np.sqrt(np.maximum(squared, _TINY_M)) / 2
    gradient = (near + far) / (4 * b) * (_unit(apart) + _unit(apart - stride))
    most = force.repulsion_m2ps2 / force.repulsion_range_m
    result = most * np.exp(-b / force.repulsion_range_m) * gradient
    length = np.sqrt((result**2).sum(-1, keepdims=True))
    return np.asarray(result * np.minimum(1.0, most / np.maximum(length, _TINY_M)))


def _contact(apart: Float64, force: SocialForce) -> Float64:
    """Pushes bodies that overlap apart; ``[P, 2]``."""
    distance = np.sqrt((apart**2).sum(-1, keepdims=True))
    overlap = np.maximum(force.body_m - distance, 0.0)
    return np.asarray(force.contact_ps2 * overlap * _unit(apart))


def advance(
    crowd: Crowd, layout: Layout, force: SocialForce, dt_s: float, rng: np.random.Generator
) -> Crowd:
    """One integration step of equations (10) to (12); nobody appears or leaves.

    The noise makes each velocity an Ornstein-Uhlenbeck process whose spread is
    ``force.fluctuation_mps``, whatever the step.
    """
    noise = force.fluctuation_mps * math.sqrt(2.0 * dt_s / force.relaxation_s)
    pushed = crowd.velocity + dt_s * acceleration(crowd, layout, force)
    pushed = pushed + noise * rng.standard_normal(pushed.shape)
    speed = np.sqrt((pushed**2).sum(-1, keepdims=True))
    limit = force.max_speed_ratio * crowd.desired_speed[:, None]
    velocity = pushed * np.minimum(1.0, limit / np.maximum(speed, _TINY_M))
    return crowd._replace(position=crowd.position + dt_s * velocity, velocity=velocity)


def _pass_gates(crowd: Crowd, layout: Layout, reach_m: float) -> Crowd:
    """Those within ``reach_m`` of their gate walk to the next; past the last they leave."""
    there = (goal_offset(crowd, layout) ** 2).sum(-1) <= reach_m**2
    crowd = crowd._replace(leg=crowd.leg + there)
    staying = crowd.leg < layout.routes.shape[1]
    return Crowd(*(array[staying] for array in crowd))


def _at_entrances(
    ids: Int64, layout: Layout, force: SocialForce, rng: np.random.Generator
) -> Crowd:
    """Agents of these ids, each somewhere on its entrance, with no regard to anybody else."""
    count = len(ids)
    route = rng.integers(len(layout.routes), size=count)
    entrance = layout.gates[layout.routes[route, 0]]  # [C, 2, 2]
    position = entrance[:, 0] + rng.random((count, 1)) * (entrance[:, 1] - entrance[:, 0])
    spread = force.desired_speed_std_mps
    speed = rng.normal(force.desired_speed_mps, spread, count)
    speed = np.maximum(speed, force.desired_speed_mps - 3 * spread)
    leg = np.ones(count, dtype=np.int64)
    fresh = Crowd(ids, position, np.zeros((count, 2)), speed, route, leg)
    return fresh._replace(velocity=speed[:, None] * _unit(goal_offset(fresh, layout)))


def _scatter(
    num_agents: int, layout: Layout, force: SocialForce, rng: np.random.Generator
) -> Crowd:
    """A first crowd of at most ``num_agents``, spread over the whole of their routes."""
    crowd = _empty()
    for _ in range(50):  # rounds in which those without room try another place
        missing = np.arange(len(crowd.ids), num_agents)
        fresh = _at_entrances(missing, layout, force, rng)
        crowd = _join(crowd, _spread(fresh, layout, rng))
    return crowd._replace(ids=np.arange(len(crowd.ids)))


def _spread(crowd: Crowd, layout: Layout, rng: np.random.Generator) -> Crowd:
    """Moves each agent from its entrance along its route, by any share of it."""
    legs, lengths, corners = layout.routes.shape[1] - 1, [], [crowd.position]
    for leg in range(1, legs + 1):
        way = goal_offset(
            crowd._replace(position=corners[-1], leg=np.full_like(crowd.leg, leg)), layout
        )
        corners.append(corners[-1] + way)
        lengths.append(np.sqrt((way**2).sum(-1)))
    ends = np.cumsum(lengths, axis=0)  # [L, A]
    walked = rng.random(len(crowd.ids)) * ends[-1]
    leg = 1 + (walked >= ends[:-1]).sum(0)
    agent = np.arange(len(crowd.ids))
    left = (ends[leg - 1, agent] - walked)[:, None]
    end = np.stack(corners)[leg, agent]  # [L + 1, A, 2] -> [A, 2]
    start = np.stack(corners)[leg - 1, agent]
    heading = _unit(end - start)
    return crowd._replace(
        position=end - left * heading, velocity=crowd.desired_speed[:, None] * heading, leg=leg
    )


def _join(crowd: Crowd, fresh: Crowd) -> Crowd:
    """The crowd with those of the fresh ones for whom there is room."""
    chosen = _with_room(fresh.position, crowd.position)
    return Crowd(*(np.concatenate((a, b[chosen])) for a, b in zip(crowd, fresh, strict=True)))


def _with_room(candidates: Float64, present: Float64) -> Int64:
    """Indices of the candidates that stand clear of those present and of each other."""
    free = np.ones(len(candidates), dtype=np.bool_)
    if len(present) and len(candidates):
        free &= cKDTree(present).query(candidates)[0] >= _SPACING_M
    for first, second in sorted(cKDTree(candidates).query_pairs(_SPACING_M)):
        if free[first]:
            free[second] = False
    return np.flatnonzero(free)


def _empty() -> Crowd:
    nobody, nowhere = np.empty(0, dtype=np.int64), np.empty((0, 2))
    return Crowd(nobody, nowhere, nowhere, np.empty(0), nobody, nobody)


def crowds(
    scenario: Scenario,
    num_agents: int,
    *,
    seed: int,
    dt_s: float = 0.4,
    substeps: int = 10,
    force: SocialForce | None = None,
) -> Iterator[Crowd]:
    """The crowd every ``dt_s`` seconds, without end.

    Whoever reaches the exit leaves; somebody else appears at an entrance within about a
    second, where there is room, so that the number stays near ``num_agents`` and never above.
    The area grows with the number: the density is the scenario's.

    Args:
        scenario: the layout.
        num_agents: how many walk at once; at least 1.
        seed: the same seed gives the same crowd, to the last bit on one machine.
        dt_s: between crowds.
        substeps: integration steps in each ``dt_s``; one should not exceed 0.05 s.
        force: the parameters; ``SocialForce()`` by default.

    Raises:
        ValueError: when ``num_agents`` or ``substeps`` is below 1 or ``dt_s`` is not positive.
    """
    if num_agents < 1 or substeps < 1:
        raise ValueError(f"num_agents {num_agents} and substeps {substeps} must be at least 1")
    if not 0 < dt_s < math.inf:
        raise ValueError(f"dt_s is {dt_s}; it must be positive seconds")
    return _walk(LAYOUTS[scenario](num_agents), num_agents, seed, dt_s, substeps, force)


def _walk(
    layout: Layout,
    num_agents: int,
    seed: int,
    dt_s: float,
    substeps: int,
    force: SocialForce | None,
) -> Iterator[Crowd]:
    """``crowds`` without its checks, which a generator would put off to the first frame."""
    force = force or SocialForce()
    rng = np.random.default_rng(seed)
    crowd = _scatter(num_agents, layout, force, rng)
    next_id = len(crowd.ids)
    while True:
        yield crowd
        for _ in range(substeps):
            crowd = advance(crowd, layout, force, dt_s / substeps, rng)
            crowd = _pass_gates(crowd, layout, reach_m=0.3)
        coming = rng.binomial(num_agents - len(crowd.ids), 1.0 - math.exp(-dt_s))
        fresh = _at_entrances(np.arange(next_id, next_id + coming), layout, force, rng)
        crowd = _join(crowd, fresh)
        next_id += coming


def simulate(
    scenario: Scenario,
    num_agents: int,
    *,
    seed: int,
    dt_s: float = 0.4,
    agent_type: str = "pedestrian",
    force: SocialForce | None = None,
) -> Iterator[SceneFrame]:
    """The crowd as frames at 0, ``dt_s``, 2 ``dt_s``, ... seconds, without end.

    The integration step is at most 0.04 s. Arguments and errors are those of ``crowds``.
    """
    substeps = max(math.ceil(dt_s / 0.04 - 1e-9), 1) if 0 < dt_s < math.inf else 1
    walking = crowds(scenario, num_agents, seed=seed, dt_s=dt_s, substeps=substeps, force=force)
    return (_frame(index * dt_s, crowd, agent_type) for index, crowd in enumerate(walking))


def _frame(time_s: float, crowd: Crowd, agent_type: str) -> SceneFrame:
    ids = tuple(str(number) for number in crowd.ids)
    return SceneFrame(time_s, ids, (agent_type,) * len(ids), crowd.position)
