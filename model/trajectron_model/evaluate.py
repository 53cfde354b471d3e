"""The evaluation harness: models and baselines, side by side on the same windows.

Every row of the result has the same metrics: ADE and FDE of the point forecast in both forms,
and best-of-N of independent samples, per agent and joint per scene. Within a set they are means
over the judged agents of all windows; over sets each set weighs the same.

Shape letters: A judged agents, S samples, H horizon steps, B values of N in best-of-N; a last
axis of 2 is ADE and FDE, metres.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trajectron_model import metrics
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import PROTOCOLS, Protocol, Window, batches
from trajectron_model.metrics import Float
from trajectron_model.predictor import Predictor, WindowForecast
from trajectron_model.results import (
    BestOf,
    Displacement,
    Evaluation,
    Fingerprint,
    Row,
    Scores,
    SetFingerprint,
    SetScores,
)

BEST_OF = (1, 5, 20, 100)
"""The N of best-of-N; those above the number of samples are left out."""

_MAX_TRAJECTORIES = 200_000
"""Forecasts held at a time: 40 MB of doubles at 12 steps."""


class InSampleError(ValueError):
    """A model would be judged on a recording that it was trained or selected on."""


@dataclass(frozen=True)
class Contender:
    """One predictor to be judged.

    Attributes:
        predictor: makes the forecasts.
        sha256: of the model's file; empty for a baseline.
        seen: the recordings it was trained and selected on, as `Recording.provenance` has
            them; empty for a baseline, None where a model does not say.
    """

    predictor: Predictor
    sha256: str = ""
    seen: tuple[Mapping[str, str], ...] | None = ()

    @classmethod
    def of_model(
        cls, predictor: Predictor, sha256: str, provenance: Mapping[str, object]
    ) -> Contender:
        """A trained model, with what its checkpoint says it was trained and selected on.

        Args:
            predictor: the model's.
            sha256: of the checkpoint.
            provenance: the checkpoint's; ``training`` and ``validation`` hold ``recordings``.
        """
        return cls(predictor, sha256, _recordings_seen(provenance))

    def seen_of(self, recordings: Iterable[Recording]) -> tuple[str, ...]:
        """The names of those recordings that it has seen; all where it does not say."""
        if self.seen is None:
            return tuple(recording.name for recording in recordings)
        names = {recording["name"] for recording in self.seen}
        files = {recording.get("sha256", "") for recording in self.seen} - {""}
        return tuple(
            recording.name
            for recording in recordings
            if recording.name in names or recording.source_sha256 in files
        )


@dataclass(frozen=True)
class Entry:
    """A row to be: a name, and its contender on each test set.

    Under leave-one-out a row is a family of models, one for each set, trained without it.
    """

    name: str
    contenders: Mapping[str, Contender]


@dataclass(frozen=True)
class EvaluationSet:
    """Recordings to judge on, under a name."""

    name: str
    recordings: tuple[Recording, ...]


@dataclass(frozen=True)
class AgentErrors:
    """Errors of every judged agent of some windows: what all scores are made from.

    Attributes:
        mode_mean: [A, 2] of the mean of the most probable mode.
        mean: [A, 2] of the mean over all modes.
        best_of: [A, B, 2] of the agent's own best of N samples.
        joint_best_of: [A, B, 2] of its window's best of N samples.
    """

    mode_mean: Float
    mean: Float
    best_of: Float
    joint_best_of: Float

    @classmethod
    def of_window(
        cls, forecast: WindowForecast, truth: Float, best_of: Sequence[int]
    ) -> AgentErrors:
        """The errors of one window's agents.

        Args:
            forecast: of the window.
            truth: [A, H, 2] metres, all present.
            best_of: the N, each at most the number of samples.
        """
        samples = _ade_fde(forecast.samples, truth)  # [S, A, 2]
        agents = truth.shape[0]
        own, joint = np.empty((2, agents, len(best_of), 2))
        for column, n in enumerate(best_of):
            for error in range(2):
                own[:, column, error] = metrics.best_of(samples[..., error], n)
                joint[:, column, error] = metrics.joint_best_of(samples[..., error], n)
        return cls(_ade_fde(forecast.mode_mean, truth), _ade_fde(forecast.mean, truth), own, joint)

    @classmethod
    def concatenate(cls, parts: Sequence[AgentErrors]) -> AgentErrors:
        """Those of several windows, in order."""
        return cls(
            np.concatenate([part.mode_mean for part in parts]),
            np.concatenate([part.mean for part in parts]),
            np.concatenate([part.best_of for part in parts]),
            np.concatenate([part.joint_best_of for part in parts]),
        )

    def scores(self, best_of: Sequence[int]) -> Scores:
        """Their means, each agent of each window weighing the same."""
        own, joint = self.best_of.mean(axis=0), self.joint_best_of.mean(axis=0)  # [B, 2]
        return Scores(
            _displacement(self.mode_mean.mean(axis=0)),
            _displacement(self.mean.mean(axis=0)),
            tuple(
                BestOf(n, _displacement(own[column]), _displacement(joint[column]))
                for column, n in enumerate(best_of)
            ),
        )


def judge(
    predictor: Predictor,
    windows: Sequence[Window],
    *,
    samples: int,
    seed: int,
    best_of: Sequence[int] = BEST_OF,
    progress: Callable[[int], object] = lambda windows: None,
) -> AgentErrors:
    """The errors of a predictor on windows, in the windows' order; memory stays bounded.

    Args:
        predictor: makes the forecasts.
        windows: at least one; their futures are complete.
        samples: drawn for each agent of each window.
        seed: of the samples.
        best_of: the N, each at most ``samples``.
        progress: called with the number of windows just judged.
    """
    errors: list[AgentErrors] = []
    for batch in batches(windows, max(1, _MAX_TRAJECTORIES // samples)):
        forecasts = predictor.predict(batch, num_samples=samples, seed=seed)
        for window, forecast in zip(batch, forecasts, strict=True):
            errors.append(AgentErrors.of_window(forecast, window.future(), best_of))
        progress(len(batch))
    return AgentErrors.concatenate(errors)


def evaluate(
    entries: Sequence[Entry],
    test_sets: Sequence[EvaluationSet],
    *,
    protocol: Protocol = PROTOCOLS["sgan"],
    samples: int = 100,
    seed: int = 0,
    in_sample: bool = False,
    progress: Callable[[int], object] = lambda windows: None,
) -> Evaluation:
    """Judges every entry on the windows of every test set.

    Args:
        entries: the rows, each with a contender for every test set.
        test_sets: the columns; all recordings have one dt.
        protocol: how windows are cut.
        samples: drawn for each agent of each window.
        seed: of the samples.
        in_sample: whether a model may be judged on recordings in its provenance; its row is
            then marked.
        progress: called with the number of windows just judged, of as many as there are in
            all test sets for each entry.

    Raises:
        InSampleError: a model would be judged in sample and ``in_sample`` is not set; before
            anything is judged.
        ValueError: no sample, two entries of one name, no test set, a set without windows,
            recordings of unequal dt.
    """
    if samples < 1:
        raise ValueError("samples must be at least 1")
    if len({entry.name for entry in entries}) < len(entries):
        raise ValueError("two entries have the same name")
    if not in_sample:
        _refuse_in_sample(entries, test_sets)
    dt_s = _common_dt_s(test_sets)
    best_of = [n for n in BEST_OF if n <= samples]
    fingerprints: list[SetFingerprint] = []
    scores: dict[str, list[SetScores]] = {entry.name: [] for entry in entries}
    for test_set in test_sets:
        windows = protocol.windows(test_set.recordings)
        if not windows:
            raise ValueError(f"{test_set.name} has no window of the protocol {protocol.name}")
        fingerprints.append(_set_fingerprint(test_set, windows))
        for entry in entries:
            contender = entry.contenders[test_set.name]
            errors = judge(
                contender.predictor,
                windows,
                samples=samples,
                seed=seed,
                best_of=best_of,
                progress=progress,
            )
            scores[entry.name].append(
                SetScores(
                    test_set.name,
                    contender.predictor.name,
                    contender.sha256,
                    bool(contender.seen_of(test_set.recordings)),
                    errors.scores(best_of),
                )
            )
    fingerprint = Fingerprint(protocol, dt_s, samples, seed, "none", tuple(fingerprints))
    return Evaluation(fingerprint, tuple(_row(name, sets) for name, sets in scores.items()))


def _row(name: str, sets: Sequence[SetScores]) -> Row:
    mean = Scores.over_sets([one.scores for one in sets])
    return Row(name, any(one.in_sample for one in sets), tuple(sets), mean)


def _ade_fde(forecast: np.ndarray[tuple[int, ...], np.dtype[np.floating]], truth: Float) -> Float:
    """[..., A, H, 2] positions and [A, H, 2] true ones to [..., A, 2] ADE and FDE."""
    distance = metrics.displacement(forecast, truth)
    return np.stack(
        [metrics.average_displacement(distance), metrics.final_displacement(distance)], axis=-1
    )


def _displacement(ade_fde: Float) -> Displacement:
    ade_m, fde_m = ade_fde.tolist()
    return Displacement(ade_m, fde_m)


def _recordings_seen(provenance: Mapping[str, object]) -> tuple[Mapping[str, str], ...] | None:
    """The recordings in a checkpoint's provenance; None where it does not say."""
    seen: list[Mapping[str, str]] = []
    for role in ("training", "validation"):
        content = provenance.get(role)
        recordings = content.get("recordings") if isinstance(content, Mapping) else None
        if not isinstance(recordings, Sequence):
            return None
        if not all(isinstance(one, Mapping) and "name" in one for one in recordings):
            return None
        seen += recordings
    return tuple(seen)


