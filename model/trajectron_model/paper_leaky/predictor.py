"""The leaking model as a predictor, so that the harness can judge it beside the honest ones.

It breaks the predictor's contract on purpose: it reads the recording beyond the observed steps.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window
from trajectron_model.evaluation.plan import PlanError
from trajectron_model.paper_leaky import NAME, saving
from trajectron_model.paper_leaky.chunks import CHUNK_STEPS, cut
from trajectron_model.paper_leaky.forecasting import Scene, encode, modes, sample
from trajectron_model.paper_leaky.inputs import prepare
from trajectron_model.paper_leaky.network import LeakyNetwork
from trajectron_model.predictor import WindowForecast

LABEL = f"{NAME} (inputs contain the future)"
"""How every table calls it: the warning goes where the figures go."""


class LeakyPredictor:
    """Forecasts of the windows of one test set, under the protocol ``paper`` only.

    A person's inputs are their chunk's from its first step to now, with velocities and
    accelerations that contain up to two steps after it. Noise is keyed by the window.

    Args:
        network: as trained without the set.
        recordings: all of the test set: its statistics standardise the inputs.
        slot_seed: of the random slots.
        z_best: samples take each latent's most probable value (the paper's second row).
    """

    def __init__(
        self,
        network: LeakyNetwork,
        recordings: Sequence[Recording],
        *,
        slot_seed: int = 0,
        z_best: bool = False,
    ) -> None:
        self._network = network.eval()
        self._chunks = cut(recordings, slot_seed)
        self._inputs = prepare(self._chunks)
        self._z_best = z_best

    @property
    def name(self) -> str:
        """How tables call it, with the warning."""
        return LABEL

    def predict(
        self, windows: Sequence[Window], *, num_samples: int, seed: int
    ) -> list[WindowForecast]:
        """See `Predictor`; the mean of a mode is a rollout on the mixtures' means.

        Raises:
            PlanError: a window that does not begin where a chunk of these recordings does.
            ValueError: a judged agent who is absent now.
        """
        return [self._predict_window(window, num_samples, seed) for window in windows]

    def _predict_window(self, window: Window, num_samples: int, seed: int) -> WindowForecast:
        scene = self._scene(window)
        encoded = encode(self._network, self._inputs, scene)
        samples = sample(
            self._network,
            encoded,
            samples=num_samples,
            horizon=window.horizon,
            generator=_generator(window, seed),
            z_best=self._z_best,
        )
        probability, means = (
            tensor.double().numpy() for tensor in modes(self._network, encoded, window.horizon)
        )
        best = probability.argmax(axis=1)
        return WindowForecast(
            samples.numpy(),
            means[np.arange(len(best)), best],
            np.einsum("az,azhi->ahi", probability, means),
        )

    def _scene(self, window: Window) -> Scene:
        name, first = window.recording.name, window.first
        if (name, first) not in self._chunks.index or window.observed > CHUNK_STEPS:
            raise PlanError(
                f"{NAME} knows no chunk of {name} that begins at step {first}: it forecasts the "
                "windows of the protocol 'paper' alone, on the recordings it was given"
            )
        chunk, now = self._chunks.index[name, first], window.observed - 1
        slot_of = self._chunks.slots[name, first]
        slots = [slot_of.get(agent, -1) for agent in window.judged.tolist()]
        absent = [
            window.ids[i]
            for i, slot in enumerate(slots)
            if slot < 0 or not self._inputs.present[chunk, now, slot]
        ]
        if absent:
            raise ValueError(f"judged agents are absent now: {', '.join(absent)}")
        return Scene(chunk, now, torch.tensor(slots))


@dataclass(frozen=True)
class Bundled:
    """A bundled network as a predictor, with what its description says."""

    predictor: LeakyPredictor
    sha256: str
    provenance: Mapping[str, Any]


def bundled(test_set: str, recordings: Sequence[Recording], *, seed: int = 0) -> Bundled:
    """The bundled network that was trained without a test set.

    Args:
        test_set: of ETH/UCY.
        recordings: the set's.
        seed: of its training.

    Raises:
        CheckpointError: none ships for this set and seed.
    """
    network, description = saving.load(saving.bundled(test_set, seed))
    predictor = LeakyPredictor(network, recordings, slot_seed=seed)
    return Bundled(predictor, description.sha256, description.provenance)


def _generator(window: Window, seed: int) -> torch.Generator:
    """Noise that depends on the window alone, not on those beside it."""
    key = f"{seed}/{window.recording.name}/{window.first}/{window.now}".encode()
    number = int.from_bytes(hashlib.sha256(key).digest()[:7], "big")
    return torch.Generator().manual_seed(number)
