"""Weights as 16-bit integers: near the weights, and no sum of products overflows."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from trajectron_model.kernels.fixed_point import FRACTION_BITS, fixed_rows

ROWS = {
    "normal": torch.randn(50, 128, generator=torch.Generator().manual_seed(1)),
    "one large": torch.eye(7, 16) * 40.0 + 1e-3,
    "all alike": torch.ones(3, 128),
    "small": torch.full((2, 4), 1e-30),
}


@pytest.mark.parametrize("name", ROWS)
def test_integers_times_their_scale_are_the_weights(name: str) -> None:
    weight = ROWS[name]
    fixed = fixed_rows(weight)
    back = fixed.integers.double() * (fixed.scale.double() * 2**FRACTION_BITS).unsqueeze(1)
    step = fixed.scale.double() * 2**FRACTION_BITS
    assert ((back - weight.double()).abs() <= 0.51 * step.unsqueeze(1)).all()
    assert (step <= weight.abs().double().mean(dim=1) * 128 / 2000).all()


@pytest.mark.parametrize("name", ROWS)
def test_no_sum_leaves_32_bits(name: str) -> None:
    integers = fixed_rows(ROWS[name]).integers.long()
    assert (integers.abs().sum(dim=1) * 2**FRACTION_BITS < 2**31).all()
    assert integers.abs().max() < 2**15


def test_rows_of_zeros_stay_zero() -> None:
    fixed = fixed_rows(torch.zeros(2, 8))
    assert not fixed.integers.any() and torch.isfinite(fixed.scale).all()


@pytest.mark.parametrize("wrong", [torch.tensor([[torch.nan]]), torch.tensor([[torch.inf]])])
def test_a_weight_that_is_no_number_is_refused(wrong: Tensor) -> None:
    with pytest.raises(ValueError, match="finite"):
        fixed_rows(wrong)
