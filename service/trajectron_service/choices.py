"""What a request leaves open, chosen; what it asks for, checked against the limits."""

from __future__ import annotations

import math
import re
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from trajectron_service.errors import ErrorKind, FieldViolation, ServiceError, invalid
from trajectron_service.messages import (
    ForecastMode,
    ForecastOptions,
    SessionConfig,
)
from trajectron_service.pace import Work
from trajectron_service.scenes import ForecastTask, ModelFacts
from trajectron_service.settings import Settings
from trajectron_service.timebase import Grid, Timeline, head
from trajectron_service.validation import FrameLimits, TypeRules, quoted, text_fault

SEED_BOUND = 2**63
# Seeds drawn here survive JSON readers that hold numbers as doubles.
_DRAWN_SEED_BOUND = 2**53
# Every session keeps its own map.
MAX_TYPE_MAP = 100
_SESSION_ID = re.compile(r"[A-Za-z0-9._-]{1,128}")
# An agent unseen for less than this many intervals is only late.
_LATE_INTERVALS = 2.0


def draw_seed() -> int:
    """A seed for a request that brings none."""
    return secrets.randbelow(_DRAWN_SEED_BOUND)


@dataclass(frozen=True)
class Choices:
    """Resolves requests against the settings and the loaded models."""

    settings: Settings
    models: Mapping[str, ModelFacts]
    default_model: str
    draw_seed: Callable[[], int] = draw_seed

    def model(self, name: str | None) -> ModelFacts:
        """The facts of a model by name, of the default one for None or an empty name."""
        facts = self.models.get(name or self.default_model)
        if facts is None:
            known = ", ".join(map(quoted, self.models))
            raise ServiceError(
                ErrorKind.UNKNOWN_MODEL,
                f"model: {quoted(name or '')} is not loaded; this server has {known}",
                violations=(FieldViolation("model", f"must be one of {known}"),),
            )
        return facts

    def session_config(self, config: SessionConfig) -> SessionConfig:
        """The configuration with every field set; raises for one out of bounds."""
        facts = self.model(config.model)
        interval_s = _seconds("frame_interval_s", config.frame_interval_s, facts.info.dt_s, 1e4)
        usual_s = max(self.settings.agent_timeout_s, _LATE_INTERVALS * interval_s)
        longest_s = max(self.settings.max_agent_timeout_s, _LATE_INTERVALS * interval_s)
        timeout_s = _seconds("agent_timeout_s", config.agent_timeout_s, usual_s, longest_s)
        if timeout_s < interval_s:
            raise invalid(
                "agent_timeout_s",
                f"is {timeout_s:g} s, less than the {interval_s:g} s between frames; "
                "every agent would be dropped at every frame",
            )
        idle_s = _seconds(
            "idle_timeout_s",
            config.idle_timeout_s,
            self.settings.idle_timeout_s,
            self.settings.max_idle_timeout_s,
        )
        _check_type_map(config.type_map, facts)
        return SessionConfig(
            model=facts.info.name,
            frame_interval_s=interval_s,
            agent_timeout_s=timeout_s,
            idle_timeout_s=idle_s,
            unknown_types=config.unknown_types,
            type_map=dict(config.type_map),
        )

    def grid(self, config: SessionConfig) -> Grid:
        """The time base of a resolved configuration."""
        assert config.agent_timeout_s is not None  # resolved
        dt_s = self.model(config.model).info.dt_s
        return Grid.of(dt_s, config.frame_interval_s, config.agent_timeout_s)

    def type_rules(self, config: SessionConfig) -> TypeRules:
        """How a session reads types."""
        facts = self.model(config.model)
        return TypeRules(
            facts.speed_limits_mps, facts.radii_m, config.unknown_types, config.type_map
        )

    @property
    def frame_limits(self) -> FrameLimits:
        """The limits of frames in the settings."""
        return FrameLimits(
            self.settings.max_agents_per_frame,
            self.settings.max_agents_per_scene,
            self.settings.max_edges_per_frame,
            self.settings.speed_tolerance,
        )

    def check_options(self, options: ForecastOptions) -> None:
        """Raises for what no scene could answer: counts and seeds out of their bounds."""
        _bounded("num_samples", options.num_samples, 1, self.settings.max_samples)
        _bounded("horizon", options.horizon, 1, self.settings.max_horizon)
        _bounded("seed", options.seed, 0, SEED_BOUND - 1)
        check_deadline(options.deadline_s)
        places: dict[str, int] = {}
        for row, agent in enumerate(options.agents or ()):
            if agent in places:
                raise invalid(f"agents[{row}]", f"{quoted(agent)} is also agents[{places[agent]}]")
            places[agent] = row

    def task(
        self,
        options: ForecastOptions,
        timeline: Timeline,
        version: int,
        model: ModelFacts,
        deadline: float | None = None,
    ) -> ForecastTask:
        """The forecast asked for, from the newest frame, by ``deadline``.

        Raises:
            ServiceError: no frame yet, an agent that is not in the scene, or too much at once.
        """
        self.check_options(options)
        if timeline.newest is None:
            raise ServiceError(
                ErrorKind.NO_FRAMES, "there is nothing to forecast before the first frame"
            )
        where = head(timeline)
        agents = options.agents or None
        for row, agent in enumerate(agents or ()):
            if agent not in where.ids:
                raise ServiceError(
                    ErrorKind.UNKNOWN_AGENT,
                    f"agents[{row}]: {quoted(agent)} is not in the scene",
                    violations=(FieldViolation(f"agents[{row}]", "is not in the scene"),),
                )
        mode = options.mode
        task = ForecastTask(
            head=where,
            mode=mode,
            num_samples=options.num_samples or self.settings.default_samples,
            horizon=options.horizon or min(model.info.horizon, self.settings.max_horizon),
            seed=self.draw_seed() if options.seed is None else options.seed,
            step=version,
            agents=agents,
            include_modes=(
                mode is ForecastMode.GMM if options.include_modes is None else options.include_modes
            ),
            sampling=options.sampling,
            deadline=deadline,
            allow_fewer=options.allow_fewer_samples,
        )
        self._check_size(task, model)
        return task

    def _check_size(self, task: ForecastTask, model: ModelFacts) -> None:
        points = task_points(task, model)
        limit = self.settings.max_forecast_points
        if points > limit:
            agents = len(task.agents or task.head.ids)
            field = "horizon" if task.mode is ForecastMode.GMM else "num_samples"
            message = (
                f"{agents} agents x {points // (agents * task.horizon)} samples x {task.horizon} "
                f"steps are {points} positions; one request may ask for {limit}: ask for fewer "
                "samples, steps or agents"
            )
            raise ServiceError(
                ErrorKind.TOO_LARGE,
                f"{field}: {message}",
                violations=(FieldViolation(field, message),),
            )


