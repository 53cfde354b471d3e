"""Scenes for the contract tests, as the JSON API writes them."""

from __future__ import annotations

from typing import Any

Json = dict[str, Any]

DT_S = 0.4


def agent(agent_id: str = "1", x: float = 0.0, y: float = 0.0, kind: str = "pedestrian") -> Json:
    """One observed agent."""
    return {"id": agent_id, "type": kind, "x": x, "y": y}


def frame(time: float, *agents: Json) -> Json:
    """Everything seen at one instant."""
    return {"time": time, "agents": list(agents)}


def walking(
    frames: int = 4, agents: int = 3, origin: tuple[float, float] = (0.0, 0.0)
) -> list[Json]:
    """People a metre apart who walk along x at 1.25 m/s; time starts at 0."""
    return [
        frame(
            DT_S * step,
            *(
                agent(str(number), origin[0] + 0.5 * step, origin[1] + float(number))
                for number in range(agents)
            ),
        )
        for step in range(frames)
    ]
