"""Recordings as the commands use them: scene after scene, without torch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from trajectron_service.commands.errors import UsageError

if TYPE_CHECKING:
    from trajectron_model.data.recording import Recording


class Seen(NamedTuple):
    """One agent at one instant; metres."""

    id: str
    type: str
    x: float
    y: float


class Scene(NamedTuple):
    """Everyone seen at one instant; ``time_s`` is on the recording's clock."""

    time_s: float
    agents: tuple[Seen, ...]


def scenes(recording: Recording, first: int, last: int) -> Iterator[Scene]:
    """Steps ``first`` to ``last - 1``, those at which nobody was there included."""
    for step in range(first, last):
        rows = recording.rows(step, step + 1)
        agents = recording.agent[rows].tolist()
        places = recording.position[rows].tolist()
        yield Scene(
            recording.time_s(step),
            tuple(
                Seen(recording.ids[agent], recording.types[agent], x, y)
                for agent, (x, y) in zip(agents, places, strict=True)
            ),
        )


def steps_between(
    recording: Recording, start_s: float | None, seconds: float | None
) -> tuple[int, int]:
    """The step nearest to ``start_s``, and one past the last within ``seconds`` of it.

    Raises:
        UsageError: the recording has nothing at ``start_s``.
    """
    first = 0 if start_s is None else step_at(recording, start_s, "--start")
    steps = recording.num_steps if seconds is None else int(seconds / recording.dt_s + 1e-6) + 1
    return first, min(first + steps, recording.num_steps)


def step_at(recording: Recording, time_s: float, option: str) -> int:
    """The step nearest to a time.

    Raises:
        UsageError: the recording does not reach there.
    """
    step = round((time_s - recording.start_time_s) / recording.dt_s)
    if not 0 <= step < recording.num_steps:
        end_s = recording.time_s(recording.num_steps - 1)
        raise UsageError(
            f"{option} {time_s:g}: the recording goes from {recording.start_time_s:g} s "
            f"to {end_s:g} s"
        )
    return step