def task_points(task: ForecastTask, model: ModelFacts) -> int:
    """What a forecast costs: agents x samples x steps (latent values instead for ``gmm``)."""
    agents = len(task.agents or task.head.ids)
    samples = task.made
    modes = model.info.latent_values if task.include_modes or not samples else 0
    return agents * (samples + modes) * task.horizon


def task_work(task: ForecastTask, model: ModelFacts) -> Work:
    """What a forecast is made of, for the learned pace."""
    agents = len(task.agents or task.head.ids)
    samples = task.made
    modes = model.info.latent_values if task.include_modes or not samples else 0
    step = agents if task.head.frame is not None else 0
    return Work(0.0, step, agents * samples * task.horizon, agents * modes * task.horizon)


def session_id(wanted: str | None) -> str:
    """A valid session id: the one wanted, or a new one for None or an empty one."""
    if not wanted:
        return secrets.token_hex(12)
    if not _SESSION_ID.fullmatch(wanted):
        raise invalid(
            "session_id", f"{quoted(wanted)} is not 1 to 128 of letters, digits, '.', '_', '-'"
        )
    return wanted


def _bounded(field: str, value: int | None, least: int, most: int) -> None:
    if value is not None and not least <= value <= most:
        raise invalid(field, f"is {value}; must be {least} to {most}")


def check_deadline(deadline_s: float | None) -> None:
    """Raises for a time to answer in that is none."""
    if deadline_s is not None and not (math.isfinite(deadline_s) and deadline_s > 0.0):
        raise invalid("deadline_s", f"is {deadline_s:g} s; must be greater than 0 and finite")


def _seconds(field: str, value: float | None, default: float, most: float) -> float:
    if value is None:
        return default
    if not (math.isfinite(value) and 0.0 < value <= most):
        raise invalid(field, f"is {value:g} s; must be greater than 0 and at most {most:g} s")
    return value


def _check_type_map(type_map: Mapping[str, str], model: ModelFacts) -> None:
    if len(type_map) > MAX_TYPE_MAP:
        raise invalid(
            "type_map", f"has {len(type_map)} entries; a type_map may have at most {MAX_TYPE_MAP}"
        )
    for name, kind in type_map.items():
        fault = text_fault(name, "an agent type")
        if fault is not None:
            raise invalid("type_map", f"the key {quoted(name)} {fault}")
        if kind not in model.speed_limits_mps:
            known = ", ".join(map(quoted, model.speed_limits_mps))
            raise invalid(
                f"type_map[{quoted(name)}]", f"is {quoted(kind)}; this model knows {known}"
            )
