"""What the learned baselines see: a few steps of a scene, many scenes stacked as tensors.

Positions are relative to a point of the scene, so that float32 holds them wherever it lies;
what a network reads is displacements and differences between agents, so its forecasts move with
the scene. An agent enters with displacement zero at the first step it is seen (as in the public
code of Social GAN); one that was missing comes back with its mean displacement a step since.

Shape letters: T steps, N agents of all scenes, A judged agents.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajectron_model.data.windows import Window

MEMORY_STEPS = 8
"""Observed steps that a learned baseline looks at: as many as they were published with."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The newest observed steps of one window, and the steps after them where asked for.

    Attributes:
        position: [T, N, 2] metres, relative to ``origin``; NaN where absent. N are the agents
            seen in the observed steps, judged or context.
        judged: [A] columns of the judged agents.
        origin: [2] metres, world: the mean of the judged agents' newest positions.
    """

    position: NDArray[np.float64]
    judged: NDArray[np.int64]
    origin: NDArray[np.float64]

    def last_observed(self) -> NDArray[np.float64]:
        """[A, 2] metres, world: the newest observed positions of the judged agents."""
        newest: NDArray[np.float64] = self.position[MEMORY_STEPS - 1, self.judged] + self.origin
        return newest

    def around(self, agent: int, count: int) -> Scene:
        """The agent of a column and its nearest at the newest observed step, ``count`` in all.

        Those who are absent then come last.
        """
        newest = self.position[MEMORY_STEPS - 1]  # [N, 2]
        distance = np.linalg.norm(newest - newest[agent], axis=-1)  # [N], NaN where absent
        kept = np.sort(np.argsort(distance, kind="stable")[:count])
        judged = np.flatnonzero(np.isin(kept, self.judged))
        return Scene(self.position[:, kept], judged, self.origin)


def observed_scene(window: Window, *, context: bool = True, future: bool = False) -> Scene:
    """The last `MEMORY_STEPS` observed steps of a window, padded in front where there are fewer.

    Args:
        window: any; steps before its first are not looked at.
        context: with everyone visible in these steps; otherwise the judged agents only.
        future: the steps to foretell come after them: for training.

    Raises:
        ValueError: a judged agent that is absent at the newest observed step.
    """
    first = max(window.first, window.now + 1 - MEMORY_STEPS)
    observed = window.now + 1 - first
    last = window.now + 1 + (window.horizon if future else 0)
    agents, position = window.recording.dense(first, last)  # [N'], [T', N', 2]
    if context:
        kept = ~np.isnan(position[:observed, :, 0]).all(axis=0)
    else:
        kept = np.isin(agents, window.judged)
    agents, position = agents[kept], position[:, kept]
    judged = np.searchsorted(agents, window.judged)
    found = judged < len(agents)
    found[found] = agents[judged[found]] == window.judged[found]
    if not found.all() or np.isnan(position[observed - 1, judged]).any():
        raise ValueError("a judged agent is absent at the newest observed step")
    origin = position[observed - 1, judged].mean(axis=0)
    padding = np.full((MEMORY_STEPS - observed, len(agents), 2), np.nan)
    return Scene(np.concatenate([padding, position - origin]), judged, origin)


class SceneBatch(NamedTuple):
    """Scenes side by side; T is `MEMORY_STEPS`, or more by the horizon in training."""

    position: Tensor  # [T, N, 2] metres, relative to each scene's origin; 0 where absent
    displacement: Tensor  # [T, N, 2] metres a step since last seen; 0 where absent or just come
    present: Tensor  # [T, N] bool
    scene: Tensor  # [N] int64, ascending
    judged: Tensor  # [A] int64, rows of the judged agents


def stack(scenes: Sequence[Scene]) -> SceneBatch:
    """One batch of scenes that have as many steps."""
    sizes = [scene.position.shape[1] for scene in scenes]
    offsets = np.cumsum([0, *sizes])[:-1]
    position = np.concatenate([scene.position for scene in scenes], axis=1)  # [T, N, 2]
    judged = [scene.judged + offset for scene, offset in zip(scenes, offsets, strict=True)]
    return SceneBatch(
        torch.from_numpy(np.nan_to_num(position)).float(),
        torch.from_numpy(displacements(position)).float(),
        torch.from_numpy(~np.isnan(position[..., 0])),
        torch.from_numpy(np.repeat(np.arange(len(scenes)), sizes)),
        torch.from_numpy(np.concatenate(judged)),
    )


def displacements(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Displacement a step since an agent was last seen; [T, N, 2], NaN where absent, to same.

    Zero where absent or seen for the first time.
    """
    result = np.zeros_like(position)
    last = np.full(position.shape[1:], np.nan)  # [N, 2] newest position so far
    since = np.ones(position.shape[1])  # [N] steps since then
    for step, now in enumerate(position):
        result[step] = np.nan_to_num((now - last) / since[:, None])
        seen = ~np.isnan(now[:, 0])
        last = np.where(seen[:, None], now, last)
        since = np.where(seen, 1.0, since + 1.0)
    return result


class Pairs(NamedTuple):
    """Ordered pairs of different agents of one scene; E of them."""

    receiver: Tensor  # [E] int64, rows of a batch
    sender: Tensor  # [E] int64


def pairs_of(scene: Tensor) -> Pairs:
    """Every ordered pair within each scene, by receiver, then sender.

    ``scene`` is [N], ascending.
    """
    sizes = torch.bincount(scene)  # [scenes]
    size = sizes[scene]  # [N] agents of each one's scene
    begin = (torch.cumsum(sizes, 0) - sizes)[scene]  # [N] the scene's first row
    receiver = torch.repeat_interleave(torch.arange(len(scene)), size)
    first = torch.cumsum(size, 0) - size  # [N] the first pair of each receiver
    place = torch.arange(len(receiver)) - torch.repeat_interleave(first, size)
    sender = begin[receiver] + place
    other = receiver != sender
    return Pairs(receiver[other], sender[other])
