"""Forecast tasks as requests of the model.

**Missing agents.** An agent that is not in the newest frame is forecast from its last observed
position, but its offsets hold at the same times as everybody's: the model is run that many
steps further and the steps before the newest frame are left out (linear between two steps
where the time away is not a whole number of steps). Where that would go beyond the model's
longest horizon, the last step's change is held.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajectron_model import online
from trajectron_model.config import MAX_HORIZON, ModelConfig
from trajectron_model.forecast import ForecastRequest, SceneForecast
from trajectron_model.packed import Layout, PackedScene
from trajectron_model.trajectron import Trajectron
from trajectron_service.messages import AgentForecast
from trajectron_service.scenes import ForecastTask

# A time away that is this close to whole steps counts as whole (share of a step).
_WHOLE = 1e-3


@dataclass(frozen=True, eq=False)
class _Draw:
    """A forecast task, and how many steps each of its agents has been away."""

    task: ForecastTask
    agents: tuple[str, ...]
    steps_away: tuple[float, ...]

    @property
    def request(self) -> ForecastRequest:
        """What the model is asked: the horizons, and the steps that are left out again."""
        task = self.task
        return ForecastRequest(
            mode=task.mode.value,
            num_samples=task.num_samples,
            horizon=task.horizon,
            seed=task.seed,
            step=task.step,
            agents=self.agents,
            include_modes=task.include_modes,
            sampling=task.sampling.value,
            run=task.run,
            horizons=tuple(
                min(task.horizon + math.ceil(steps), MAX_HORIZON) for steps in self.steps_away
            ),
        )


def forecast_all(
    network: Trajectron, tasks: Sequence[ForecastTask], scenes: Sequence[PackedScene]
) -> list[tuple[AgentForecast, ...]]:
    """The forecasts of all tasks, each from its scene, drawn together."""
    draws = [_draw(task, scene, network.config) for task, scene in zip(tasks, scenes, strict=True)]
    drawn = online.forecast(network, scenes, [draw.request for draw in draws])
    return [_agents(one, draw) for one, draw in zip(drawn, draws, strict=True)]


def _draw(task: ForecastTask, scene: PackedScene, config: ModelConfig) -> _Draw:
    """The task, with how many steps its agents have been away.

    Agents that cannot move are left out unless they are asked for, as are those of other shares.
    """
    records = np.frombuffer(scene.nodes, dtype=Layout.of(config).node)
    away = (task.head.time_s - records["last_seen_s"]) / config.dt_s  # [N]
    away = np.where(np.abs(away - np.rint(away)) < _WHOLE, np.rint(away), away)
    rows = zip(scene.ids, records["type"].tolist(), away.tolist(), strict=True)
    if task.agents is None:
        wanted = [
            (agent, steps) for agent, kind, steps in rows if not config.types[kind].stationary
        ]
    else:
        steps_away = {agent: steps for agent, _, steps in rows}
        wanted = [(agent, steps_away[agent]) for agent in task.agents]
    share, shares = task.share
    first, last = (len(wanted) * part // shares for part in (share, share + 1))
    mine = wanted[first:last]
    return _Draw(task, tuple(agent for agent, _ in mine), tuple(steps for _, steps in mine))


def _agents(drawn: SceneForecast, draw: _Draw) -> tuple[AgentForecast, ...]:
    """One model forecast, agent by agent, with the steps before the newest frame left out."""

    def ahead(array: NDArray[np.float32] | None, row: int) -> NDArray[np.float32] | None:
        if array is None:
            return None
        own = array[row, :, : drawn.horizons[row]]
        return _ahead(own, draw.task.horizon, draw.steps_away[row])

    modes = drawn.sample_modes
    return tuple(
        AgentForecast(
            id=agent,
            type=drawn.types[row],
            x=float(drawn.position[row, 0]),
            y=float(drawn.position[row, 1]),
            last_observed_time=float(drawn.last_seen_s[row]),
            observations=int(drawn.observations[row]),
            heading_known=bool(drawn.heading_known[row]),
            mode_probabilities=drawn.mode_probabilities[row],
            mean=ahead(drawn.mean, row),
            covariance=ahead(drawn.covariance, row),
            samples=ahead(drawn.samples, row),
            sample_modes=None if modes is None else modes[row],
        )
        for row, agent in enumerate(drawn.ids)
    )


def _ahead(array: NDArray[np.float32], horizon: int, away: float) -> NDArray[np.float32]:
    """``array`` [..., H', C] from ``away`` steps on: [..., H, C]."""
    if away == 0.0:
        return array
    whole, share = int(away), np.float32(away % 1.0)
    missing = whole + int(share > 0.0) + horizon - array.shape[-2]
    if missing > 0:
        last = array[..., -1:, :]
        change = last - array[..., -2:-1, :]
        beyond = np.arange(1, missing + 1, dtype=np.float32)[:, None]  # [steps, 1]
        array = np.concatenate([array, last + change * beyond], axis=-2)
    first = array[..., whole : whole + horizon, :]
    if share == 0.0:
        return first
    second = array[..., whole + 1 : whole + 1 + horizon, :]
    return (1 - share) * first + share * second
