"""Gradients written by hand, beside those of torch's automatic differentiation."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from trajectron_model import teacher_forcing
from trajectron_model.config import ModelConfig
from trajectron_model.decoder import Decoder, Start

SMALL = ModelConfig(latent_values=3, mixture_components=3, decoder_size=6, horizon=4)
ENCODING = 5
LogProb = Callable[[Decoder, Start, Tensor], Tensor]


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last block of rows, and of columns, is a part of one."""
    monkeypatch.setattr(teacher_forcing, "_ROWS", 4)
    monkeypatch.setattr(teacher_forcing, "_COLUMNS", 7)


def by_autograd(decoder: Decoder, start: Start, future: Tensor) -> Tensor:
    h, c, velocity = start.hidden, start.cell, start.velocity
    found = []
    for t in range(future.shape[1]):
        h, c = decoder.cell(start, velocity, h, c)
        found.append(decoder.mixture(h, velocity).log_prob(future[:, t]))
        velocity = future[:, t]
    return torch.stack(found, dim=1)


def gradients(log_prob: LogProb) -> dict[str, Tensor]:
    """Of a weighted sum over 3 agents under 3 values, to all that can be learnt."""
    torch.manual_seed(0)
    decoder = Decoder(SMALL, ENCODING).double()
    encoding = torch.randn(3, ENCODING, dtype=torch.float64, requires_grad=True)
    velocity = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)
    future = torch.randn(9, 4, 2, dtype=torch.float64, requires_grad=True)
    agent, latent = decoder.every_latent(3)
    start = decoder.start(decoder.prepare(encoding, velocity), agent, latent)
    found = log_prob(decoder, start, future)
    (found * torch.randn(9, 4, dtype=torch.float64)).sum().backward()
    inputs = {"encoding": encoding, "velocity": velocity, "future": future}
    leaves = {**dict(decoder.named_parameters()), **inputs}
    assert all(leaf.grad is not None for leaf in leaves.values())
    grads = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    return {"log_prob": found.detach(), **grads}


def test_value_and_gradients_are_those_of_the_decoder_stepped_by_hand() -> None:
    expected = gradients(by_autograd)
    found = gradients(Decoder.log_prob)
    for name, value in expected.items():
        assert value.abs().max() > 1e-3, name
        torch.testing.assert_close(found[name], value, rtol=1e-9, atol=1e-12, msg=name)


def test_without_gradients_nothing_is_kept() -> None:
    torch.manual_seed(0)
    decoder = Decoder(SMALL, ENCODING)
    agent, latent = decoder.every_latent(2)
    future = torch.randn(6, 4, 2)
    with torch.no_grad():
        start = decoder.start(
            decoder.prepare(torch.randn(2, ENCODING), torch.randn(2, 2)), agent, latent
        )
        found = decoder.log_prob(start, future)
        assert found.grad_fn is None
        torch.testing.assert_close(found, by_autograd(decoder, start, future))
