"""Training examples: random stretches of recordings, augmented, as batches of nodes.

Every choice of a batch follows from (seed, number of the batch), so a resumed training
sees what an uninterrupted one would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trajectron_model.config import ModelConfig
from trajectron_model.data.recording import Recording
from trajectron_model.history import History
from trajectron_model.training import augmentation


@dataclass(frozen=True)
class ExampleSettings:
    """How examples are drawn.

    Attributes:
        agents: B, about how many agents are trained on in a batch.
        agents_per_scene: at most so many of one scene, so that crowds do not fill every batch.
        short_history: share of batches whose history has 1 to ``observed_steps - 1`` steps.
        long_history: share of batches whose history is up to twice ``observed_steps``.
        mirror: whether half of the scenes are mirrored.
        scale: scenes are stretched by a factor from [1 / (1 + scale), 1 + scale].
        input_noise_m: the roughest noise on observed positions. A scene's standard deviation
            is this times the square of a uniform number: most scenes are nearly clean, some
            as rough as a poor tracker's tracks, and the encoder has to tell which.
        pace: share of scenes that are played at a changing pace (`augmentation.paced`).
    """

    agents: int = 128
    agents_per_scene: int = 12
    short_history: float = 0.2
    long_history: float = 0.1
    mirror: bool = True
    scale: float = 0.3
    input_noise_m: float = 0.1
    pace: float = 0.25


class Batch(NamedTuple):
    """Nodes of several scenes, some of which are trained on."""

    past: History  # T steps of N nodes
    rows: NDArray[np.int64]  # [B] nodes that are trained on, seen at the newest step
    future: NDArray[np.float64]  # [B, H, 2] metres, anything where unknown
    known: NDArray[np.bool_]  # [B, H] true on a prefix, at least one step


class Examples:
    """Batches from recordings.

    Args:
        recordings: on the model's dt grid.
        config: of the model; agents of stationary types are context only.
        settings: how examples are drawn.
        seed: of all choices.

    Raises:
        ValueError: another dt, a type that the model lacks, or nothing to train on.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        config: ModelConfig,
        settings: ExampleSettings,
        seed: int,
    ) -> None:
        self.config, self.settings, self.seed = config, settings, seed
        self.recordings = list(recordings)
        self._types: list[NDArray[np.int64]] = []
        starts = []
        for number, recording in enumerate(self.recordings):
            if abs(recording.dt_s - config.dt_s) > 1e-6:
                raise ValueError(
                    f"{recording.name} has steps of {recording.dt_s} s, the model {config.dt_s} s"
                )
            kinds = np.array([config.type_index(name) for name in recording.types], dtype=np.int64)
            self._types.append(kinds)
            now = _trainable_steps(recording, kinds, config)
            starts.append(np.stack([np.full_like(now, number), now], axis=1))
        self._starts = np.concatenate(starts) if starts else np.empty((0, 2), dtype=np.int64)
        if not len(self._starts):
            raise ValueError("the recordings hold no agent with two consecutive steps")

    def __len__(self) -> int:
        """How many scenes can be drawn."""
        return len(self._starts)

    def batch(self, number: int) -> Batch:
        """The batch with this number, the same whenever it is asked for."""
        random = np.random.default_rng([self.seed, number])
        steps = self._history_steps(random)
        scenes, agents = [], 0
        while agents < self.settings.agents:
            scene = self._scene(random, steps)
            scenes.append(scene)
            agents += len(scene.rows)
        return _join(scenes)

    def _history_steps(self, random: np.random.Generator) -> int:
        observed, draw = self.config.observed_steps, random.random()
        if draw < self.settings.short_history and observed > 1:
            return int(random.integers(1, observed))
        if draw > 1.0 - self.settings.long_history:
            return int(random.integers(observed + 1, 2 * observed + 1))
        return observed

    def _scene(self, random: np.random.Generator, steps: int) -> Batch:
        number, now = self._starts[random.integers(len(self._starts))]
        recording, horizon = self.recordings[number], self.config.horizon
        ahead = horizon + augmentation.steps_beyond(horizon)
        first, last = max(0, now + 1 - steps), min(recording.num_steps, now + 1 + ahead)
        agents, dense = recording.dense(first, last)
        position = np.full((steps + ahead, len(agents), 2), np.nan)
        begin = steps - (now + 1 - first)
        position[begin : begin + len(dense)] = dense
        kinds = self._types[number][agents]
        observed = ~np.isnan(position[:steps, :, 0]).all(axis=0)
        position, kinds = position[:, observed], kinds[observed]
        position = self._augment(position, steps, random)[: steps + horizon]
        present = ~np.isnan(position[..., 0])  # [T + H, N]
        known = np.logical_and.accumulate(present[steps:], axis=0)
        moves = np.array([not t.stationary for t in self.config.types])
        rows = np.flatnonzero(present[steps - 1] & known[0] & moves[kinds])
        if len(rows) > self.settings.agents_per_scene:
            rows = np.sort(random.choice(rows, self.settings.agents_per_scene, replace=False))
        future = np.nan_to_num(position[steps:, rows]).transpose(1, 0, 2)
        past = np.nan_to_num(position[:steps])
        if self.settings.input_noise_m:
            deviation = self.settings.input_noise_m * random.random() ** 2
            past = past + random.normal(0.0, deviation, past.shape)
        scene = np.zeros(len(kinds), dtype=np.int64)
        return Batch(History(past, present[:steps], kinds, scene), rows, future, known[:, rows].T)

    def _augment(
        self, position: NDArray[np.float64], steps: int, random: np.random.Generator
    ) -> NDArray[np.float64]:
        """Another scene about the middle of its observed steps, mirrored, stretched, paced.

        With ``world`` features places mean something: scenes stay where and as they were.
        """
        if self.config.features == "world":
            return position
        position = position - np.nanmean(position[:steps], axis=(0, 1))
        if self.settings.mirror:
            position = augmentation.mirrored(position, random)
        if self.settings.scale:
            position = augmentation.stretched(position, self.settings.scale, random)
        if self.settings.pace and random.random() < self.settings.pace:
            position = augmentation.paced(position, steps - 1, random)
        return position


def _trainable_steps(
    recording: Recording, kinds: NDArray[np.int64], config: ModelConfig
) -> NDArray[np.int64]:
    """Steps at which some agent that can move is seen, and seen again at the next step."""
    moves = np.array([not t.stationary for t in config.types])[kinds]
    agent, step = recording.agent, recording.step
    rows = moves[agent]
    key = agent[rows] * (recording.num_steps + 1) + step[rows]
    again = np.isin(key + 1, key)
    return np.unique(step[rows][again])


def _join(scenes: Sequence[Batch]) -> Batch:
    sizes = [scene.past.node_type.size for scene in scenes]
    first = np.cumsum([0, *sizes])[:-1]
    past = History(
        np.concatenate([s.past.position for s in scenes], axis=1),
        np.concatenate([s.past.present for s in scenes], axis=1),
        np.concatenate([s.past.node_type for s in scenes]),
        np.repeat(np.arange(len(scenes)), sizes),
    )
    rows = [s.rows + offset for s, offset in zip(scenes, first, strict=True)]
    return Batch(
        past,
        np.concatenate(rows),
        np.concatenate([s.future for s in scenes]),
        np.concatenate([s.known for s in scenes]),
    )
