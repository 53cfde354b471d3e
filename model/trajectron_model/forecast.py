"""Futures from states: requests and forecasts as values, batched over scenes.

Three forms (paper, section 5, and its note on analytic mixtures):

* ``full``: z ~ p(z|x), y ~ p(y|x,z); ``z_best``: z = argmax p(z|x), y ~ p(y|x,z).
* ``gmm``: no sampling. Every latent value that is not negligible is one mode (``modes``).

An agent that has shown no direction gets an isotropic forecast: each of its samples is
turned by a uniform angle of its own, and its modes are the moments of that.

Samples of different agents are independent given the histories. Those of one agent are
independent or stratified, as asked; each alone has the same distribution (``noise``).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajectron_model.config import MAX_HORIZON, MAX_SAMPLES, MODE_PROBABILITY_FLOOR
from trajectron_model.encoders import EncoderState
from trajectron_model.features import Kinematics, from_frame
from trajectron_model.gmm import choose
from trajectron_model.integration import integrate
from trajectron_model.kernels.threads import torch_alone
from trajectron_model.modes import (
    mode_moments,
    start_velocity,
    without_direction,
    without_negligible,
)
from trajectron_model.node_model import NodeModel
from trajectron_model.noise import SAMPLINGS, Sampling, scene_noise
from trajectron_model.rows import SceneRows, rows_of
from trajectron_model.state import SceneState

if TYPE_CHECKING:
    from trajectron_model.trajectron import Trajectron

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class ForecastRequest:
    """What to forecast of one scene.

    Attributes:
        mode: see the module.
        num_samples: S, 1 to 2000; ignored by ``gmm``.
        horizon: H, 1 to 60 steps.
        seed: 0 <= seed < 2**63.
        step: of the session, its count of accepted frames: part of the key of the noise.
        agents: ids wanted, in this order; None for all that can move.
        include_modes: whether means and covariances are given; ``gmm`` always gives them.
        sampling: how one agent's samples go together; see ``noise``.
        horizons: steps of each of ``agents``, 1 to 60, instead of H for all.
        run: (first, last), half open: of the S samples only these are made, the same as they
            would be among all S. None for all of them.

    Raises:
        ValueError: a number out of its bounds; horizons without agents or not as many.
    """

    mode: Literal["full", "z_best", "gmm"] = "full"
    num_samples: int = 20
    horizon: int = 12
    seed: int = 0
    step: int = 0
    agents: tuple[str, ...] | None = None
    include_modes: bool = False
    sampling: Sampling = "iid"
    horizons: tuple[int, ...] | None = None
    run: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.mode not in ("full", "z_best", "gmm"):
            raise ValueError(f"mode {self.mode!r} is none of full, z_best, gmm")
        if self.sampling not in SAMPLINGS:
            raise ValueError(f"sampling {self.sampling!r} is none of {', '.join(SAMPLINGS)}")
        if not 1 <= self.num_samples <= MAX_SAMPLES:
            raise ValueError(f"num_samples must be 1 to {MAX_SAMPLES}")
        if self.run is not None and not 0 <= self.run[0] < self.run[1] <= self.num_samples:
            raise ValueError("run must be some of the samples")
        for steps in (self.horizon, *(self.horizons or ())):
            if not 1 <= steps <= MAX_HORIZON:
                raise ValueError(f"horizon must be 1 to {MAX_HORIZON} steps")
        if self.horizons is not None and len(self.horizons) != len(self.agents or ()):
            raise ValueError("horizons must be as many as agents")
        if not (0 <= self.seed < 2**63 and 0 <= self.step < 2**63):
            raise ValueError("seed and step must lie in 0 .. 2**63 - 1")

    @property
    def samples(self) -> int:
        """How many samples are made: none for ``gmm``."""
        if self.mode == "gmm":
            return 0
        return self.num_samples if self.run is None else self.run[1] - self.run[0]

    @property
    def modes(self) -> bool:
        """Whether means and covariances of modes are computed."""
        return self.include_modes or self.mode == "gmm"

    @property
    def mode_probability_floor(self) -> float:
        """Modes that are less probable are left out, and their probability given as zero."""
        return MODE_PROBABILITY_FLOOR if self.mode == "gmm" else 0.0


@dataclass(frozen=True)
class SceneForecast:
    """The futures of one scene's agents; offsets are metres from ``position``, world axes."""

    ids: tuple[str, ...]
    types: tuple[str, ...]
    position: NDArray[np.float64]  # [A, 2] last observed
    last_seen_s: NDArray[np.float64]  # [A]
    observations: NDArray[np.int64]  # [A]
    heading_known: NDArray[np.bool_]  # [A]
    mode_probabilities: Float32  # [A, Z]
    mean: Float32 | None  # [A, Z, H, 2]
    covariance: Float32 | None  # [A, Z, H, 3] xx, xy, yy
    samples: Float32 | None  # [A, S, H, 2]
    sample_modes: NDArray[np.int64] | None  # [A, S]
    horizons: tuple[int, ...]  # [A] steps of each agent, H the most of them; zeros behind


