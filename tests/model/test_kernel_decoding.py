"""Rollouts by the kernel are torch's, and each is the same whatever stands beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from trajectron_model import registry
from trajectron_model.config import ModelConfig
from trajectron_model.decoder import Decoder, Prepared
from trajectron_model.kernels import decoding, dense, in_use, kernels

pytestmark = pytest.mark.skipif(kernels() is None, reason=in_use())

LIMIT = 12.42
ENCODING = 40
# Sizes that fill no vector, no tile and no panel, beside the ones that the model has.
CONFIGS = {
    "default": ModelConfig(),
    "odd": ModelConfig(decoder_size=21, mixture_components=5, latent_values=7),
    "tiny": ModelConfig(decoder_size=1, mixture_components=1, latent_values=1),
    "wide": ModelConfig(decoder_size=72, mixture_components=40, latent_values=3),
}


class Case(NamedTuple):
    """A decoder and what it is asked."""

    decoder: Decoder
    prepared: Prepared
    agent: Tensor
    latent: Tensor
    uniform: Tensor
    normal: Tensor

    def sample(self) -> Tensor:
        with torch.inference_mode():
            return self.decoder.sample(*self[1:], LIMIT)

    def rows(self, index: Tensor) -> Case:
        """Some of the rollouts, in this order."""
        return Case(*self[:2], *(column[index] for column in self[2:]))


def case(name: str, agents: int = 5, samples: int = 11, horizon: int = 6) -> Case:
    torch.manual_seed(3)
    config = CONFIGS[name]
    decoder = Decoder(config, ENCODING)
    # Lively: states and mixtures far from their beginnings.
    for weight in decoder.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    rows = agents * samples
    with torch.inference_mode():
        prepared = decoder.prepare(torch.randn(agents, ENCODING), torch.randn(agents, 2))
    return Case(
        decoder,
        prepared,
        torch.arange(agents).repeat_interleave(samples),
        torch.randint(config.latent_values, (rows,)),
        torch.rand(rows, horizon),
        torch.randn(rows, horizon, 2),
    )


@contextmanager
def by_torch() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for module in (decoding, dense):
            patch.setattr(module, "library_for", lambda *_: None)
        yield


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("shape", [(5, 11, 6), (1, 1, 1), (3, 50, 2)])
def test_samples_are_torchs(name: str, shape: tuple[int, int, int]) -> None:
    asked = case(name, *shape)
    ours = asked.sample()
    with by_torch():
        theirs = asked.sample()
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
    assert ours.square().sum(-1).sqrt().max() <= LIMIT * (1 + 1e-6)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize(("agents", "horizon"), [(1, 1), (4, 7), (30, 3)])
def test_moments_are_torchs(name: str, agents: int, horizon: int) -> None:
    asked = case(name, agents)
    with torch.inference_mode():
        every = asked.decoder.every_latent(agents)
        ours = asked.decoder.moments(asked.prepared, *every, horizon, LIMIT)
        with by_torch():
            theirs = asked.decoder.moments(asked.prepared, *every, horizon, LIMIT)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


def test_of_a_trained_models_samples_hardly_one_in_ten_thousand_differs() -> None:
    decoder = registry.load(registry.DEFAULT).model.node_model(0).decoder
    torch.manual_seed(0)
    agents, samples, horizon = 10, 2000, 12
    rows = agents * samples
    with torch.inference_mode():
        encoding = torch.randn(agents, decoder.gates_encoding.in_features).tanh()
        prepared = decoder.prepare(encoding, torch.randn(agents, 2))
    asked = Case(
        decoder,
        prepared,
        torch.arange(agents).repeat_interleave(samples),
        torch.randint(decoder.gates_latent.num_embeddings, (rows,)),
        torch.rand(rows, horizon),
        torch.randn(rows, horizon, 2),
    )
    ours = asked.sample()
    with by_torch():
        theirs = asked.sample()
    apart = (ours - theirs).abs().amax(dim=(1, 2))
    assert (apart > 1e-4).sum() <= rows / 10_000
    assert apart.median() < 1e-5


@pytest.mark.parametrize("name", CONFIGS)
def test_a_rollout_is_the_same_to_the_last_bit_whatever_stands_beside_it(name: str) -> None:
    asked = case(name)
    everything = asked.sample()
    for index in (torch.tensor([17]), torch.arange(20, 37), torch.randperm(len(everything))):
        assert torch.equal(asked.rows(index).sample(), everything[index])


def test_moments_are_the_same_to_the_last_bit_whatever_stands_beside_them() -> None:
    asked = case("default", agents=6)
    decoder = asked.decoder
    with torch.inference_mode():
        everything = decoder.moments(asked.prepared, *decoder.every_latent(6), 5, LIMIT)
        alone = Prepared(*(column[2:3] for column in asked.prepared))
        values = decoder.gates_latent.num_embeddings
        found = decoder.moments(alone, *decoder.every_latent(1), 5, LIMIT)
        for one, all_ in zip(found, everything, strict=True):
            assert torch.equal(one, all_[2 * values : 3 * values])


def test_threads_share_the_work_and_change_nothing() -> None:
    asked, threads = case("default", samples=60), torch.get_num_threads()
    try:
        found = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(asked.sample())
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


def test_the_uniform_numbers_at_their_ends_choose_the_first_and_the_last_component() -> None:
    asked = case("odd")
    below_one = torch.nextafter(torch.tensor(1.0), torch.tensor(0.0))
    for value in (torch.tensor(0.0), below_one):
        edge = asked._replace(uniform=value.expand_as(asked.uniform))
        ours = edge.sample()
        with by_torch():
            torch.testing.assert_close(ours, edge.sample(), rtol=1e-4, atol=1e-4)


def test_what_is_no_number_stays_none() -> None:
    asked = case("default")
    velocity = asked.prepared.velocity.clone()
    velocity[1, 0] = torch.nan
    asked = asked._replace(prepared=asked.prepared._replace(velocity=velocity))
    missing = asked.sample().isnan().flatten(1).all(dim=1)
    assert torch.equal(missing, asked.agent == 1)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda c: c._replace(agent=c.agent + 1),
        lambda c: c._replace(agent=c.agent - 1),
        lambda c: c._replace(latent=c.latent + 25),
        lambda c: c._replace(latent=c.latent - 25),
    ],
)
def test_rows_out_of_range_are_refused(wrong: Callable[[Case], Case]) -> None:
    with pytest.raises(IndexError):
        wrong(case("default")).sample()


def test_nothing_asked_is_nothing_given() -> None:
    none = case("default").rows(torch.arange(0))
    assert none.sample().shape == (0, 6, 2)


def test_training_goes_by_torch() -> None:
    asked = case("odd")
    prepared = Prepared(*(column.clone() for column in asked.prepared))
    sampled = asked.decoder.sample(prepared, *asked[2:], LIMIT)
    assert sampled.requires_grad
