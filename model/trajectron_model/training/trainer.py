"""The training loop: seeded, selected on validation data, resumable."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from trajectron_model.checkpoint import Checkpoint, save
from trajectron_model.config import ModelConfig
from trajectron_model.data.recording import Recording
from trajectron_model.features import WORLD_FEATURES, WorldFeatures
from trajectron_model.training import resuming
from trajectron_model.training.averaging import Average
from trajectron_model.training.calibration import calibrated
from trajectron_model.training.examples import Examples
from trajectron_model.training.objective import LossTerms, loss_terms
from trajectron_model.training.settings import TrainSettings
from trajectron_model.training.validation import Validation, ValidationFigures
from trajectron_model.trajectron import Trajectron

CHECKPOINT_NAME = "model"
_BATCH_NOISE = 1  # distinguishes the stream of a batch's noise from that of its choice


@dataclass(frozen=True)
class Progress:
    """What an observer of a training is told.

    Attributes:
        step: gradient steps done.
        learning_rate: of the newest step.
        terms: of the newest step's batch.
        figures: of a validation made after this step, else None.
        best_step: the step whose weights stand in the checkpoint; 0 before the first.
    """

    step: int
    learning_rate: float
    terms: LossTerms
    figures: ValidationFigures | None
    best_step: int


Observer = Callable[[Progress], None]


def train(
    config: ModelConfig,
    settings: TrainSettings,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    folder: Path,
    *,
    provenance: dict[str, Any],
    observe: Observer = lambda _: None,
    device: str | None = None,
    resume: bool = False,
    start: Checkpoint | None = None,
) -> Checkpoint:
    """Trains a model and leaves the best one, by validation, in ``folder``.

    Its modes are calibrated then, unless the settings decline it.

    Args:
        config: of the model.
        settings: of the training.
        training, validation: recordings on the model's dt grid.
        folder: gets ``model.safetensors`` and ``model.json``, and what resuming needs.
        provenance: task, data, licence note...; the recordings, settings and figures are added.
        observe: called after every step.
        device: ``cpu`` or ``cuda``; by default CUDA where there is one.
        resume: go on with the training that ``folder`` holds.
        start: weights to begin with instead of random ones. It is validated first, so that what
            is kept is never worse than it; it must know no recording but those of ``training``.

    Returns:
        The checkpoint as saved.

    Raises:
        ValueError: data that do not fit the configuration, nothing to validate on, or a
            training in ``folder`` that was begun with other settings or data, or a start that
            is of another configuration or has seen other recordings.
        CheckpointError: a training to resume whose files are damaged.
    """
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    model = Trajectron(config)
    if isinstance(model.features, WorldFeatures):
        _standardise(model.features, training, config)
    if start is not None:
        _begin_with(start, model, [r.provenance for r in training])
    model = model.to(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    average = Average(model, settings.average_steps)
    examples = Examples(training, config, settings.examples, settings.seed)
    judge = Validation(validation, model)
    optimiser = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
    folder.mkdir(parents=True, exist_ok=True)
    recordings = {
        "training": {"recordings": [r.provenance for r in training]},
        "validation": {"recordings": [r.provenance for r in validation]},
    }
    origin = {} if start is None else {"start": _origin(start)}
    identity = {"model": config.to_json(), "train": settings.to_json(), **origin, **recordings}
    run = resuming.Run(step=0, best_step=0, best_score=float("inf"), identity=identity)
    if resume:
        run = resuming.load(folder, model, average.model, optimiser, identity)
    facts = {**provenance, **recordings, "settings": settings.to_json(), **origin}

    def judged(run: resuming.Run) -> tuple[resuming.Run, ValidationFigures]:
        figures = judge.figures(average.model, settings.objective)
        if figures.score < run.best_score:
            run = run.with_best(figures.score)
            selected = {"step": run.step, "validation_figures": figures._asdict()}
            save(folder / CHECKPOINT_NAME, average.model, {**facts, "selected": selected})
        resuming.save(folder, model, average.model, optimiser, run)
        return run, figures

    if start is not None and not resume:
        run, _ = judged(run)
    model.train()
    while run.step < settings.steps:
        rate = settings.learning_rate_at(run.step)
        terms = _gradient_step(model, optimiser, examples, settings, run.step, rate)
        average.update(run.step)
        run = run.after_step()
        figures = None
        if run.step % settings.validate_every == 0 or run.step == settings.steps:
            run, figures = judged(run)
            model.train()
        observe(Progress(run.step, rate, terms, figures, run.best_step))
    if not settings.calibrate:
        return Checkpoint.load(folder / CHECKPOINT_NAME)
    return _with_calibration(folder / CHECKPOINT_NAME, judge, device)


def _begin_with(start: Checkpoint, model: Trajectron, training: list[dict[str, str]]) -> None:
    """Copies weights whose own training saw none but the recordings of this one."""
    seen = start.provenance["training"]["recordings"]
    strange = [r["name"] for r in seen if r not in training]
    if strange:
        raise ValueError(f"{start.name} was trained on other recordings: {', '.join(strange)}")
    try:
        model.load_state_dict(start.model.state_dict())
    except RuntimeError as error:
        raise ValueError(f"{start.name} is of another configuration: {error}") from error


def _origin(start: Checkpoint) -> dict[str, Any]:
    """What the provenance says of the weights that a training begins with."""
    told = {key: start.provenance.get(key) for key in ("settings", "selected", "start")}
    return {
        "name": start.name,
        "weights_sha256": start.description.weights_sha256,
        **{key: value for key, value in told.items() if value is not None},
    }


def _with_calibration(path: Path, judge: Validation, device: str | None) -> Checkpoint:
    """The checkpoint, saved anew with its modes' spread fitted to validation data."""
    best = Checkpoint.load(path)
    model = best.model.to(device or best.model.device)
    model.config = calibrated(model, judge.calibration_windows)
    save(path, model, best.provenance)
    return Checkpoint.load(path)


