"""Checks of frames: a bad one is refused whole, and told which field is at fault and why.

Paths are relative to the frame (``agents[3].x``); callers put the place of the frame before.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from trajectron_service.errors import FieldViolation
from trajectron_service.messages import Agent, Frame, UnknownTypes
from trajectron_service.timebase import Observation, Seen, Timeline

MAX_ID_LENGTH = 128
# Round the Earth is 4e7 m: beyond this a coordinate is no metre, and float32 differences overflow.
MAX_COORDINATE_M = 1e8
# Seconds since 1970 are about 2e9; a clock in milliseconds or nanoseconds is beyond this.
MAX_TIME_S = 1e11
# Detections jump by less than this whatever the speed.
POSITION_SLACK_M = 1.0
_SHOWN_LENGTH = 64


@dataclass(frozen=True)
class TypeRules:
    """The model's types with their speed limits in m/s, and what happens to any other type.

    ``radii_m``: see ``ModelFacts``.
    """

    speed_limits_mps: Mapping[str, float]
    radii_m: Mapping[tuple[str, str], float]
    unknown_types: UnknownTypes
    type_map: Mapping[str, str]

    def resolve(self, name: str) -> str | None:
        """The model's type for a client's; None for a type that is unknown."""
        if name in self.speed_limits_mps:
            return name
        if self.unknown_types is UnknownTypes.MAP:
            return self.type_map.get(name)
        return None


@dataclass(frozen=True)
class FrameLimits:
    """How large a frame and a scene may be, and how fast an agent, as a factor on its limit."""

    max_agents_per_frame: int
    max_agents_per_scene: int
    max_edges_per_frame: int
    speed_tolerance: float


@dataclass(frozen=True, eq=False)
class Checked:
    """A frame that may go on, and the agents left out of it for their type."""

    observation: Observation
    ignored: tuple[str, ...]


class _Fault(Exception):
    """A field at fault, on its way up to ``check``."""

    def __init__(self, field: str, description: str) -> None:
        super().__init__(description)
        self.violation = FieldViolation(field, description)


def check(
    frame: Frame, timeline: Timeline, rules: TypeRules, limits: FrameLimits
) -> Checked | FieldViolation:
    """The frame with its types resolved, or the first field at fault.

    Speeds are judged against each agent's last position in ``timeline``: the distance may be
    the type's speed limit times ``speed_tolerance`` times the time elapsed, plus
    ``POSITION_SLACK_M`` for the noise of detection.
    """
    try:
        time_s = _time(frame.time)
        if len(frame.agents) > limits.max_agents_per_frame:
            raise _Fault(
                "agents",
                f"{len(frame.agents)} agents; a frame may have at most "
                f"{limits.max_agents_per_frame}",
            )
        observation, ignored = _observation(time_s, frame.agents, rules)
        _scene_size(observation, timeline, limits)
        _speeds(frame.agents, observation, timeline, rules, limits)
        _edges(observation, rules, limits)
    except _Fault as fault:
        return fault.violation
    return Checked(observation, ignored)


def quoted(text: str) -> str:
    """A client's text for a message: in quotes, escaped, shortened."""
    return json.dumps(text if len(text) <= _SHOWN_LENGTH else text[:_SHOWN_LENGTH] + "...")


def text_fault(text: str, kind: str = "an id") -> str | None:
    """What is wrong with an id, or another name of the ``kind`` said, if anything."""
    if not text:
        return f"is missing; {kind} has 1 to {MAX_ID_LENGTH} characters"
    if len(text) > MAX_ID_LENGTH:
        return f"has {len(text)} characters; {kind} has at most {MAX_ID_LENGTH}"
    try:
        text.encode()
    except UnicodeEncodeError:
        return "is not valid Unicode text"
    return None


def _time(time_s: float | None) -> float:
    if time_s is None:
        raise _Fault("time", "is missing; every frame has a time in seconds")
    if not math.isfinite(time_s):
        raise _Fault("time", f"is {_shown(time_s)}; times must be finite seconds")
    if abs(time_s) > MAX_TIME_S:
        raise _Fault("time", f"is {time_s:g}; times are seconds, not milliseconds or nanoseconds")
    return time_s


