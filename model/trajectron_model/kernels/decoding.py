"""Rollouts of a decoder by ``decode.c``; the torch code beside ``Decoder.sample`` is the reference.

Shape letters as in ``shapes``.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from trajectron_model.kernels.fixed_point import FixedRows, fixed_rows
from trajectron_model.kernels.loading import Kernels
from trajectron_model.kernels.packing import PANEL_VECTORS, PackedWeights, library_for
from trajectron_model.kernels.threads import share

if TYPE_CHECKING:
    from trajectron_model.decoder import Decoder, Prepared

# As in decode.c: how many vectors of logits are made at once, and gates as powers of two.
_LOGIT_VECTORS = 2
_GATE_SCALE = (-1.0 / math.log(2.0),) * 3 + (2.0 / math.log(2.0),)
# Fewer rows are not worth waking a thread for.
_LEAST_ROWS = 24
# A logit so low that a component that only fills a vector has no weight.
_NO_WEIGHT = -1e30


class _DecoderStruct(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("size", "units", "components", "padded")),
        *((name, ctypes.c_int64) for name in ("logits", "outputs")),
        *((f"recurrent{part}", ctypes.c_void_p) for part in ("", "_scale", "_velocity")),
        ("gates_latent", ctypes.c_void_p),
        ("start_latent", ctypes.c_void_p),
        *((f"logit_{part}", ctypes.c_void_p) for part in ("weight", "scale", "bias")),
        *((f"chosen_{part}", ctypes.c_void_p) for part in ("weight", "scale", "bias")),
        *((f"head_{part}", ctypes.c_void_p) for part in ("weight", "scale", "bias")),
        ("log_sigma_min", ctypes.c_float),
        ("log_sigma_span", ctypes.c_float),
    )


class _RolloutsStruct(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("gates", "state", "velocity")),
        *((name, ctypes.c_void_p) for name in ("order", "agent", "latent", "horizons")),
        ("horizon", ctypes.c_int64),
        ("limit", ctypes.c_float),
    )


@dataclass(frozen=True)
class _Packed:
    """A decoder's weights in the kernel's order; ``tensors`` keeps alive what it points to."""

    struct: _DecoderStruct
    tensors: tuple[Tensor, ...]
    workspace_bytes: int


class _Asked(NamedTuple):
    """Rollouts, as ``Decoder.sample`` is told of them."""

    prepared: Prepared
    agent: Tensor  # [R]
    latent: Tensor  # [R]
    horizons: Tensor  # [N]
    limit: float


def sample(
    decoder: Decoder,
    prepared: Prepared,
    agent: Tensor,
    latent: Tensor,
    uniform: Tensor,
    normal: Tensor,
    limit: float,
    horizons: Tensor,
) -> Tensor | None:
    """``Decoder.sample`` by the kernel; None where torch has to do it."""
    library = library_for(decoder.head.weight, *prepared, uniform, normal)
    if library is None:
        return None
    rows, horizon = uniform.shape
    assert normal.shape == (rows, horizon, 2)
    uniform, normal = uniform.contiguous(), normal.contiguous()
    out = torch.zeros_like(normal)
    function = library.library.trajectron_decode_sample
    pointers = [_pointer(t) for t in (uniform, normal, out)]
    asked = _Asked(prepared, agent, latent, horizons, limit)
    _run(decoder, library, asked, horizon, function, pointers)
    return out


def moments(
    decoder: Decoder,
    prepared: Prepared,
    agent: Tensor,
    latent: Tensor,
    horizons: Tensor,
    limit: float,
) -> tuple[Tensor, Tensor] | None:
    """``Decoder.moments`` by the kernel; None where torch has to do it."""
    library = library_for(decoder.head.weight, *prepared)
    if library is None:
        return None
    horizon = int(horizons.max()) if horizons.numel() else 0
    means = prepared.velocity.new_zeros(len(agent), horizon, 2)
    covariances = prepared.velocity.new_zeros(len(agent), horizon, 3)
    function = library.library.trajectron_decode_moments
    pointers = [_pointer(means), _pointer(covariances)]
    asked = _Asked(prepared, agent, latent, horizons, limit)
    _run(decoder, library, asked, horizon, function, pointers)
    return means, covariances


def products(decoder: Decoder, rows: int, steps: int) -> Callable[[], None] | None:
    """The bare products of so many rollouts, to be timed; None where there is no kernel."""
    library = library_for(decoder.head.weight)
    if library is None:
        return None
    packed = _PACKED.of(decoder, library)

    def run() -> None:
        _space, workspace = _workspace(packed)  # the memory lives as long as its name
        library.library.trajectron_decode_products(
            ctypes.byref(packed.struct), ctypes.c_int64(rows), ctypes.c_int64(steps), workspace
        )

    return run


def _workspace(packed: _Packed) -> tuple[np.ndarray, ctypes.c_void_p]:
    """Memory for one call, and where in it to begin."""
    space = np.empty(packed.workspace_bytes + 64, dtype=np.uint8)
    return space, ctypes.c_void_p(-space.ctypes.data % 64 + space.ctypes.data)


def _run(
    decoder: Decoder,
    library: Kernels,
    asked: _Asked,
    horizon: int,
    function: Callable[..., None],
    arrays: list[ctypes.c_void_p],
) -> None:
    """Calls the kernel on all rows, shared among threads.

    Raises:
        IndexError: an agent, a latent value or a number of steps out of range: the kernel would
            read beyond.
    """
    prepared = asked.prepared
    agents, latents = asked.agent.contiguous().numpy(), asked.latent.contiguous().numpy()
    values = decoder.gates_latent.num_embeddings
    if not agents.size:
        return
    if agents.min() < 0 or agents.max() >= len(prepared.velocity):
        raise IndexError(f"agents must be rows of {len(prepared.velocity)}")
    if latents.min() < 0 or latents.max() >= values:
        raise IndexError(f"latent values must lie in 0 .. {values - 1}")
    horizons = asked.horizons.contiguous().numpy()
    assert horizons.dtype == np.int64
    if horizons.shape != (len(prepared.velocity),) or horizons.max() > horizon:
        raise IndexError(f"each agent has a number of steps, at most {horizon}")
    gates, state, velocity = (column.contiguous() for column in prepared)
    assert gates.shape[1] == 4 * decoder.size and state.shape[1] == 2 * decoder.size
    order = _order(agents * values + latents, len(prepared.velocity) * values)
    packed = _PACKED.of(decoder, library)
    rollouts = _RolloutsStruct(
        gates.data_ptr(),
        state.data_ptr(),
        velocity.data_ptr(),
        order.ctypes.data,
        agents.ctypes.data,
        latents.ctypes.data,
        horizons.ctypes.data,
        horizon,
        asked.limit,
    )

    def work(first: int, last: int) -> None:
        _space, workspace = _workspace(packed)  # the memory lives as long as its name
        span = (ctypes.c_int64(first), ctypes.c_int64(last), workspace)
        function(ctypes.byref(packed.struct), ctypes.byref(rollouts), *arrays, *span)

    share(len(order), _LEAST_ROWS, work)


def _order(key: np.ndarray, keys: int) -> np.ndarray:
    """Rows [R] so that equal keys stand together; numpy sorts small integers quicker."""
    small = key.astype(np.uint16) if keys <= 1 << 16 else key
    return np.argsort(small, kind="stable").astype(np.int64, copy=False)


def _pointer(tensor: Tensor) -> ctypes.c_void_p:
    return ctypes.c_void_p(tensor.data_ptr())


def _weights(decoder: Decoder) -> tuple[Tensor, ...]:
    return (
        decoder.recurrent.weight,
        decoder.gates_latent.weight,
        decoder.start_latent.weight,
        decoder.head.weight,
        decoder.head.bias,
    )


def _pack(decoder: Decoder, library: Kernels) -> _Packed:
    lanes = library.lanes
    size, components = decoder.size, decoder.components
    units, many = _up(size, 2 * lanes), _up(components, lanes)
    logits = _up(components, _LOGIT_VECTORS * lanes)
    weight, bias = decoder.head.weight.detach(), decoder.head.bias.detach()
    chosen = fixed_rows(_wide(weight[components:], units))
    head, head_bias = _by_kind(weight, bias, units, _up(6 * many, PANEL_VECTORS * lanes), many)
    recurrent, velocity = _recurrent(decoder, units, lanes)
    tensors = (
        *_panels(fixed_rows(recurrent), PANEL_VECTORS, lanes),
        velocity,
        _gates_by_panel(decoder.gates_latent.weight.detach(), size, units, lanes),
        _wide(decoder.start_latent.weight.detach().reshape(-1, size), units),
        *_panels(
            fixed_rows(_tall(_wide(weight[:components], units), logits)), _LOGIT_VECTORS, lanes
        ),
        _tall(bias[:components], logits, _NO_WEIGHT),
        *chosen,
        bias[components:].contiguous(),
        *_panels(fixed_rows(head), PANEL_VECTORS, lanes),
        head_bias,
    )
    struct = _DecoderStruct(
        *(size, units, components, many, logits, len(head)),
        *(tensor.data_ptr() for tensor in tensors),
        decoder.log_sigma_min,
        decoder.log_sigma_max - decoder.log_sigma_min,
    )
    needed = library.library.trajectron_decode_workspace
    needed.restype = ctypes.c_int64
    return _Packed(struct, tensors, needed(ctypes.byref(struct)))


def _recurrent(decoder: Decoder, units: int, lanes: int) -> tuple[Tensor, Tensor]:
    """h -> gates [4 units, units] and y -> gates [units / lanes, 2, 4, lanes].

    Rows go by panels: ``lanes`` hidden units of each gate beside each other; gates are powers
    of two.
    """
    given = decoder.recurrent.weight.detach().reshape(PANEL_VECTORS, decoder.size, -1)
    given = given * given.new_tensor(_GATE_SCALE)[:, None, None]
    gates = given.new_zeros(PANEL_VECTORS, units, 2 + units)
    gates[:, : decoder.size, : 2 + decoder.size] = given
    by_panel = gates.reshape(PANEL_VECTORS, -1, lanes, 2 + units).transpose(0, 1)
    velocity = by_panel[..., :2].permute(0, 3, 1, 2).contiguous()
    return by_panel[..., 2:].reshape(-1, units), velocity


def _gates_by_panel(gates: Tensor, size: int, units: int, lanes: int) -> Tensor:
    """Gates [Z, 4 size] as powers of two, [Z, units / lanes, 4, lanes]."""
    wide = gates.new_zeros(len(gates), PANEL_VECTORS, units)
    wide[..., :size] = gates.reshape(len(gates), PANEL_VECTORS, size)
    wide = wide * wide.new_tensor(_GATE_SCALE)[:, None]
    return wide.reshape(len(gates), PANEL_VECTORS, -1, lanes).transpose(1, 2).contiguous()


def _by_kind(
    weight: Tensor, bias: Tensor, units: int, outputs: int, many: int
) -> tuple[Tensor, Tensor]:
    """The head's rows as six kinds of ``many`` each: [outputs, units] and [outputs]."""
    components = weight.shape[0] // 6
    kinds, kind_bias = weight.new_zeros(6, many, units), bias.new_zeros(6, many)
    kinds[0, :components, : weight.shape[1]] = weight[:components]
    kind_bias[0] = _NO_WEIGHT
    kind_bias[0, :components] = bias[:components]
    rest = weight[components:].reshape(components, 5, -1)
    kinds[1:, :components, : weight.shape[1]] = rest.transpose(0, 1)
    kind_bias[1:, :components] = bias[components:].reshape(components, 5).T
    return _tall(kinds.flatten(0, 1), outputs), _tall(kind_bias.flatten(), outputs)


def _panels(rows: FixedRows, vectors: int, lanes: int) -> tuple[Tensor, Tensor]:
    """Integers [M, D] as [M / (vectors lanes), D / 2, vectors, lanes, 2], and their scales."""
    depth = rows.integers.shape[1]
    by_panel = rows.integers.reshape(-1, vectors, lanes, depth // 2, 2)
    return by_panel.permute(0, 3, 1, 2, 4).contiguous(), rows.scale


def _wide(weight: Tensor, depth: int) -> Tensor:
    """Weights [M, size] for so many hidden units, zeros at the end."""
    wider = weight.new_zeros(len(weight), depth)
    wider[:, : weight.shape[1]] = weight
    return wider


def _tall(rows: Tensor, length: int, fill: float = 0.0) -> Tensor:
    """So many rows, filled up at the end."""
    longer = rows.new_full((length, *rows.shape[1:]), fill)
    longer[: len(rows)] = rows
    return longer


def _up(number: int, step: int) -> int:
    """The next multiple of ``step``."""
    return -(-number // step) * step


_PACKED: PackedWeights[Decoder, _Packed] = PackedWeights(_weights, _pack)
