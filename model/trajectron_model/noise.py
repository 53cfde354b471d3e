"""Noise keyed by (seed, agent, step): a counter-based generator (Salmon et al. 2011).

The same request gives an agent the same samples whatever else is in the scene or batch,
in whatever order agents stand, on whichever machine. Asking for another number of samples
or steps is another request: fewer samples are not the first of more. Whoever wants the first of
more draws the noise of all and takes its part (``ForecastRequest.run``); of stratified samples
that is a random part, each with the same distribution, spread less evenly than as many asked for.

An agent's samples go together in one of two ways. Each sample alone has exactly the same
distribution in both, so estimates from samples are unbiased in both; agents are independent.

* ``iid``: independent of each other.
* ``stratified``: spread evenly over the distribution, so that a few samples cover more of it.
  Latent values come by systematic sampling: S points 1/S apart, shifted at random, so that each
  is drawn as often as its probability says, to within one sample. Every other number is a Latin
  hypercube (McKay et al. 1979): one sample in each S-th of its range. The two numbers that move
  the end of a path the most are spread evenly together, and under each latent value: their
  S-ths are taken in the order of a Kronecker sequence (Richtmyer 1951).
"""

from __future__ import annotations

import functools
import hashlib
import struct
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Sampling = Literal["iid", "stratified"]
SAMPLINGS: tuple[str, ...] = get_args(Sampling)

Float64 = NDArray[np.float64]

_KRONECKER = np.sqrt([2.0, 3.0])
# Samples whose noise is stratified at once: few enough to stay in the processor's cache.
_TOGETHER = 2000
_TINY = np.finfo(np.float64).tiny
_BELOW_ONE = 1.0 - np.finfo(np.float64).epsneg
_BELOW_ONE_FLOAT32 = np.float32(1.0) - np.finfo(np.float32).epsneg


class AgentNoise(NamedTuple):
    """The random numbers of agents' samples; of one agent without the axis A."""

    latent: NDArray[np.float32]  # [A, S] uniform: chooses z
    turn: NDArray[np.float32]  # [A, S] uniform: the direction of an agent without a heading
    component: NDArray[np.float32]  # [A, S, H] uniform: chooses mixture components
    normal: NDArray[np.float32]  # [A, S, H, 2] standard normal


def agent_noise(
    seed: int, agent_id: str, step: int, samples: int, horizon: int, sampling: Sampling = "iid"
) -> AgentNoise:
    """Draws one agent's noise; see `scene_noise`."""
    drawn = scene_noise(seed, (agent_id,), step, samples, horizon, sampling)
    return AgentNoise(*(column[0] for column in drawn))


def scene_noise(
    seed: int,
    agent_ids: Sequence[str],
    step: int,
    samples: int,
    horizon: int,
    sampling: Sampling = "iid",
) -> AgentNoise:
    """Draws the noise of agents, each as if it were alone.

    Args:
        seed: of the request, 0 <= seed < 2**63.
        agent_ids: [A] the client's ids, at least one.
        step: of the session: its count of accepted frames.
        samples: S.
        horizon: H.
        sampling: how the samples of one agent go together; see the module.
    """
    generators = [_generator(seed, agent_id, step) for agent_id in agent_ids]
    if sampling == "iid":
        drawn = [_independent(generator, samples, horizon) for generator in generators]
    else:
        together = max(1, _TOGETHER // samples)
        runs = (generators[i : i + together] for i in range(0, len(generators), together))
        drawn = [_stratified(run, samples, horizon) for run in runs]
    return AgentNoise(*(np.concatenate(column) for column in zip(*drawn, strict=True)))


def _generator(seed: int, agent_id: str, step: int) -> np.random.Generator:
    digest = hashlib.blake2b(
        struct.pack("<QQ", seed, step) + agent_id.encode("utf-8", "surrogatepass"), digest_size=16
    ).digest()
    key = np.frombuffer(digest, dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


def _independent(generator: np.random.Generator, samples: int, horizon: int) -> AgentNoise:
    uniform = generator.random((1, samples, 2 + horizon), dtype=np.float32)
    normal = generator.standard_normal((1, samples, horizon, 2), dtype=np.float32)
    return AgentNoise(uniform[..., 0], uniform[..., 1], uniform[..., 2:], normal)


def _stratified(
    generators: Sequence[np.random.Generator], samples: int, horizon: int
) -> AgentNoise:
    """Numbers are rows [A, R, S], samples columns, until they are handed back."""
    others = 1 + horizon + 2 * (horizon - 1)  # turn, components, normals but the leading two
    numbers = 1 + 3 * horizon
    uniform = np.stack(
        [generator.random(3 + (1 + others + numbers) * samples) for generator in generators]
    )
    shift, keys, place = np.split(uniform, [3, 3 + (1 + others) * samples], axis=1)
    order = keys.reshape(-1, 1 + others, samples).argsort(axis=2)
    point = order[:, 0]  # [A, S] a sample's place along the sequence
    latent = (point + shift[:, :1]) / samples
    turns = np.floor(shift[:, 1:, None] * samples).astype(np.int64)  # [A, 2, 1]
    leading = (np.moveaxis(_sequence(samples)[:, point], 0, 1) + turns) % samples  # [A, 2, S]
    strata = np.concatenate([order[:, 1 : 2 + horizon], leading, order[:, 2 + horizon :]], axis=1)
    even = (strata + place.reshape(strata.shape)) / samples  # [A, 1 + 3 H, S]
    normal = ndtri(even[:, 1 + horizon :].clip(_TINY, _BELOW_ONE))
    normal = _leading_first(normal.reshape(-1, horizon, 2 * samples))
    return AgentNoise(
        _below_one(latent),
        _below_one(even[:, 0]),
        _below_one(even[:, 1 : 1 + horizon].transpose(0, 2, 1)),
        normal.reshape(-1, horizon, 2, samples)
        .transpose(0, 3, 1, 2)
        .astype(np.float32),  # [A, S, H, 2]
    )


@functools.lru_cache(maxsize=64)
def _sequence(samples: int) -> NDArray[np.int64]:
    """[2, S] the S-ths of two numbers' ranges in which points of a Kronecker sequence lie.

    Their ranks, so that each S-th is taken once: for small S the sequence itself comes back
    too near to where it was.
    """
    points = np.outer(_KRONECKER, np.arange(samples)) % 1.0
    ranks = points.argsort(axis=1).argsort(axis=1)
    ranks.flags.writeable = False
    return ranks


def _leading_first(normal: Float64) -> Float64:
    """Turns standard normals [A, H, ...] so that the first moves the end of a path the most.

    Step t's change of velocity counts in the H - t + 1 positions from t on. The normals are
    reflected (Householder 1958) so that their sum with these weights is the first number alone;
    a reflection leaves them independent and standard.
    """
    weights = np.arange(normal.shape[1], 0.0, -1.0)
    mirror = weights / np.linalg.norm(weights)
    mirror[0] -= 1.0
    scale = 2.0 / max(float(mirror @ mirror), float(_TINY))  # H = 1: nothing to reflect
    along = np.einsum("h,ahi->ai", mirror, normal)[:, None, :]
    reflected: Float64 = normal - scale * mirror[:, None] * along
    return reflected


def _below_one(uniform: Float64) -> NDArray[np.float32]:
    """As float32, which would round the largest values up to one."""
    return np.minimum(uniform.astype(np.float32), _BELOW_ONE_FLOAT32)