class _Agent(NamedTuple):
    """One agent that is to be forecast."""

    request: int
    place: int  # in its forecast
    row: int
    id: str
    horizon: int


class _Agents(NamedTuple):
    """B agents of one type that are decoded together."""

    agents: list[_Agent]  # by horizon: those of one length are decoded side by side
    encoding: Tensor  # [B, D]
    motion: Kinematics
    log_prior: Tensor  # [B, Z]

    def horizons(self, wanted: Sequence[int]) -> list[int]:
        """Steps of some of the agents."""
        return [self.agents[i].horizon for i in wanted]


def forecast_scenes(
    model: Trajectron, states: Sequence[SceneState], requests: Sequence[ForecastRequest]
) -> list[SceneForecast]:
    """The futures that each request asks of its state; see ``Trajectron.forecast``."""
    return forecast_rows(model, rows_of(states), requests) if states else []


def forecast_rows(
    model: Trajectron, rows: SceneRows, requests: Sequence[ForecastRequest]
) -> list[SceneForecast]:
    """The same of scenes whose agents stand beside each other, a request for each scene."""
    with torch_alone():
        picked = [
            _picked(model, rows, number, first, request)
            for number, (first, request) in enumerate(zip(rows.firsts[:-1], requests, strict=True))
        ]
        results = _blank(model, rows, requests, picked)
        for kind, agents in _groups(model, rows, requests, picked):
            probabilities = agents.log_prior.exp().cpu().numpy()
            for agent, row in zip(agents.agents, probabilities, strict=True):
                results[agent.request].mode_probabilities[agent.place] = row
            _fill_modes(model, kind, agents, requests, results)
            _fill_samples(model, kind, agents, requests, results)
    return results


def _picked(
    model: Trajectron, rows: SceneRows, number: int, first: int, request: ForecastRequest
) -> list[_Agent]:
    """The agents that a request asks for; its scene's rows begin at ``first``."""
    ids = rows.ids[number]
    if request.agents is None:
        stationary = [t.stationary for t in model.config.types]
        kinds = rows.node_type[first : first + len(ids)].tolist()
        places = [place for place, kind in enumerate(kinds) if not stationary[kind]]
    else:
        place_of = {agent: place for place, agent in enumerate(ids)}
        unknown = [agent for agent in request.agents if agent not in place_of]
        if unknown:
            raise KeyError(f"no agent {unknown[0]!r} in the scene")
        places = [place_of[agent] for agent in request.agents]
    horizons = request.horizons or (request.horizon,) * len(places)
    return [
        _Agent(number, at, first + place, ids[place], horizon)
        for at, (place, horizon) in enumerate(zip(places, horizons, strict=True))
    ]


