"""The decoder along a true future, with gradients written by hand.

What autograd keeps and launches for each operation of 12 steps of an LSTM costs more than the
products. Here rows go through all steps in blocks that stay in the processor's cache, gates
are overwritten by their activations, and the mixture's gradient is found beside its value.

Shape letters: R rows, H steps, S size of the state, M components, N = R H.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_ROWS = 128
"""Rows of the LSTM that go through all steps together: their gates take 256 kB."""
_COLUMNS = 1024
"""Steps whose mixtures are evaluated together."""


class Bounds(NamedTuple):
    """What raw outputs of the mixture are squashed into."""

    log_sigma_min: float
    log_sigma_max: float
    correlation: float
    sigmoid_shift: float


def hidden_states(
    gates: Tensor, hidden: Tensor, cell: Tensor, inputs: Tensor, weight: Tensor
) -> Tensor:
    """The hidden states [R, H, S] of an LSTM fed with known inputs.

    Args:
        gates: [R, 4 S] the part of the gates that all steps share; input, forget, output, new.
        hidden, cell: [R, S] to begin with.
        inputs: [R, H, I].
        weight: [4 S, I + S] from [input; hidden] to gates.
    """
    return cast("Tensor", _Recurrence.apply(gates, hidden, cell, inputs, weight))  # type: ignore[no-untyped-call]


def mixture_log_prob(
    hidden: Tensor, weight: Tensor, bias: Tensor, value: Tensor, bounds: Bounds
) -> Tensor:
    """The log density [N] of values under mixtures of bivariate Gaussians, nats.

    Args:
        hidden: [N, S].
        weight, bias: [6 M, S] and [6 M], from hidden states to raw outputs, of all components
            the logits, then means x, means y, scales x, scales y, correlations.
        value: [N, 2].
        bounds: of scales and correlations.
    """
    return cast("Tensor", _Mixture.apply(hidden, weight, bias, value, bounds))  # type: ignore[no-untyped-call]


class _Kept(NamedTuple):
    """Of a block of B rows, what the gradient needs."""

    rows: slice
    fed: Tensor  # [H, B, I + S] input and hidden state before each step
    gates: Tensor  # [H, B, 4 S] activated
    cell: Tensor  # [H, B, S] before each step
    squashed: Tensor  # [H, B, S] tanh of the cell after it


class _Recurrence(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, gates: Tensor, hidden: Tensor, cell: Tensor, inputs: Tensor, weight: Tensor
    ) -> Tensor:
        rows, steps, width = inputs.shape
        size = hidden.shape[1]
        states = hidden.new_empty(rows, steps, size)
        ctx.kept, ctx.width = [], width
        for block in _blocks(rows, _ROWS, hidden.device):
            count = len(gates[block])
            fed = hidden.new_empty(steps, count, width + size)
            fed[:, :, :width] = inputs[block].transpose(0, 1)
            fed[0, :, width:] = hidden[block]
            active = hidden.new_empty(steps, count, 4 * size)
            cells = hidden.new_empty(steps + 1, count, size)
            cells[0] = cell[block]
            squashed = hidden.new_empty(steps, count, size)
            for t in range(steps):
                torch.addmm(gates[block], fed[t], weight.T, out=active[t])
                active[t, :, : 3 * size].sigmoid_()
                active[t, :, 3 * size :].tanh_()
                i, f, o, new = active[t].split(size, dim=-1)
                torch.mul(f, cells[t], out=cells[t + 1]).addcmul_(i, new)
                torch.tanh(cells[t + 1], out=squashed[t])
                state = torch.mul(o, squashed[t])
                states[block, t] = state
                if t + 1 < steps:
                    fed[t + 1, :, width:] = state
            if any(ctx.needs_input_grad):
                ctx.kept.append(_Kept(block, fed, active, cells[:-1], squashed))
        ctx.save_for_backward(weight)
        return states

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (weight,) = ctx.saved_tensors
        rows, steps, size = grad.shape
        d_gates = grad.new_zeros(rows, 4 * size)
        d_hidden, d_cell = grad.new_zeros(rows, size), grad.new_zeros(rows, size)
        d_inputs = grad.new_empty(rows, steps, ctx.width) if ctx.needs_input_grad[3] else None
        d_weight = torch.zeros_like(weight)
        from_hidden = weight[:, ctx.width :].contiguous()
        for block, fed, active, cells, squashed in ctx.kept:
            dh, dc, shared = d_hidden[block], d_cell[block], d_gates[block]
            for t in reversed(range(steps)):
                dh += grad[block, t]
                dg = _through_cell(dh, dc, active[t], cells[t], squashed[t])
                shared += dg
                d_weight.addmm_(dg.T, fed[t])
                torch.mm(dg, from_hidden, out=dh)
                if d_inputs is not None:
                    d_inputs[block, t] = dg @ weight[:, : ctx.width]
        return d_gates, d_hidden, d_cell, d_inputs, d_weight


def _through_cell(dh: Tensor, dc: Tensor, gates: Tensor, cell: Tensor, squashed: Tensor) -> Tensor:
    """The gradient [B, 4 S] of a step's gates; ``dc`` becomes that of the cell before it."""
    size = dh.shape[1]
    i, f, o, new = gates.split(size, dim=-1)
    through = dh * o
    dc += through.addcmul_(through, squashed.square(), value=-1.0)
    dg = torch.empty_like(gates)
    torch.mul(dc, new, out=dg[:, :size])
    torch.mul(dc, cell, out=dg[:, size : 2 * size])
    torch.mul(dh, squashed, out=dg[:, 2 * size : 3 * size])
    opened = gates[:, : 3 * size]
    dg[:, : 3 * size] *= torch.addcmul(opened, opened, opened, value=-1.0)
    d_new = torch.mul(dc, i, out=dg[:, 3 * size :])
    d_new.addcmul_(d_new, new.square(), value=-1.0)
    dc *= f
    return dg


