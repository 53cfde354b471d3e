"""Training as the original trained, in smaller batches; selected on validation data only."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from trajectron_model.data.recording import Recording
from trajectron_model.paper_leaky import saving
from trajectron_model.paper_leaky.chunks import cut
from trajectron_model.paper_leaky.forecasting import joint_best_of
from trajectron_model.paper_leaky.inputs import Inputs, prepare
from trajectron_model.paper_leaky.network import LeakyNetwork
from trajectron_model.paper_leaky.objective import HORIZON, MIN_NOW, Terms, loss_terms

_CLIP_VALUE = 1.0
_LEARNING_RATE, _DECAY = 1e-3, 0.9999


@dataclass(frozen=True)
class LeakySettings:
    """How long and on how much; the rest is the original's.

    Attributes:
        steps: gradient steps; the original made 2000.
        chunks: in a batch; the original took 64.
        validate_every: steps between validations.
        validation_samples: N of the best-of-N that a checkpoint is chosen by.
        seed: of weights, slots, batches and noise.
    """

    steps: int = 800
    chunks: int = 16
    validate_every: int = 100
    validation_samples: int = 20
    seed: int = 0


class Progress(NamedTuple):
    """What an observer of a training is told."""

    step: int  # done
    terms: Terms  # of the newest batch
    validation: tuple[float, float] | None  # best-of-N ADE and FDE, metres, when validated


def train(
    training: Sequence[Recording],
    validation: Sequence[Recording],
    path: Path,
    settings: LeakySettings,
    *,
    observe: Callable[[Progress], object] = lambda _: None,
) -> LeakyNetwork:
    """Trains a network and leaves the best one, by validation, as PATH.

    Chosen by the sum of best-of-N ADE and FDE over the validation recordings, which are
    standardised by their own statistics, as a test set is. The test set is not seen.

    Args:
        training, validation: recordings of one dt.
        path: gets the weights and their description; see `saving`.

    Raises:
        ValueError: recordings without a chunk that is long enough to learn from.
    """
    torch.manual_seed(settings.seed)
    generator = torch.Generator().manual_seed(settings.seed)
    network = LeakyNetwork()
    inputs = prepare(cut(training, settings.seed))
    judged = prepare(cut(validation, settings.seed))
    optimiser = torch.optim.Adam(network.parameters(), lr=_LEARNING_RATE)
    facts: dict[str, Any] = {
        "training": {"recordings": [r.provenance for r in training]},
        "validation": {"recordings": [r.provenance for r in validation]},
        "settings": asdict(settings),
    }
    best, chosen = float("inf"), copy.deepcopy(network.state_dict())
    for step in range(settings.steps):
        for group in optimiser.param_groups:
            group["lr"] = _LEARNING_RATE * _DECAY**step
        chunk, now = _draw(inputs, settings.chunks, generator)
        terms = loss_terms(network, inputs, chunk, now, step, generator)
        optimiser.zero_grad(set_to_none=True)
        terms.loss.backward()
        torch.nn.utils.clip_grad_value_(network.parameters(), _CLIP_VALUE)
        optimiser.step()
        errors = None
        if (step + 1) % settings.validate_every == 0 or step + 1 == settings.steps:
            errors = _validate(network, judged, settings)
            if sum(errors) < best:
                best, chosen = sum(errors), copy.deepcopy(network.state_dict())
                facts["selected"] = {"step": step + 1, "best_of_n": errors}
        observe(Progress(step + 1, terms, errors))
    network.load_state_dict(chosen)
    saving.save(path, network, facts)
    return saving.load(path)[0]


def _draw(inputs: Inputs, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Chunks [B] with replacement, and one present step [B] in each."""
    long_enough = (inputs.lengths > MIN_NOW + HORIZON).nonzero().flatten()
    if not len(long_enough):
        raise ValueError(f"no chunk has the {MIN_NOW + 1 + HORIZON} steps that training needs")
    chunk = long_enough[torch.randint(len(long_enough), (count,), generator=generator)]
    choices = inputs.lengths[chunk] - HORIZON - MIN_NOW  # present steps 7 .. L - 13
    drawn = torch.rand(count, generator=generator) * choices
    return chunk, MIN_NOW + drawn.long()


def _validate(
    network: LeakyNetwork, inputs: Inputs, settings: LeakySettings
) -> tuple[float, float]:
    network.eval()
    errors = joint_best_of(network, inputs, samples=settings.validation_samples, seed=settings.seed)
    network.train()
    return errors
