"""How the learned baselines are trained: seeded, selected on validation data, until they converge.

Shape letters: S samples, A judged agents, H horizon steps.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import torch
from torch import nn

from trajectron_model.baselines import saving
from trajectron_model.baselines.network import NetworkPredictor, SceneNetwork, require_dt
from trajectron_model.baselines.scenes import (
    MEMORY_STEPS,
    Scene,
    SceneBatch,
    observed_scene,
    stack,
)
from trajectron_model.baselines.stepping import SteppingNetwork
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, sgan_windows

CHECKPOINT_NAME = "baseline"

_VALIDATION_AGENTS = 150
_VALIDATION_SEED = 20180618


@dataclass(frozen=True)
class BaselineSettings:
    """How a baseline is trained.

    Attributes:
        windows: in a batch, drawn evenly from all of the training's.
        agents: of a window at most: a crowd is cut to a random judged agent and those nearest
            to it, so that crowds do not fill every batch.
        jitter_m: standard deviation of noise on all positions. The recordings are smooth splines:
            a network trained to foretell the next step alone learns to continue their curvature,
            and runs off when fed its own steps.
        learning_rate: of Adam, at first.
        validate_every: steps between validations.
        patience: validations without a better one after which the learning rate falls.
        rates: learning rates in all, each a fifth of the one before; converged when the last
            has not bettered the validation either.
        samples: of the best of which the validation judges; 1 judges the point forecast.
        minutes: of CPU time at most.
        seed: of weights, batches and noise.
        threads: of torch; None leaves them as they are.
    """

    windows: int = 16
    agents: int = 16
    jitter_m: float = 0.0
    learning_rate: float = 2e-3
    validate_every: int = 100
    patience: int = 4
    rates: int = 2
    samples: int = 1
    minutes: float = 5.0
    seed: int = 0
    threads: int | None = None


class Update(Protocol):
    """One gradient step on a batch, whatever a baseline's losses are."""

    def __call__(self, batch: SceneBatch, learning_rate: float) -> float:
        """Takes the step; gives the loss before it."""


class LikelihoodUpdate:
    """The likelihood of every next displacement, of judged agents, is raised.

    Args:
        network: is trained in place.
    """

    def __init__(self, network: SteppingNetwork) -> None:
        self._network = network
        self._adam = torch.optim.Adam(network.parameters())

    def __call__(self, batch: SceneBatch, learning_rate: float) -> float:
        """See `Update`; the loss is in nats a step."""
        loss = -self._network.log_likelihood(batch)[:, batch.judged].mean()
        for group in self._adam.param_groups:
            group["lr"] = learning_rate
        self._adam.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self._network.parameters(), 5.0)
        self._adam.step()
        return float(loss.detach())


class Validated(NamedTuple):
    """What an observer of a training is told after each validation."""

    step: int
    minutes: float  # of CPU time
    loss: float  # mean since the validation before
    ade_m: float
    fde_m: float
    best_step: int


Outcome = Literal["converged", "reached the cap"]


class Batches:
    """Batches of training windows; each follows from (seed, its number).

    Raises:
        ValueError: no window with two agents throughout, as the protocol ``sgan`` asks for.
    """

    def __init__(
        self, windows: Sequence[Window], network: SceneNetwork, settings: BaselineSettings
    ):
        if not windows:
            raise ValueError("the training data has no window with two agents throughout")
        self._scenes = [
            observed_scene(window, context=network.context, future=True) for window in windows
        ]
        self._settings = settings

    def batch(self, number: int) -> SceneBatch:
        """The batch with this number, the same whenever it is asked for."""
        random = np.random.default_rng([self._settings.seed, number])
        chosen = random.integers(len(self._scenes), size=self._settings.windows)
        return stack([self._cut(self._scenes[index], random) for index in chosen])

    def _cut(self, scene: Scene, random: np.random.Generator) -> Scene:
        middle = int(random.choice(scene.judged))
        if scene.position.shape[1] > self._settings.agents:
            scene = scene.around(middle, self._settings.agents)
        if not self._settings.jitter_m:
            return scene
        noise = random.normal(0.0, self._settings.jitter_m, scene.position.shape)
        return replace(scene, position=scene.position + noise)