def _blank(
    model: Trajectron,
    rows: SceneRows,
    requests: Sequence[ForecastRequest],
    picked: Sequence[Sequence[_Agent]],
) -> list[SceneForecast]:
    """Forecasts whose arrays are still to be filled."""
    names, values = model.config.node_types, model.config.latent_values
    motion = rows.motion
    columns = [
        column.cpu().numpy()
        for column in (
            motion.position,
            motion.last_seen_s,
            motion.observations,
            motion.heading_known,
        )
    ]
    blank = []
    for request, agents in zip(requests, picked, strict=True):
        index = np.array([agent.row for agent in agents], dtype=np.int64)
        position, last_seen_s, observations, heading_known = (column[index] for column in columns)
        horizons = tuple(agent.horizon for agent in agents)
        steps, samples = max(horizons, default=request.horizon), request.samples
        shape = (len(agents), values, steps)
        forecast = SceneForecast(
            ids=tuple(agent.id for agent in agents),
            types=tuple(names[kind] for kind in rows.node_type[index].tolist()),
            position=position,
            last_seen_s=last_seen_s,
            observations=observations,
            heading_known=heading_known,
            mode_probabilities=np.zeros(shape[:2], dtype=np.float32),
            mean=np.zeros((*shape, 2), dtype=np.float32) if request.modes else None,
            covariance=np.zeros((*shape, 3), dtype=np.float32) if request.modes else None,
            samples=(
                np.zeros((len(agents), samples, steps, 2), dtype=np.float32) if samples else None
            ),
            sample_modes=np.zeros((len(agents), samples), dtype=np.int64) if samples else None,
            horizons=horizons,
        )
        blank.append(forecast)
    return blank


def _groups(
    model: Trajectron,
    rows: SceneRows,
    requests: Sequence[ForecastRequest],
    picked: Sequence[Sequence[_Agent]],
) -> Iterator[tuple[int, _Agents]]:
    """Agents of all requests by type, encoded."""
    members: dict[int, list[_Agent]] = defaultdict(list)
    kinds = rows.node_type.tolist()
    for agents in picked:
        for agent in agents:
            members[kinds[agent.row]].append(agent)
    for kind, found in members.items():
        found.sort(key=attrgetter("horizon"))
        index = torch.tensor([agent.row for agent in found], device=rows.influence.device)
        networks = model.node_model(kind)
        encoding = networks.encoding(
            EncoderState(*(column[index] for column in rows.encoder)), rows.influence[index]
        )
        motion = Kinematics(*(column[index] for column in rows.motion))
        log_prior = _prior(networks, encoding, [requests[agent.request] for agent in found])
        yield kind, _Agents(found, encoding, motion, log_prior)


def _prior(networks: NodeModel, encoding: Tensor, asked: Sequence[ForecastRequest]) -> Tensor:
    """log p(z|x) [B, Z] as each agent's request counts it."""
    log_prior = networks.latent.prior(encoding)
    floors = [request.mode_probability_floor for request in asked]
    if not any(floors):
        return log_prior
    return without_negligible(log_prior, log_prior.new_tensor(floors))


def _fill_modes(
    model: Trajectron,
    kind: int,
    agents: _Agents,
    requests: Sequence[ForecastRequest],
    results: list[SceneForecast],
) -> None:
    wanted = [i for i, agent in enumerate(agents.agents) if requests[agent.request].modes]
    if not wanted:
        return
    index = torch.tensor(wanted, device=agents.encoding.device)
    motion = Kinematics(*(column[index] for column in agents.motion))
    mean, covariance = mode_moments(
        model,
        kind,
        agents.encoding[index],
        agents.log_prior[index],
        motion,
        torch.tensor(agents.horizons(wanted), device=index.device),
    )
    for i, mean_of, covariance_of in zip(
        wanted, mean.cpu().numpy(), covariance.cpu().numpy(), strict=True
    ):
        agent = agents.agents[i]
        result = results[agent.request]
        assert result.mean is not None and result.covariance is not None
        result.mean[agent.place, :, : agent.horizon] = mean_of[:, : agent.horizon]
        result.covariance[agent.place, :, : agent.horizon] = covariance_of[:, : agent.horizon]