class _Mixture(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, hidden: Tensor, weight: Tensor, bias: Tensor, value: Tensor, bounds: Bounds
    ) -> Tensor:
        count = len(hidden)
        found = hidden.new_empty(count)
        slope = hidden.new_empty(len(weight), count) if any(ctx.needs_input_grad) else None
        for columns in _blocks(count, _COLUMNS, hidden.device):
            raw = torch.addmm(bias.unsqueeze(1), weight, hidden[columns].T)
            part = None if slope is None else slope[:, columns]
            found[columns] = _log_prob(raw, value[columns].T, bounds, part)
        ctx.save_for_backward(hidden, weight, slope)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        hidden, weight, slope = ctx.saved_tensors
        d_raw = slope * grad  # [6 M, N]
        means = d_raw[len(weight) // 6 :].unflatten(0, (5, -1))[:2]
        d_value = -means.sum(dim=1).T if ctx.needs_input_grad[3] else None
        return d_raw.T @ weight, d_raw @ hidden, d_raw.sum(dim=1), d_value, None


def _log_prob(raw: Tensor, value: Tensor, bounds: Bounds, slope: Tensor | None) -> Tensor:
    """[N] from raw outputs [6 M, N] and values [2, N]; their gradient goes into ``slope``."""
    logits, mean_x, mean_y, scale_x, scale_y, turn = raw.chunk(6)
    span = bounds.log_sigma_max - bounds.log_sigma_min
    opened = torch.sigmoid(torch.stack([scale_x, scale_y]) - bounds.sigmoid_shift)  # [2, M, N]
    log_sigma = bounds.log_sigma_min + span * opened
    inverse = torch.exp(-log_sigma)
    u = (value.unsqueeze(1) - torch.stack([mean_x, mean_y])) * inverse
    turned = torch.tanh(turn)
    rho = bounds.correlation * turned
    rest = 1.0 - rho.square()
    product = u[0] * u[1]
    quadratic = (u.square().sum(dim=0) - 2.0 * rho * product) / rest
    log_weights = torch.log_softmax(logits, dim=0)
    each = log_weights - log_sigma.sum(dim=0) - 0.5 * (quadratic + rest.log())
    each -= math.log(2.0 * math.pi)
    total = torch.logsumexp(each, dim=0)
    if slope is None:
        return total
    share = torch.exp(each - total)  # how much each component answers for the value
    pull = (u - rho * u.flip(0)) / rest  # [2, M, N]
    d_log_sigma = share * (u * pull - 1.0)
    d_rho = share * (product + rho * (1.0 - quadratic)) / rest
    parts = slope.unflatten(0, (6, -1))
    torch.sub(share, log_weights.exp(), out=parts[0])
    parts[1:3] = share * pull * inverse
    parts[3:5] = d_log_sigma * span * (opened - opened.square())
    parts[5] = d_rho * bounds.correlation * (1.0 - turned.square())
    return total


def _blocks(count: int, most: int, device: torch.device) -> list[slice]:
    """Runs of rows; a GPU takes them all at once."""
    most = most if device.type == "cpu" else max(count, 1)
    return [slice(first, min(first + most, count)) for first in range(0, count, most)]
