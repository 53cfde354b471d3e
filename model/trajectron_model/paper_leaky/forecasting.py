"""Forecasts of a chunk's people at one step, and their best-of-N errors.

Shape letters: A judged agents, S samples, H horizon steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from trajectron_model.evaluation import metrics
from trajectron_model.paper_leaky.chunks import VELOCITY
from trajectron_model.paper_leaky.inputs import Inputs
from trajectron_model.paper_leaky.network import LeakyNetwork, Scale, integrate
from trajectron_model.paper_leaky.objective import HORIZON

STRIDE = 8
"""Steps between two windows of a chunk, and how many steps before now must be seen."""


class Scene(NamedTuple):
    """People of one chunk, forecast together."""

    chunk: int
    now: int  # the last observed step
    slots: Tensor  # [A]


class Encoded(NamedTuple):
    """What a scene's forecasts begin with."""

    encoding: Tensor  # [A, 40]
    velocity: Tensor  # [A, 2] now's, standardised
    scale: Scale
    origin: Tensor  # [A, 2] metres, world
    dt_s: float


def scenes(inputs: Inputs) -> Iterator[Scene]:
    """The windows of the protocol ``paper``: every eighth step, those seen in nine steps."""
    for chunk, length in enumerate(inputs.lengths.tolist()):
        for first in range(STRIDE, length - HORIZON, STRIDE):
            seen = inputs.present[chunk, first - STRIDE : first + 1].all(dim=0)
            if seen.any():
                yield Scene(chunk, first - 1, seen.nonzero().flatten())


@torch.inference_mode()
def encode(network: LeakyNetwork, inputs: Inputs, scene: Scene) -> Encoded:
    """A scene's people, encoded from all that their chunk's states hold up to now."""
    chunk, now, slots = scene
    history = inputs.states[chunk, : now + 1, slots].transpose(0, 1)  # [A, T, F]
    sums = inputs.sums[chunk, : now + 1, slots].transpose(0, 1)  # [A, T, F]
    lengths = torch.full((len(slots),), now + 1)
    return Encoded(
        network.encode(history, sums, lengths, inputs.mask[chunk, now, slots]),
        inputs.states[chunk, now, slots, VELOCITY],
        Scale(inputs.mean[slots, VELOCITY], inputs.std[slots, VELOCITY]),
        inputs.position[chunk, now, slots],
        inputs.dt_s,
    )


@torch.inference_mode()
def sample(
    network: LeakyNetwork,
    encoded: Encoded,
    *,
    samples: int,
    horizon: int,
    generator: torch.Generator,
    z_best: bool = False,
) -> Tensor:
    """Sampled positions [S, A, H, 2], metres, world."""
    velocity = network.sample(
        encoded.encoding,
        encoded.velocity,
        encoded.scale,
        samples=samples,
        horizon=horizon,
        z_best=z_best,
        generator=generator,
    )
    return integrate(velocity, encoded.dt_s).transpose(0, 1) + encoded.origin[:, None]


@torch.inference_mode()
def modes(network: LeakyNetwork, encoded: Encoded, horizon: int) -> tuple[Tensor, Tensor]:
    """Probabilities [A, 25] and mean positions [A, 25, H, 2], metres, of all values of z."""
    probability, velocity = network.modes(
        encoded.encoding, encoded.velocity, encoded.scale, horizon
    )
    return probability, integrate(velocity, encoded.dt_s) + encoded.origin[:, None, None]


def joint_best_of(
    network: LeakyNetwork, inputs: Inputs, *, samples: int, seed: int, z_best: bool = False
) -> tuple[float, float]:
    """Best-of-N ADE and FDE, metres, over all `scenes`: joint in each scene, a mean per agent."""
    generator = torch.Generator().manual_seed(seed)
    average, final = [], []
    for scene in scenes(inputs):
        futures = sample(
            network,
            encode(network, inputs, scene),
            samples=samples,
            horizon=HORIZON,
            generator=generator,
            z_best=z_best,
        )
        steps = slice(scene.now + 1, scene.now + 1 + HORIZON)
        truth = inputs.position[scene.chunk, steps, scene.slots].transpose(0, 1)  # [A, H, 2]
        known = inputs.present[scene.chunk, steps, scene.slots].T  # [A, H]
        truth = torch.where(known.unsqueeze(-1), truth, torch.nan)
        distance = metrics.displacement(futures.numpy(), truth.double().numpy())
        average.append(metrics.joint_best_of(metrics.average_displacement(distance), samples))
        final.append(metrics.joint_best_of(metrics.final_displacement(distance), samples))
    return float(np.concatenate(average).mean()), float(np.concatenate(final).mean())