def _refuse_in_sample(entries: Sequence[Entry], test_sets: Sequence[EvaluationSet]) -> None:
    for entry in entries:
        for test_set in test_sets:
            contender = entry.contenders[test_set.name]
            seen = contender.seen_of(test_set.recordings)
            if not seen:
                continue
            name = contender.predictor.name
            why = (
                f"{name} does not say what it was trained on"
                if contender.seen is None
                else f"{name} was trained or selected on {', '.join(seen)}"
            )
            raise InSampleError(
                f"{why}, so judging it on {test_set.name} would be in sample; "
                "judge a model trained without it, or ask for an in-sample evaluation"
            )


def _common_dt_s(test_sets: Sequence[EvaluationSet]) -> float:
    dts_s = {recording.dt_s for test_set in test_sets for recording in test_set.recordings}
    if len(dts_s) != 1:
        raise ValueError(f"the test sets' steps must have one length; they have {sorted(dts_s)} s")
    return dts_s.pop()


def _set_fingerprint(test_set: EvaluationSet, windows: Sequence[Window]) -> SetFingerprint:
    data, cut = hashlib.sha256(), hashlib.sha256()
    for recording in test_set.recordings:
        head = (recording.name, *recording.ids, *recording.types)
        times = (recording.dt_s, recording.start_time_s, recording.num_steps)
        data.update(repr((head, times)).encode())
        for array in (recording.step, recording.agent, recording.position):
            data.update(np.ascontiguousarray(array).tobytes())
    for window in windows:
        place = (window.recording.name, window.first, window.observed, window.horizon, window.ids)
        cut.update(repr(place).encode())
    return SetFingerprint(
        test_set.name,
        tuple(recording.name for recording in test_set.recordings),
        data.hexdigest(),
        cut.hexdigest(),
        len(windows),
        sum(len(window.judged) for window in windows),
    )
