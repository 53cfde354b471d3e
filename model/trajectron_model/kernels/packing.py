"""Weights in the order in which the kernels read them, kept until the weights change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from trajectron_model.kernels.loading import Kernels, kernels

PANEL_VECTORS = 4
"""As in simd.h."""

Module = TypeVar("Module", bound=nn.Module)
Packed = TypeVar("Packed")
_Version = tuple[tuple[int, int], ...]


class PackedWeights(Generic[Module, Packed]):
    """What is made of a module's weights, made again once they have changed.

    A change is seen by where a weight lies and by torch's count of changes in place; writing
    through ``.data`` escapes both.

    Args:
        weights: those that it is made of.
        pack: makes it, from a module and the library.
    """

    def __init__(
        self,
        weights: Callable[[Module], tuple[Tensor, ...]],
        pack: Callable[[Module, Kernels], Packed],
    ) -> None:
        self._weights = weights
        self._pack = pack
        self._kept: WeakKeyDictionary[Module, tuple[_Version, Packed]] = WeakKeyDictionary()

    def of(self, module: Module, library: Kernels) -> Packed:
        """The module's weights, packed."""
        version = tuple((w.data_ptr(), _changes(w)) for w in self._weights(module))
        kept = self._kept.get(module)
        if kept is None or kept[0] != version:
            kept = (version, self._pack(module, library))
            self._kept[module] = kept
        return kept[1]


def _changes(weight: Tensor) -> int:
    return 0 if weight.is_inference() else weight._version  # noqa: SLF001 -- torch's counter


def library_for(*tensors: Tensor) -> Kernels | None:
    """The library, if it can work on these weights and inputs: None where torch must.

    Kernels compute values only (no gradients), in float32, on the processor.
    """
    library = kernels()
    if library is None or torch.is_grad_enabled():
        return None
    fits = all(t.dtype is torch.float32 and t.is_cpu for t in tensors)
    return library if fits else None


def panels(weight: Tensor, lanes: int) -> Tensor:
    """Weights [columns, depth] as panels [P, depth, PANEL_VECTORS * lanes], zeros at the end."""
    columns, depth = weight.shape
    width = PANEL_VECTORS * lanes
    padded = weight.new_zeros(-(-columns // width) * width, depth)
    padded[:columns] = weight.detach()
    return padded.reshape(-1, width, depth).transpose(1, 2).contiguous()


def padded(bias: Tensor, lanes: int) -> Tensor:
    """A bias [columns] as long as its panels are wide together."""
    width = PANEL_VECTORS * lanes
    longer = bias.new_zeros(-(-bias.numel() // width) * width)
    longer[: bias.numel()] = bias.detach()
    return longer
