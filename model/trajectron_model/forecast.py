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
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
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
from trajectron_model.state import SceneState, stack

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

    Raises:
        ValueError: a number out of its bounds.
    """

    mode: Literal["full", "z_best", "gmm"] = "full"
    num_samples: int = 20
    horizon: int = 12
    seed: int = 0
    step: int = 0
    agents: tuple[str, ...] | None = None
    include_modes: bool = False
    sampling: Sampling = "iid"

    def __post_init__(self) -> None:
        if self.mode not in ("full", "z_best", "gmm"):
            raise ValueError(f"mode {self.mode!r} is none of full, z_best, gmm")
        if self.sampling not in SAMPLINGS:
            raise ValueError(f"sampling {self.sampling!r} is none of {', '.join(SAMPLINGS)}")
        if not 1 <= self.num_samples <= MAX_SAMPLES:
            raise ValueError(f"num_samples must be 1 to {MAX_SAMPLES}")
        if not 1 <= self.horizon <= MAX_HORIZON:
            raise ValueError(f"horizon must be 1 to {MAX_HORIZON} steps")
        if not (0 <= self.seed < 2**63 and 0 <= self.step < 2**63):
            raise ValueError("seed and step must lie in 0 .. 2**63 - 1")

    @property
    def samples(self) -> int:
        """How many samples are drawn: none for ``gmm``."""
        return 0 if self.mode == "gmm" else self.num_samples

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


class _Agents(NamedTuple):
    """B agents of one type that are decoded together over one horizon."""

    encoding: Tensor  # [B, D]
    motion: Kinematics
    log_prior: Tensor  # [B, Z]
    keys: list[tuple[int, int]]  # (request, position in its forecast)
    ids: list[str]


def forecast_scenes(
    model: Trajectron, states: Sequence[SceneState], requests: Sequence[ForecastRequest]
) -> list[SceneForecast]:
    """The futures that each request asks of its state; see ``Trajectron.forecast``."""
    if not states:
        return []
    with torch_alone():
        return _forecast_scenes(model, states, requests)


def _forecast_scenes(
    model: Trajectron, states: Sequence[SceneState], requests: Sequence[ForecastRequest]
) -> list[SceneForecast]:
    picked = [_rows(model, s, r) for s, r in zip(states, requests, strict=True)]
    results = [
        _blank(model, s, r, rows) for s, r, rows in zip(states, requests, picked, strict=True)
    ]
    for (kind, horizon), agents in _groups(model, states, requests, picked).items():
        for (request, at), row in zip(
            agents.keys, agents.log_prior.exp().cpu().numpy(), strict=True
        ):
            results[request].mode_probabilities[at] = row
        _fill_modes(model, kind, horizon, agents, requests, results)
        _fill_samples(model, kind, horizon, agents, requests, results)
    return results


def _rows(model: Trajectron, state: SceneState, request: ForecastRequest) -> list[int]:
    if request.agents is None:
        stationary = [t.stationary for t in model.config.types]
        return [row for row, kind in enumerate(state.node_type.tolist()) if not stationary[kind]]
    row_of = {agent: row for row, agent in enumerate(state.ids)}
    unknown = [agent for agent in request.agents if agent not in row_of]
    if unknown:
        raise KeyError(f"no agent {unknown[0]!r} in the scene")
    return [row_of[agent] for agent in request.agents]


def _blank(
    model: Trajectron, state: SceneState, request: ForecastRequest, rows: list[int]
) -> SceneForecast:
    """A forecast whose arrays are still to be filled."""
    agents, values, horizon = len(rows), model.config.latent_values, request.horizon
    names = model.config.node_types
    index = torch.tensor(rows, dtype=torch.int64, device=state.node_type.device)
    shape = (agents, values, horizon)
    return SceneForecast(
        ids=tuple(state.ids[row] for row in rows),
        types=tuple(names[kind] for kind in state.node_type[index].tolist()),
        position=state.motion.position[index].cpu().numpy(),
        last_seen_s=state.motion.last_seen_s[index].cpu().numpy(),
        observations=state.motion.observations[index].cpu().numpy(),
        heading_known=state.motion.heading_known[index].cpu().numpy(),
        mode_probabilities=np.zeros((agents, values), dtype=np.float32),
        mean=np.zeros((*shape, 2), dtype=np.float32) if request.modes else None,
        covariance=np.zeros((*shape, 3), dtype=np.float32) if request.modes else None,
        samples=(
            np.zeros((agents, request.samples, horizon, 2), dtype=np.float32)
            if request.samples
            else None
        ),
        sample_modes=(
            np.zeros((agents, request.samples), dtype=np.int64) if request.samples else None
        ),
    )


def _groups(
    model: Trajectron,
    states: Sequence[SceneState],
    requests: Sequence[ForecastRequest],
    picked: list[list[int]],
) -> dict[tuple[int, int], _Agents]:
    """Agents of all requests by (type, horizon), encoded."""
    stacked = stack(states)
    kinds = stacked.node_type.tolist()
    members: dict[tuple[int, int], list[tuple[int, int, int]]] = defaultdict(list)
    first = 0
    for number, (state, request, rows) in enumerate(zip(states, requests, picked, strict=True)):
        for at, row in enumerate(rows):
            members[kinds[first + row], request.horizon].append((number, at, first + row))
        first += len(state.ids)
    groups = {}
    for (kind, horizon), found in members.items():
        index = torch.tensor([row for _, _, row in found], device=stacked.node_type.device)
        networks = model.node_model(kind)
        encoding = networks.encoding(
            EncoderState(*(column[index] for column in stacked.encoder)), stacked.influence[index]
        )
        groups[kind, horizon] = _Agents(
            encoding=encoding,
            motion=Kinematics(*(column[index] for column in stacked.motion)),
            log_prior=_prior(networks, encoding, [requests[number] for number, _, _ in found]),
            keys=[(number, at) for number, at, _ in found],
            ids=[stacked.ids[row] for _, _, row in found],
        )
    return groups


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
    horizon: int,
    agents: _Agents,
    requests: Sequence[ForecastRequest],
    results: list[SceneForecast],
) -> None:
    wanted = [i for i, (number, _) in enumerate(agents.keys) if requests[number].modes]
    if not wanted:
        return
    index = torch.tensor(wanted, device=agents.encoding.device)
    motion = Kinematics(*(column[index] for column in agents.motion))
    mean, covariance = mode_moments(
        model, kind, agents.encoding[index], agents.log_prior[index], motion, horizon
    )
    means, covariances = mean.cpu().numpy(), covariance.cpu().numpy()
    for row, i in enumerate(wanted):
        number, at = agents.keys[i]
        result = results[number]
        assert result.mean is not None and result.covariance is not None
        result.mean[at], result.covariance[at] = means[row], covariances[row]


def _fill_samples(
    model: Trajectron,
    kind: int,
    horizon: int,
    agents: _Agents,
    requests: Sequence[ForecastRequest],
    results: list[SceneForecast],
) -> None:
    wanted = [i for i, (number, _) in enumerate(agents.keys) if requests[number].samples]
    if not wanted:
        return
    device = agents.encoding.device
    latent, turn, component, normal = _noise(wanted, agents, requests, horizon)
    counts = [requests[agents.keys[i][0]].samples for i in wanted]
    best = [requests[agents.keys[i][0]].mode == "z_best" for i in wanted]
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
        number, at = agents.keys[i]
        result = results[number]
        assert result.samples is not None and result.sample_modes is not None
        result.samples[at] = values[last - count : last]
        result.sample_modes[at] = latents[last - count : last]


def _noise(
    wanted: Sequence[int], agents: _Agents, requests: Sequence[ForecastRequest], horizon: int
) -> list[Tensor]:
    """Latent [R], turn [R], component [R, H] and normal [R, H, 2] of all samples of agents."""
    drawn = []
    for number, rows in groupby(wanted, key=lambda i: agents.keys[i][0]):
        asked, ids = requests[number], [agents.ids[i] for i in rows]
        drawn.append(
            scene_noise(asked.seed, ids, asked.step, asked.samples, horizon, asked.sampling)
        )
    columns = [
        np.concatenate([part.reshape(-1, *part.shape[2:]) for part in column])  # [R, ...]
        for column in zip(*drawn, strict=True)
    ]
    return [torch.from_numpy(column).to(agents.encoding.device) for column in columns]


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
    sampled = networks.decoder.sample(prepared, agent, modes, component, normal, limit)
    angle = turn * (2.0 * math.pi)
    any_axis = torch.stack([angle.cos(), angle.sin()], dim=-1)
    axis = model.features.frame(agents.motion)[agent]
    axis = torch.where(without_direction(model, agents.motion)[agent].unsqueeze(-1), any_axis, axis)
    offsets = integrate(sampled, model.config.dt_s) * agent_type.speed_scale_mps
    return from_frame(offsets, axis.unsqueeze(1))
