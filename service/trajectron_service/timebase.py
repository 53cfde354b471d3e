"""Frames of any rate onto a model's time grid: pure book-keeping, values in and out.

A model steps every ``dt``. This module decides, for each frame that comes in, which steps
of the model it causes and from which state of the scene a forecast starts; it never
touches a state itself, it names states by serial number (``Step``, ``Head``).

**Slots.** Time is cut into slots of ``dt / P``: P is ``dt / interval`` where that is a whole
number (within 2%, at most 20), else 1. Each slot gets one step, from the state that was
committed P slots before: so P chains of states are interleaved, the steps within each are
``dt`` apart, and at a declared interval of ``dt / P`` every frame costs one step and every
forecast starts at the newest frame. The last P + 1 states are kept.

- A frame that arrives when a slot is due (within 20% of a slot's width, or half the time
  since the frame before where that is less) *is* that slot: it is stepped as it stands, at
  its own time, and the grid goes on from there, so a client's clock may jitter and drift.
- Slots that passed without a frame are filled by interpolation between the two frames
  around them, for agents present in both. Nothing is ever extrapolated.
- A frame between slots commits no step. A forecast from it makes a provisional step, which
  is not kept, from the committed state whose age is nearest to ``dt`` and at least half of it;
  from an empty scene when there is none (headings are not known then).
- After a silence of more than ``MAX_FILL_STEPS`` steps, or than the agent timeout, nothing is
  filled: the grid starts again at the new frame, from the states as they were. Work per
  frame is thus bounded.

**Agents.** One that is missing is carried on until it has been unseen for longer than
``agent_timeout``; then it is dropped. Back within it, its velocity is displacement over the
time elapsed; back later, it starts anew and is named as a gap (the last 4096 dropped ids are
remembered for that). An agent that comes back under another type also starts anew.

A forecast is of the agents that its state has seen: with P > 1 chains, one that flickers may
be missing from it for less than ``dt``, or stand where its chain last saw it.

Frames must be *world-fixed*: in a frame that moves with the robot a standing person seems
to walk, and forecasts are wrong.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trajectron_service.messages import Outcome

MAX_CHAINS = 20
MAX_FILL_STEPS = 4
DEPARTED_REMEMBERED = 4096
_INTERVAL_TOLERANCE = 0.02
_SLOT_TOLERANCE = 0.2
_NEAR = 1e-6  # relative: times that differ by less are the same


@dataclass(frozen=True, eq=False)
class Observation:
    """A checked frame: distinct ids, known types, finite positions in metres."""

    time_s: float
    ids: tuple[str, ...]  # [A]
    types: tuple[str, ...]  # [A]
    positions: NDArray[np.float64]  # [A, 2]

    def same_content(self, other: Observation) -> bool:
        """Whether both saw the same agents at the same places, in whatever order."""
        return len(self.ids) == len(other.ids) and self._content() == other._content()

    def _content(self) -> dict[str, tuple[str, float, float]]:
        places = self.positions.tolist()
        return {i: (t, x, y) for i, t, (x, y) in zip(self.ids, self.types, places, strict=True)}


class Seen(NamedTuple):
    """When and where an agent of the scene was last observed."""

    time_s: float
    type: str
    x: float
    y: float


@dataclass(frozen=True)
class Committed:
    """A state of the scene on the grid, named by its serial number.

    ``ids`` are the agents in it; ``pending`` those of the state's rows that have been
    dropped since and must be removed before the state is used.
    """

    serial: int
    time_s: float
    ids: frozenset[str]
    pending: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Step:
    """One step of the model: state ``source`` less ``drop``, with ``frame``, gives ``result``.

    ``source`` None is the empty scene.
    """

    source: int | None
    drop: frozenset[str]
    frame: Observation
    result: int


@dataclass(frozen=True, eq=False)
class Head:
    """Where a forecast starts: state ``source`` less ``drop``, after a provisional ``frame``.

    ``frame`` is None where the state is already that of the newest frame. ``ids`` are the
    agents of the scene there; ``time_s`` is the newest frame's.
    """

    source: int | None
    drop: frozenset[str]
    frame: Observation | None
    ids: frozenset[str]
    time_s: float


@dataclass(frozen=True)
class Grid:
    """The constants of a scene's time base: seconds, and the number of chains P."""

    dt_s: float
    chains: int
    agent_timeout_s: float

    @property
    def slot_s(self) -> float:
        """The width of a slot."""
        return self.dt_s / self.chains

    @staticmethod
    def of(dt_s: float, interval_s: float | None, agent_timeout_s: float) -> Grid:
        """The grid for frames expected every ``interval_s`` (None: every ``dt_s``)."""
        ratio = dt_s / (interval_s or dt_s)
        chains = round(ratio)
        fits = 1 <= chains <= MAX_CHAINS and abs(ratio - chains) <= _INTERVAL_TOLERANCE * chains
        return Grid(dt_s, chains if fits else 1, agent_timeout_s)


