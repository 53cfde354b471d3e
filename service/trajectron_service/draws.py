"""Forecast tasks as requests of the model: agents drawn together by how long they are away.

**Missing agents.** An agent that is not in the newest frame is forecast from its last observed
position, but its offsets hold at the same times as everybody's: the model is run that many
steps further and the steps before the newest frame are left out (linear between two steps
where the time away is not a whole number of steps). Where that would go beyond the model's
longest horizon, the last step's change is held.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trajectron_model.config import MAX_HORIZON, ModelConfig
from trajectron_model.forecast import ForecastRequest, SceneForecast
from trajectron_model.state import SceneState
from trajectron_model.trajectron import Trajectron
from trajectron_service.messages import AgentForecast
from trajectron_service.scenes import ForecastTask

# A time away that is this close to whole steps counts as whole (share of a step).
_WHOLE = 1e-3


@dataclass(frozen=True, eq=False)
class _Draw:
    """The part of a forecast task that has one number of steps away."""

    task: ForecastTask
    state: SceneState
    agents: tuple[str, ...]
    steps_away: float

    @property
    def request(self) -> ForecastRequest:
        """What the model is asked: the horizon, and the steps that are left out again."""
        task = self.task
        return ForecastRequest(
            mode=task.mode.value,
            num_samples=task.num_samples,
            horizon=min(task.horizon + math.ceil(self.steps_away), MAX_HORIZON),
            seed=task.seed,
            step=task.step,
            agents=self.agents,
            include_modes=task.include_modes,
            sampling=task.sampling.value,
        )


def forecast_all(
    network: Trajectron, tasks: Sequence[ForecastTask], states: Sequence[SceneState]
) -> list[tuple[AgentForecast, ...]]:
    """The forecasts of all tasks, drawn together."""
    draws = [_draws(task, state, network.config) for task, state in zip(tasks, states, strict=True)]
    flat = [draw for of_task in draws for draw in of_task]
    drawn = network.forecast([draw.state for draw in flat], [draw.request for draw in flat])
    by_draw = dict(zip(map(id, flat), drawn, strict=True))
    answers = []
    for of_task in draws:
        found: dict[str, AgentForecast] = {}
        for draw in of_task:
            found |= {one.id: one for one in _agents(by_draw[id(draw)], draw)}
        order = of_task[0].task.agents or of_task[0].state.ids if of_task else ()
        answers.append(tuple(found[agent] for agent in order if agent in found))
    return answers


def _draws(task: ForecastTask, state: SceneState, config: ModelConfig) -> list[_Draw]:
    """The task, cut by how many steps its agents have been away; nothing for an empty scene.

    Agents that cannot move are left out unless they are asked for, as are those of other shares.
    """
    away = (task.head.time_s - state.last_seen_s.numpy()) / config.dt_s  # [N]
    away = np.where(np.abs(away - np.rint(away)) < _WHOLE, np.rint(away), away)
    rows = zip(state.ids, state.node_type.tolist(), away.tolist(), strict=True)
    if task.agents is None:
        wanted = [
            (agent, steps) for agent, kind, steps in rows if not config.types[kind].stationary
        ]
    else:
        steps_away = {agent: steps for agent, _, steps in rows}
        wanted = [(agent, steps_away[agent]) for agent in task.agents]
    share, shares = task.share
    groups: dict[float, list[str]] = defaultdict(list)
    for agent, steps in wanted[len(wanted) * share // shares : len(wanted) * (share + 1) // shares]:
        groups[steps].append(agent)
    return [_Draw(task, state, tuple(agents), steps) for steps, agents in groups.items()]


def _agents(drawn: SceneForecast, draw: _Draw) -> list[AgentForecast]:
    """One model forecast, agent by agent, with the steps before the newest frame left out."""
    horizon, away = draw.task.horizon, draw.steps_away

    def ahead(array: NDArray[np.float32] | None, row: int) -> NDArray[np.float32] | None:
        return None if array is None else _ahead(array[row], horizon, away)

    modes = drawn.sample_modes
    return [
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
    ]


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
