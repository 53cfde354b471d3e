"""Rollouts by the kernel are torch's, and each is the same whatever stands beside it.

The kernel multiplies in 16-bit fixed point. So it is held to torch twice: closely, to a decoder
whose weights and hidden states torch rounds as the kernel does, and to the decoder itself.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from trajectron_model import registry
from trajectron_model.config import ModelConfig
from trajectron_model.decoder import Decoder, Prepared, Start
from trajectron_model.kernels import decoding, dense, in_use, kernels
from trajectron_model.kernels.fixed_point import FRACTION_BITS, FixedRows, fixed_rows

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


class RoundedDecoder(Decoder):
    """A decoder with hidden states on the kernel's grid."""

    def start(self, prepared: Prepared, agent: Tensor, latent: Tensor) -> Start:
        start = super().start(prepared, agent, latent)
        return start._replace(hidden=on_grid(start.hidden))

    def cell(self, start: Start, velocity: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        h, c = super().cell(start, velocity, h, c)
        return on_grid(h), c


def on_grid(hidden: Tensor) -> Tensor:
    return (hidden * float(2**FRACTION_BITS)).round() / float(2**FRACTION_BITS)


def rounded(decoder: Decoder) -> RoundedDecoder:
    """The decoder as the kernel has it, for torch."""
    ours = copy.deepcopy(decoder)
    ours.__class__ = RoundedDecoder
    with torch.no_grad():
        recurrent, head = ours.recurrent.weight, ours.head.weight
        recurrent[:, 2:] = as_floats(fixed_rows(recurrent[:, 2:]))
        head[:] = as_floats(fixed_rows(head))
    assert isinstance(ours, RoundedDecoder)
    return ours


def as_floats(rows: FixedRows) -> Tensor:
    return rows.integers * (rows.scale * float(2**FRACTION_BITS)).unsqueeze(1)


def assert_near(ours: Tensor, theirs: Tensor, middle: float) -> None:
    """Half of all numbers differ by less than ``middle``, all but a few by ten times that.

    These decoders are lively: what rounding differs by grows from step to step, and a uniform
    number at a component's edge can choose the one or the other. A wrong weight shows in the
    middle: it moves everything by hundredths.
    """
    apart = (ours - theirs).abs().flatten()
    assert apart.median() < middle, apart.median()
    assert (apart > 10.0 * middle).float().mean() < 0.05, apart.max()


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
        theirs = asked._replace(decoder=rounded(asked.decoder)).sample()
        exact = asked.sample()
    assert_near(ours, theirs, 3e-4)
    assert_near(ours, exact, 1e-3)
    assert ours.square().sum(-1).sqrt().max() <= LIMIT * (1 + 1e-6)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize(("agents", "horizon"), [(1, 1), (4, 7), (30, 3)])
def test_moments_are_torchs(name: str, agents: int, horizon: int) -> None:
    asked = case(name, agents)
    found = []
    with torch.inference_mode():
        every = asked.decoder.every_latent(agents)
        steps = torch.full((agents,), horizon)
        for decoder in (asked.decoder, rounded(asked.decoder)):
            found.append(asked.decoder.moments(asked.prepared, *every, steps, LIMIT))
            with by_torch():
                found.append(decoder.moments(asked.prepared, *every, steps, LIMIT))
    ours, exact, _, theirs = found
    for one, close, near in zip(ours, theirs, exact, strict=True):
        assert_near(one, close, 3e-4)
        assert_near(one, near, 1e-3)


def test_a_trained_models_samples_hardly_differ_from_torchs() -> None:
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
        exact = asked.sample()
        theirs = asked._replace(decoder=rounded(decoder)).sample()
    for reference, middle_mps, apart_mps in ((theirs, 1e-4, 1e-3), (exact, 3e-4, 3e-3)):
        apart = (ours - reference).abs().amax(dim=(1, 2))
        assert apart.median() < middle_mps
        assert (apart > apart_mps).float().mean() < 2e-3


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
        everything = decoder.moments(
            asked.prepared, *decoder.every_latent(6), torch.full((6,), 5), LIMIT
        )
        alone = Prepared(*(column[2:3] for column in asked.prepared))
        values = decoder.gates_latent.num_embeddings
        found = decoder.moments(alone, *decoder.every_latent(1), torch.tensor([5]), LIMIT)
        for one, all_ in zip(found, everything, strict=True):
            assert torch.equal(one, all_[2 * values : 3 * values])


def test_an_agents_own_steps_do_not_depend_on_how_many_others_have() -> None:
    asked, own = case("default", agents=6), torch.tensor([5, 6, 1, 2, 6, 3])
    decoder = asked.decoder
    with torch.inference_mode():
        every = decoder.every_latent(6)
        whole = decoder.moments(asked.prepared, *every, torch.full((6,), 6), LIMIT)
        cut = decoder.moments(asked.prepared, *every, own, LIMIT)
        for all_, some in zip(whole, cut, strict=True):
            for row, agent in enumerate(every[0]):
                assert torch.equal(all_[row, : own[agent]], some[row, : own[agent]])
        drawn = decoder.sample(*asked[1:], LIMIT, own)
    for row, agent in enumerate(asked.agent):
        assert torch.equal(drawn[row, : own[agent]], asked.sample()[row, : own[agent]])


@pytest.mark.parametrize("wrong", [torch.tensor([6]), torch.full((5,), 7)])
def test_horizons_out_of_range_are_refused(wrong: Tensor) -> None:
    asked = case("default")
    with torch.inference_mode(), pytest.raises(IndexError):
        asked.decoder.sample(*asked[1:], LIMIT, wrong)


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
            theirs = edge._replace(decoder=rounded(edge.decoder)).sample()
        assert_near(ours, theirs, 3e-4)


@pytest.mark.parametrize(
    ("field", "value"),
    [(name, torch.nan) for name in Prepared._fields]
    + [("gates", torch.inf), ("state", -torch.inf)],
)
def test_what_is_no_number_stays_none(field: str, value: float) -> None:
    asked = case("default")
    column = getattr(asked.prepared, field).clone()
    column[1, 0] = value
    asked = asked._replace(prepared=asked.prepared._replace(**{field: column}))
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