@dataclass(frozen=True, eq=False)
class Timeline:
    """What is known of a scene's frames so far: a value."""

    grid: Grid
    newest: Observation | None = None
    seen: Mapping[str, Seen] = dataclasses.field(default_factory=dict)
    departed: tuple[str, ...] = ()
    committed: tuple[Committed, ...] = ()
    next_serial: int = 0


@dataclass(frozen=True, eq=False)
class Advance:
    """What an accepted frame causes: the timeline after it, steps, agents that start anew."""

    timeline: Timeline
    steps: tuple[Step, ...]
    gaps: tuple[str, ...]

    @property
    def outcome(self) -> Outcome:
        """Accepted, with or without gaps."""
        return Outcome.ACCEPTED_WITH_GAPS if self.gaps else Outcome.ACCEPTED


def classify(timeline: Timeline, frame: Observation) -> Outcome:
    """Whether the frame goes on: ACCEPTED, or DUPLICATE, CONFLICT, OUT_OF_ORDER."""
    newest = timeline.newest
    if newest is None or frame.time_s > newest.time_s:
        return Outcome.ACCEPTED
    if frame.time_s < newest.time_s:
        return Outcome.OUT_OF_ORDER
    return Outcome.DUPLICATE if frame.same_content(newest) else Outcome.CONFLICT


def advance(timeline: Timeline, frame: Observation) -> Advance:
    """Takes a frame that ``classify`` accepts."""
    timeline, gaps = _drop_agents(timeline, frame)
    fills, on_slot = _slots(timeline, frame)
    steps: list[Step] = []
    for time_s in fills:
        assert timeline.newest is not None  # there are no passed slots without a frame
        point = interpolate(timeline.newest, frame, time_s)
        timeline = _commit(timeline, point, steps)
    if on_slot:
        timeline = _commit(timeline, frame, steps)
    places = frame.positions.tolist()
    now = {
        i: Seen(frame.time_s, t, x, y)
        for i, t, (x, y) in zip(frame.ids, frame.types, places, strict=True)
    }
    timeline = dataclasses.replace(timeline, newest=frame, seen={**timeline.seen, **now})
    return Advance(timeline, tuple(steps), gaps)


def head(timeline: Timeline) -> Head:
    """Where a forecast from the newest frame starts.

    Raises:
        ValueError: there is no frame yet.
    """
    newest = timeline.newest
    if newest is None:
        raise ValueError("a scene without frames has no forecast")
    last = timeline.committed[-1] if timeline.committed else None
    if last is not None and last.time_s == newest.time_s:
        return Head(last.serial, last.pending, None, last.ids, newest.time_s)
    dt_s = timeline.grid.dt_s
    ages = [(newest.time_s - state.time_s, state) for state in timeline.committed]
    fit = [(abs(age - dt_s), state) for age, state in ages if age >= dt_s * (0.5 - _NEAR)]
    if not fit:
        return Head(None, frozenset(), newest, frozenset(newest.ids), newest.time_s)
    nearest = min(distance for distance, _ in fit)
    # The newest of those at the same distance.
    source = [state for distance, state in fit if distance <= nearest + dt_s * _NEAR][-1]
    ids = source.ids.union(newest.ids)
    return Head(source.serial, source.pending, newest, ids, newest.time_s)


