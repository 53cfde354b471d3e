"""The agents of several scenes beside each other: what forecasts read of states.

Shape letters: N agents of all scenes, K node types.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trajectron_model.encoders import EncoderState
from trajectron_model.features import Kinematics
from trajectron_model.state import SceneState


class SceneRows(NamedTuple):
    """N rows, scene by scene; ids may repeat between scenes."""

    ids: tuple[tuple[str, ...], ...]  # of each scene
    node_type: NDArray[np.int64]  # [N]
    motion: Kinematics  # of N nodes
    encoder: EncoderState  # of N nodes
    influence: Tensor  # [N, K]

    @property
    def firsts(self) -> list[int]:
        """The row of each scene's first agent, and behind the last one's last."""
        firsts = [0]
        for ids in self.ids:
            firsts.append(firsts[-1] + len(ids))
        return firsts


def rows_of(states: Sequence[SceneState]) -> SceneRows:
    """The rows of scenes, at least one."""
    motion = zip(*(state.motion for state in states), strict=True)
    encoder = zip(*(state.encoder for state in states), strict=True)
    return SceneRows(
        ids=tuple(state.ids for state in states),
        node_type=torch.cat([state.node_type for state in states]).cpu().numpy(),
        motion=Kinematics(*map(torch.cat, motion)),
        encoder=EncoderState(*map(torch.cat, encoder)),
        influence=torch.cat([state.influence for state in states]),
    )
