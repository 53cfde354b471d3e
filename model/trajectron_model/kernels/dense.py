"""A linear layer whose rows do not depend on each other to the last bit.

A library's matrix product may add up in another order for another number of rows; here a
row's result is the same whatever stands beside it.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

from torch import Tensor, nn

from trajectron_model.kernels.loading import Kernels
from trajectron_model.kernels.packing import PackedWeights, library_for, padded, panels


@dataclass(frozen=True)
class _Dense:
    weight: Tensor  # [P, depth, width of a panel]
    bias: Tensor  # [P x width]
    columns: int


def linear(layer: nn.Linear, inputs: Tensor) -> Tensor:
    """``layer(inputs)`` for inputs [N, depth]; by torch where kernels cannot."""
    library = library_for(layer.weight, inputs)
    if library is None:
        outputs: Tensor = layer(inputs)
        return outputs
    packed = _PACKED.of(layer, library)
    inputs = inputs.contiguous()
    rows, depth = inputs.shape
    if depth != layer.in_features:
        raise ValueError(f"inputs have {depth} columns, the layer takes {layer.in_features}")
    out = inputs.new_empty(rows, packed.columns)
    library.library.trajectron_dense(
        ctypes.c_long(rows),
        ctypes.c_long(depth),
        ctypes.c_long(packed.columns),
        ctypes.c_void_p(inputs.data_ptr()),
        ctypes.c_void_p(packed.weight.data_ptr()),
        ctypes.c_void_p(packed.bias.data_ptr()),
        ctypes.c_void_p(out.data_ptr()),
    )
    return out


def _weights(layer: nn.Linear) -> tuple[Tensor, ...]:
    given: Tensor | None = layer.bias
    return (layer.weight,) if given is None else (layer.weight, given)


def _pack(layer: nn.Linear, library: Kernels) -> _Dense:
    weight = layer.weight
    given: Tensor | None = layer.bias
    bias = weight.new_zeros(weight.shape[0]) if given is None else given
    return _Dense(panels(weight, library.lanes), padded(bias, library.lanes), weight.shape[0])


_PACKED = PackedWeights(_weights, _pack)