def interpolate(before: Observation, after: Observation, time_s: float) -> Observation:
    """The scene between two frames: agents present in both under one type, on straight lines."""
    rows = {agent: row for row, agent in enumerate(before.ids)}
    pairs = [
        (rows[agent], row)
        for row, agent in enumerate(after.ids)
        if agent in rows and before.types[rows[agent]] == after.types[row]
    ]
    first, second = ([pair[end] for pair in pairs] for end in (0, 1))
    share = (time_s - before.time_s) / (after.time_s - before.time_s)
    return Observation(
        time_s=time_s,
        ids=tuple(after.ids[row] for row in second),
        types=tuple(after.types[row] for row in second),
        positions=(1.0 - share) * before.positions[first] + share * after.positions[second],
    )


def _drop_agents(timeline: Timeline, frame: Observation) -> tuple[Timeline, tuple[str, ...]]:
    """Drops agents unseen for too long or come back as another type; names those that return."""
    limit = frame.time_s - timeline.grid.agent_timeout_s * (1.0 + _NEAR)
    gone = {agent for agent, last in timeline.seen.items() if last.time_s < limit}
    for agent, kind in zip(frame.ids, frame.types, strict=True):
        last = timeline.seen.get(agent)
        if last is not None and last.type != kind:
            gone.add(agent)
    if not gone and not timeline.departed:
        return timeline, ()
    away = gone.union(timeline.departed)
    gaps = tuple(agent for agent in frame.ids if agent in away)
    back = set(gaps)
    departed = [agent for agent in (*timeline.departed, *sorted(gone)) if agent not in back]
    return dataclasses.replace(
        timeline,
        seen={agent: last for agent, last in timeline.seen.items() if agent not in gone},
        departed=tuple(departed[-DEPARTED_REMEMBERED:]),
        committed=tuple(
            dataclasses.replace(s, ids=s.ids - gone, pending=s.pending | (s.ids & gone))
            for s in timeline.committed
        ),
    ), gaps


def _slots(timeline: Timeline, frame: Observation) -> tuple[Sequence[float], bool]:
    """The times of the slots that passed before the frame, and whether it takes one itself."""
    if timeline.newest is None or not timeline.committed:
        return (), True
    grid = timeline.grid
    since_newest = frame.time_s - timeline.newest.time_s
    if since_newest > min(grid.dt_s * MAX_FILL_STEPS, grid.agent_timeout_s) * (1.0 + _NEAR):
        return (), True
    last_s, slot_s = timeline.committed[-1].time_s, grid.slot_s
    slots = (frame.time_s - last_s) / slot_s
    due = round(slots)
    late_s = abs(slots - due) * slot_s
    on_slot = due >= 1 and late_s <= min(_SLOT_TOLERANCE * slot_s, 0.5 * since_newest)
    passed = due - 1 if on_slot else math.floor(slots)
    return [last_s + k * slot_s for k in range(1, passed + 1)], on_slot


def _commit(timeline: Timeline, frame: Observation, steps: list[Step]) -> Timeline:
    """Gives a slot its step, from the state of P slots before."""
    chains = timeline.grid.chains
    committed = timeline.committed
    source = committed[-chains] if len(committed) >= chains else None
    serial = timeline.next_serial
    held: frozenset[str] = source.ids if source else frozenset()
    pending: frozenset[str] = source.pending if source else frozenset()
    steps.append(Step(source.serial if source else None, pending, frame, serial))
    state = Committed(serial, frame.time_s, held.union(frame.ids))
    return dataclasses.replace(
        timeline, committed=(*committed, state)[-(chains + 1) :], next_serial=serial + 1
    )
