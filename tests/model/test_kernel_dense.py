"""Linear layers by the kernel are torch's, and each row is the same whatever stands beside it."""

from __future__ import annotations

import pytest
import torch

from trajectron_model.kernels import in_use, kernels
from trajectron_model.kernels.dense import linear

needs_kernels = pytest.mark.skipif(kernels() is None, reason=in_use())


@needs_kernels
@pytest.mark.parametrize(("rows", "depth", "columns"), [(1, 1, 1), (7, 40, 512), (5, 3, 33)])
def test_a_linear_layer_is_torchs_and_its_rows_stand_alone(
    rows: int, depth: int, columns: int
) -> None:
    torch.manual_seed(rows)
    layer, inputs = torch.nn.Linear(depth, columns), torch.randn(rows, depth)
    with torch.inference_mode():
        ours, theirs = linear(layer, inputs), layer(inputs)
        assert ours.shape == theirs.shape
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)
        for row in range(rows):
            assert torch.equal(linear(layer, inputs[row : row + 1]), ours[row : row + 1])


@needs_kernels
def test_weights_are_packed_again_when_they_change() -> None:
    layer, inputs = torch.nn.Linear(3, 4), torch.ones(1, 3)
    with torch.no_grad():
        before = linear(layer, inputs)
        layer.bias.add_(1.0)
        torch.testing.assert_close(linear(layer, inputs), before + 1.0)
        layer.weight = torch.nn.Parameter(torch.zeros(4, 3))
        torch.testing.assert_close(linear(layer, inputs)[0], layer.bias)


def test_gradients_flow_where_they_are_asked_for() -> None:
    layer = torch.nn.Linear(3, 4)
    linear(layer, torch.ones(1, 3)).sum().backward()
    assert layer.weight.grad is not None
    doubles = torch.nn.Linear(3, 4).double()
    with torch.no_grad():
        assert linear(doubles, torch.ones(1, 3).double()).dtype is torch.float64