class Judge:
    """ADE and FDE on a fixed selection of validation windows; recordings weigh the same.

    Raises:
        ValueError: nothing to validate on.
    """

    def __init__(self, recordings: Sequence[Recording], samples: int) -> None:
        found = [training_windows(recording) for recording in recordings]
        self._windows = [thin(windows, _VALIDATION_AGENTS) for windows in found if windows]
        self._samples = samples
        if not self._windows:
            raise ValueError("the validation data has no window with two agents throughout")

    def errors(self, network: SceneNetwork) -> tuple[float, float]:
        """ADE and FDE, metres: of the point forecast, or the best of samples per agent."""
        network.eval()
        predictor = NetworkPredictor(network, "in training")
        means = [self._of(predictor, windows) for windows in self._windows]
        network.train()
        ade_m, fde_m = np.mean(means, axis=0).tolist()
        return ade_m, fde_m

    def _of(self, predictor: NetworkPredictor, windows: Sequence[Window]) -> np.ndarray:
        forecasts = predictor.predict(windows, num_samples=self._samples, seed=_VALIDATION_SEED)
        rows = []
        for window, forecast in zip(windows, forecasts, strict=True):
            tracks = forecast.mean[None] if self._samples == 1 else forecast.samples
            distance = np.linalg.norm(tracks - window.future(), axis=-1)  # [S, A, H]
            errors = [distance.mean(-1).min(0), distance[..., -1].min(0)]
            rows.append(np.stack(errors, axis=-1))
        mean: np.ndarray = np.concatenate(rows).mean(axis=0)
        return mean


def training_windows(recording: Recording) -> list[Window]:
    """The windows of the protocol ``sgan``, of which baselines learn."""
    return sgan_windows(recording, observed=MEMORY_STEPS)


def thin(windows: Sequence[Window], agents: int) -> list[Window]:
    """Evenly spaced windows with about so many judged agents in all, and at least one window."""
    total = sum(len(window.judged) for window in windows)
    count = max(1, round(len(windows) * min(1.0, agents / total)))
    chosen = np.linspace(0, len(windows) - 1, count).round().astype(int)
    return [windows[index] for index in chosen]


@dataclass
class _Schedule:
    """Which validation was best, and when the learning rate falls."""

    settings: BaselineSettings
    best_score: float = float("inf")
    best_step: int = 0
    waited: int = 0
    rate: int = 0

    @property
    def learning_rate(self) -> float:
        """Of the next step."""
        return self.settings.learning_rate * 0.2**self.rate

    @property
    def converged(self) -> bool:
        """Whether every learning rate has had its patience."""
        return self.rate >= self.settings.rates

    def validated(self, step: int, score: float) -> bool:
        """Notes a validation; whether it is the best so far."""
        if score < self.best_score:
            self.best_score, self.best_step, self.waited = score, step, 0
            return True
        self.waited += 1
        if self.waited >= self.settings.patience:
            self.rate, self.waited = self.rate + 1, 0
        return False


def train(
    name: str,
    network: SceneNetwork,
    update: Update,
    settings: BaselineSettings,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    folder: Path,
    *,
    provenance: dict[str, Any],
    observe: Callable[[Validated], None] = lambda _: None,
) -> Path:
    """Trains a baseline and leaves the best one, by validation, in ``folder``.

    Args:
        name: the baseline's.
        network: freshly made; trained in place.
        update: takes the gradient steps.
        settings: of the training.
        training, validation: recordings with steps of 0.4 s.
        folder: gets ``baseline.safetensors`` and ``baseline.json``.
        provenance: task, licence note...; recordings, settings and outcome are added.
        observe: called after every validation.

    Returns:
        The files' path without suffix.

    Raises:
        ValueError: data that cannot be trained or validated on.
    """
    windows = [window for recording in training for window in training_windows(recording)]
    require_dt(windows, name)
    batches, judge = Batches(windows, network, settings), Judge(validation, settings.samples)
    schedule = _Schedule(settings)
    path, losses, step = folder / CHECKPOINT_NAME, [], 0
    folder.mkdir(parents=True, exist_ok=True)
    best: dict[str, Any] = {}
    began_s = time.process_time()
    minutes = 0.0
    while not schedule.converged and minutes < settings.minutes:
        losses.append(update(batches.batch(step), schedule.learning_rate))
        step += 1
        minutes = (time.process_time() - began_s) / 60.0
        if step % settings.validate_every and minutes < settings.minutes:
            continue
        ade_m, fde_m = judge.errors(network)
        minutes = (time.process_time() - began_s) / 60.0
        if schedule.validated(step, ade_m + 0.5 * fde_m):
            best = {name: tensor.clone() for name, tensor in network.state_dict().items()}
            figures = {"ade_m": ade_m, "fde_m": fde_m}
        loss = float(np.mean(losses))
        losses = []
        observe(Validated(step, minutes, loss, ade_m, fde_m, schedule.best_step))
    network.load_state_dict(best)
    outcome: Outcome = "converged" if schedule.converged else "reached the cap"
    facts = {
        **provenance,
        "training": {"recordings": [r.provenance for r in training]},
        "validation": {"recordings": [r.provenance for r in validation]},
        "settings": dataclasses.asdict(settings),
        "selected": {"step": schedule.best_step, "validation_figures": figures},
        "steps": step,
        "cpu_minutes": round(minutes, 2),
        "outcome": outcome,
    }
    saving.save(path, name, network, facts)
    return path
