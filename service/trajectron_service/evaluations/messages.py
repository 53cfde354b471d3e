"""What the use cases of evaluations take and return: frozen dataclasses that know no transport."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class EvaluationState(enum.Enum):
    """Where an evaluation is in its life, in order."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def ended(self) -> bool:
        """Whether it stays as it is from now on."""
        return self not in (EvaluationState.QUEUED, EvaluationState.RUNNING)


class EvaluationProtocol(enum.Enum):
    """How windows are cut and who is judged in them."""

    SGAN = "sgan"
    ALL = "all"
    STREAMING = "streaming"
    PAPER = "paper"


class ResultFormat(enum.Enum):
    """The form of a result."""

    JSON = "json"
    CSV = "csv"
    HTML = "html"


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """A recording as it was sent along, not yet read."""

    name: str
    content: bytes


@dataclass(frozen=True, slots=True)
class EvaluationConfig:
    """What is judged, on what, and how; None and empty ask for the default.

    Attributes:
        models: names of models and baselines, in order.
        dataset: a data set that the server knows; empty for recordings sent along.
        sets: of the data set; all of them when empty.
        protocol: how windows are cut.
        num_samples: drawn for each agent of each window.
        seed: of the samples.
        in_sample: whether a model may be judged on what it was trained on.
        max_windows: of a set, evenly spread; None for all.
        frames_per_step: frame numbers between two steps of recordings in ETH/UCY text.
    """

    models: tuple[str, ...]
    dataset: str = ""
    sets: tuple[str, ...] = ()
    protocol: EvaluationProtocol = EvaluationProtocol.SGAN
    num_samples: int | None = None
    seed: int | None = None
    in_sample: bool = False
    max_windows: int | None = None
    frames_per_step: int | None = None


@dataclass(frozen=True, slots=True)
class EvaluationProgress:
    """How far an evaluation is.

    Attributes:
        share: of the work, in [0, 1].
        windows_done, windows_total: each window once for every model; 0 before they are known.
        model, set: what is being judged, and on what; empty before the first.
        seconds_left: expected until the end; None while unknown.
    """

    share: float = 0.0
    windows_done: int = 0
    windows_total: int = 0
    model: str = ""
    set: str = ""
    seconds_left: float | None = None


@dataclass(frozen=True, slots=True)
class EvaluationInfo:
    """One evaluation; times are Unix seconds.

    Attributes:
        id: as chosen by the client, or assigned.
        config: resolved, every field set.
        files: names of the recordings sent along.
        state: where it is in its life.
        progress: how far it is.
        error: of one that failed: what went wrong; else empty.
        created_at: when it was queued.
        started_at: when it first left the queue, None before.
        ended_at: None before the end.
    """

    id: str
    config: EvaluationConfig
    files: tuple[str, ...]
    state: EvaluationState
    created_at: float
    progress: EvaluationProgress = EvaluationProgress()
    error: str = ""
    started_at: float | None = None
    ended_at: float | None = None


@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """A result in one of its forms."""

    content: bytes
    content_type: str
