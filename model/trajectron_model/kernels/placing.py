"""Modes in position space by ``placing.c``; ``modes.place`` is the reference.

Shape letters: N nodes, Z latent values, R rollouts, H horizon steps.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from trajectron_model.config import Dispersion
from trajectron_model.kernels.packing import library_for

if TYPE_CHECKING:
    from trajectron_model.modes import Rollouts


class _ModesStruct(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("modes", "horizon", "steps")),
        *((name, ctypes.c_void_p) for name in ("velocity", "increment", "row", "weight")),
        *((name, ctypes.c_void_p) for name in ("axis", "turned", "dispersion")),
        ("unit", ctypes.c_float),
    )


def place(
    rollouts: Rollouts, unit_m: float, dispersion: Sequence[Dispersion]
) -> tuple[Tensor, Tensor] | None:
    """``modes.place`` by the kernel; None where torch has to do it.

    Raises:
        IndexError: a row that no rollout has: the kernel would read beyond.
    """
    velocity, increment, row, probability, axis, turned = rollouts
    library = library_for(velocity, increment, probability, axis)
    if library is None:
        return None
    nodes, modes = row.shape
    rolled, horizon = velocity.shape[:2]
    mean = velocity.new_empty(nodes, modes, horizon, 2)
    covariance = velocity.new_empty(nodes, modes, horizon, 3)
    if not mean.numel():
        return mean, covariance
    assert increment.shape == (rolled, horizon, 3)
    assert probability.shape == row.shape and axis.shape == (nodes, 2) and turned.shape == (nodes,)
    assert row.dtype == torch.int64 and turned.dtype == torch.bool
    if row.min() < 0 or row.max() >= rolled:
        raise IndexError(f"modes must be rows of {rolled}")
    steps = -(-horizon // library.lanes) * library.lanes
    table = _table(dispersion, steps)
    given = [
        None if column is None else column.contiguous()
        for column in (velocity, increment, row, probability, axis, turned, table)
    ]
    asked = _ModesStruct(
        *(modes, horizon, steps),
        *(None if column is None else column.data_ptr() for column in given),
        unit_m,
    )
    needed = library.library.trajectron_place_workspace
    needed.restype = ctypes.c_int64
    space = velocity.new_empty(needed(ctypes.byref(asked)))
    library.library.trajectron_place_modes(
        ctypes.byref(asked),
        *(ctypes.c_void_p(out.data_ptr()) for out in (mean, covariance)),
        *(ctypes.c_int64(0), ctypes.c_int64(nodes)),
        ctypes.c_void_p(space.data_ptr()),
    )
    return mean, covariance


def _table(dispersion: Sequence[Dispersion], steps: int) -> Tensor | None:
    """Factors and contrasts [2, steps]; the last holds beyond."""
    if not dispersion:
        return None
    wanted = [dispersion[min(t, len(dispersion) - 1)] for t in range(steps)]
    return torch.tensor(wanted, dtype=torch.float32).T