def _observation(
    time_s: float, agents: tuple[Agent, ...], rules: TypeRules
) -> tuple[Observation, tuple[str, ...]]:
    """The agents of known types as arrays, and the ids of those ignored."""
    rows: dict[str, int] = {}
    types: list[str] = []
    ids: list[str] = []
    places: list[tuple[float, float]] = []
    ignored: list[str] = []
    for row, agent in enumerate(agents):
        fault = text_fault(agent.id)
        if fault is not None:
            raise _Fault(f"agents[{row}].id", fault)
        if agent.id in rows:
            raise _Fault(
                f"agents[{row}].id",
                f"{quoted(agent.id)} is also agents[{rows[agent.id]}]; ids are unique in a frame",
            )
        rows[agent.id] = row
        place = (_coordinate(agent.x, row, "x"), _coordinate(agent.y, row, "y"))
        if not agent.type:
            raise _Fault(f"agents[{row}].type", f"is missing; this model knows {_known(rules)}")
        kind = rules.resolve(agent.type)
        if kind is not None:
            ids.append(agent.id)
            types.append(kind)
            places.append(place)
        elif rules.unknown_types is UnknownTypes.IGNORE:
            ignored.append(agent.id)
        else:
            raise _Fault(f"agents[{row}].type", _unknown_type(agent.type, rules))
    positions = np.array(places, dtype=np.float64).reshape(-1, 2)  # [A, 2]
    return Observation(time_s, tuple(ids), tuple(types), positions), tuple(ignored)


def _coordinate(value: float | None, row: int, axis: str) -> float:
    if value is None:
        raise _Fault(f"agents[{row}].{axis}", "is missing; positions are finite metres")
    if not math.isfinite(value):
        raise _Fault(
            f"agents[{row}].{axis}", f"is {_shown(value)}; positions must be finite metres"
        )
    if abs(value) > MAX_COORDINATE_M:
        raise _Fault(
            f"agents[{row}].{axis}",
            f"is {value:g}; positions are metres within {MAX_COORDINATE_M:g} of the origin",
        )
    return value


def _shown(value: float) -> str:
    return "NaN" if math.isnan(value) else "infinite"


def _known(rules: TypeRules) -> str:
    return ", ".join(map(quoted, rules.speed_limits_mps))


def _unknown_type(name: str, rules: TypeRules) -> str:
    known = _known(rules)
    if rules.unknown_types is UnknownTypes.MAP:
        return f"{quoted(name)} is not in type_map; this model knows {known}"
    return (
        f"{quoted(name)} is unknown to this model, which knows {known}; "
        "unknown_types can ignore or map others"
    )


def _scene_size(observation: Observation, timeline: Timeline, limits: FrameLimits) -> None:
    known = timeline.seen
    total = len(known) + sum(agent not in known for agent in observation.ids)
    if total > limits.max_agents_per_scene:
        raise _Fault(
            "agents",
            f"with those missing but not timed out the scene would have {total} agents; "
            f"at most {limits.max_agents_per_scene}: keep ids stable from frame to frame",
        )


def _speeds(
    agents: tuple[Agent, ...],
    observation: Observation,
    timeline: Timeline,
    rules: TypeRules,
    limits: FrameLimits,
) -> None:
    """Refuses what no agent of the type can do."""
    for agent, kind, place in zip(
        observation.ids, observation.types, observation.positions.tolist(), strict=True
    ):
        last = timeline.seen.get(agent)
        elapsed_s = observation.time_s - last.time_s if last is not None else 0.0
        if last is None or not 0.0 < elapsed_s <= timeline.grid.agent_timeout_s:
            continue
        if last.type != kind:
            continue
        distance_m = _distance(last, place)
        bound_mps = rules.speed_limits_mps[kind] * limits.speed_tolerance
        if distance_m > bound_mps * elapsed_s + POSITION_SLACK_M:
            row = next(row for row, one in enumerate(agents) if one.id == agent)
            raise _Fault(
                f"agents[{row}]",
                f"{quoted(agent)} moved {distance_m:.1f} m in {elapsed_s:.3g} s, faster than a "
                f"{kind} can ({bound_mps:.1f} m/s); check units, ids and times",
            )


def _edges(observation: Observation, rules: TypeRules, limits: FrameLimits) -> None:
    """Refuses a frame whose graph would be too large: counted by k-d trees, never listed."""
    agents = len(observation.ids)
    if agents * (agents - 1) <= limits.max_edges_per_frame:
        return
    kinds = np.array(observation.types)
    trees = {name: cKDTree(observation.positions[kinds == name]) for name in set(kinds.tolist())}
    edges = -agents  # everybody is near oneself
    for a, of_a in trees.items():
        for b, of_b in trees.items():
            edges += int(of_a.count_neighbors(of_b, rules.radii_m[a, b]))
    if edges > limits.max_edges_per_frame:
        raise _Fault(
            "agents",
            f"{agents} agents so close together make {edges} edges; a frame may have at most "
            f"{limits.max_edges_per_frame}: check units, or send fewer agents",
        )


def _distance(last: Seen, place: list[float]) -> float:
    return math.hypot(place[0] - last.x, place[1] - last.y)