def _fill_samples(
    model: Trajectron,
    kind: int,
    agents: _Agents,
    requests: Sequence[ForecastRequest],
    results: list[SceneForecast],
) -> None:
    wanted = [i for i, agent in enumerate(agents.agents) if requests[agent.request].samples]
    if not wanted:
        return
    device = agents.encoding.device
    asked = [requests[agents.agents[i].request] for i in wanted]
    latent, turn, component, normal = _noise(wanted, agents, requests)
    counts = [request.samples for request in asked]
    best = [request.mode == "z_best" for request in asked]
    repeats = torch.tensor(counts, device=device)
    agent = torch.tensor(wanted, device=device).repeat_interleave(repeats)  # [R]
    prior = agents.log_prior.exp()
    modes = choose(prior[agent], latent)
    modes = torch.where(
        torch.tensor(best, device=device).repeat_interleave(repeats),
        agents.log_prior.argmax(dim=-1)[agent],
        modes,
    )
    offsets = _sample_offsets(model, kind, agents, agent, modes, turn, component, normal)
    values, latents = offsets.cpu().numpy(), modes.cpu().numpy()
    ends = np.cumsum(counts)
    for i, last, count in zip(wanted, ends, counts, strict=True):
        one = agents.agents[i]
        result = results[one.request]
        assert result.samples is not None and result.sample_modes is not None
        result.samples[one.place, :, : one.horizon] = values[last - count : last, : one.horizon]
        result.sample_modes[one.place] = latents[last - count : last]


def _noise(
    wanted: Sequence[int], agents: _Agents, requests: Sequence[ForecastRequest]
) -> list[Tensor]:
    """Latent [R], turn [R], component [R, H] and normal [R, H, 2] of all samples of agents."""
    steps = max(agents.horizons(wanted))
    drawn = []
    of_request = attrgetter("request", "horizon")
    for (number, horizon), same in groupby((agents.agents[i] for i in wanted), key=of_request):
        asked, ids = requests[number], [agent.id for agent in same]
        noise = scene_noise(asked.seed, ids, asked.step, asked.num_samples, horizon, asked.sampling)
        run = slice(*(asked.run or (None,)))
        wished = (part[:, run] for part in noise)
        drawn.append([_longer(part.reshape(-1, *part.shape[2:]), steps) for part in wished])
    columns = [np.concatenate(column) for column in zip(*drawn, strict=True)]  # [R, ...]
    return [torch.from_numpy(column).to(agents.encoding.device) for column in columns]


def _longer(noise: Float32, steps: int) -> Float32:
    """Noise [R, H', ...] for so many steps, zeros behind; [R] stays."""
    if noise.ndim == 1 or noise.shape[1] == steps:
        return noise
    longer = np.zeros((len(noise), steps, *noise.shape[2:]), dtype=np.float32)
    longer[:, : noise.shape[1]] = noise
    return longer


def _sample_offsets(
    model: Trajectron,
    kind: int,
    agents: _Agents,
    agent: Tensor,
    modes: Tensor,
    turn: Tensor,
    component: Tensor,
    normal: Tensor,
) -> Tensor:
    """Sampled offsets [R, H, 2] in metres, world axes, of rows (agent [R], latent value [R])."""
    agent_type, networks = model.config.types[kind], model.node_model(kind)
    velocity = start_velocity(model, agents.motion, kind)
    prepared = networks.decoder.prepare(agents.encoding, velocity)
    limit = agent_type.speed_limit_mps / agent_type.speed_scale_mps
    steps = component.shape[1]  # enough for those that are sampled
    horizons = torch.tensor([min(one.horizon, steps) for one in agents.agents], device=agent.device)
    sampled = networks.decoder.sample(prepared, agent, modes, component, normal, limit, horizons)
    angle = turn * (2.0 * math.pi)
    any_axis = torch.stack([angle.cos(), angle.sin()], dim=-1)
    axis = model.features.frame(agents.motion)[agent]
    axis = torch.where(without_direction(model, agents.motion)[agent].unsqueeze(-1), any_axis, axis)
    offsets = integrate(sampled, model.config.dt_s) * agent_type.speed_scale_mps
    return from_frame(offsets, axis.unsqueeze(1))
