"""People who walk, for the client's tests."""

from __future__ import annotations

from trajectron_client import Agent, Frame

DT_S = 0.4


def frame(step: int, people: int = 3) -> Frame:
    """People a metre apart who walk along x at 1.25 m/s."""
    agents = [Agent(str(n), "pedestrian", 0.5 * step, float(n)) for n in range(people)]
    return Frame(DT_S * step, agents)


def walking(frames: int = 4, people: int = 3) -> list[Frame]:
    """The first frames of such a scene."""
    return [frame(step, people) for step in range(frames)]