def _gradient_step(
    model: Trajectron,
    optimiser: torch.optim.Optimizer,
    examples: Examples,
    settings: TrainSettings,
    step: int,
    rate: float,
) -> LossTerms:
    for group in optimiser.param_groups:
        group["lr"] = rate
    terms = loss_terms(
        model,
        examples.batch(step),
        settings.objective,
        beta=settings.objective.beta(step / settings.steps),
        random=np.random.default_rng([settings.seed, step, _BATCH_NOISE]),
    )
    optimiser.zero_grad(set_to_none=True)
    terms.loss.backward()
    norm = torch.nn.utils.clip_grad_norm_(model.parameters(), settings.clip_norm)
    if not torch.isfinite(norm):
        raise FloatingPointError(
            f"the gradient of step {step} is not finite: {json.dumps(settings.to_json())}"
        )
    optimiser.step()
    return terms._replace(loss=terms.loss.detach())


def _standardise(
    features: WorldFeatures, training: Sequence[Recording], config: ModelConfig
) -> None:
    """Mean and deviation of positions, velocities, accelerations over the training data only."""
    for kind, name in enumerate(config.node_types):
        rows = []
        for recording in training:
            _, dense = recording.dense()
            wanted = np.array([t == name for t in recording.types])
            track = dense[:, wanted]
            velocity = np.diff(track, axis=0, prepend=np.nan) / config.dt_s
            change = np.diff(velocity, axis=0, prepend=np.nan) / config.dt_s
            state = np.concatenate([track, velocity, change], axis=-1).reshape(-1, WORLD_FEATURES)
            rows.append(state[~np.isnan(state).any(axis=1)])
        states = np.concatenate(rows)
        if len(states):
            features.mean[kind] = torch.from_numpy(states.mean(axis=0))
            features.std[kind] = torch.from_numpy(states.std(axis=0).clip(1e-2))
