"""Batch evaluations: what goes in, what comes out, and both on either transport."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

from google.protobuf.timestamp_pb2 import Timestamp

from trajectron_client.scene import check_names
from trajectron_proto.v1 import evaluation_pb2 as pb

Json = dict[str, Any]
EvaluationProtocol = Literal["sgan", "all", "streaming", "paper"]
ResultFormat = Literal["json", "csv", "html"]


class EvaluationState(enum.StrEnum):
    """Where an evaluation is in its life."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def ended(self) -> bool:
        """Whether it stays as it is from now on."""
        return self not in (EvaluationState.QUEUED, EvaluationState.RUNNING)


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """A recording to be judged on.

    Attributes:
        name: such as ``square.csv``: it ends in ``.csv`` or ``.txt``, and what is before names
            the set in the result.
        content: CSV ``time,id,type,x,y`` or ETH/UCY text.
    """

    name: str
    content: bytes

    @classmethod
    def read(cls, path: str | Path) -> RecordingFile:
        """The recording in a file, under the file's own name."""
        path = Path(path)
        return cls(path.name, path.read_bytes())


class EvaluationOptions(TypedDict, total=False):
    """How models are judged; what is absent is the server's default.

    Attributes:
        evaluation_id: 1 to 128 of ``[A-Za-z0-9._-]``; named by the server when absent.
        dataset: a data set that the server knows: ``eth_ucy``.
        sets: of the data set; all of them when absent.
        protocol: how windows are cut; ``sgan`` when absent.
        num_samples: futures drawn for each agent, 1 to 2000.
        seed: of the samples; the same one gives the same result.
        in_sample: whether a model may be judged on recordings that it was trained on.
        max_windows: of a set, evenly spread.
        frames_per_step: frame numbers between two steps, for ETH/UCY text.
        request_id: any text; sent again with the same request it gives the same evaluation.
    """

    evaluation_id: str
    dataset: str
    sets: Sequence[str]
    protocol: EvaluationProtocol
    num_samples: int
    seed: int
    in_sample: bool
    max_windows: int
    frames_per_step: int
    request_id: str


@dataclass(frozen=True, slots=True)
class EvaluationProgress:
    """How far an evaluation is.

    Attributes:
        share: of the work, 0 to 1.
        windows_done, windows_total: each window once for every model; 0 before they are known.
        model, set: what is being judged, and on what; empty before the first.
        seconds_left: expected until the end; None while unknown.
    """

    share: float
    windows_done: int
    windows_total: int
    model: str
    set: str
    seconds_left: float | None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A batch evaluation, with every option resolved.

    Attributes:
        id: its name.
        models: names of the models and baselines compared.
        dataset: the data set; empty for files sent along.
        sets: the sets judged on; files are sets by themselves.
        files: names of the recordings sent along.
        protocol: how windows are cut.
        num_samples: drawn for each agent.
        seed: of the samples.
        in_sample: whether models may be judged on what they have seen.
        max_windows: of a set; None for all.
        frames_per_step: of recordings in ETH/UCY text.
        state: where it is in its life.
        progress: how far it is.
        error: of one that failed: what went wrong; else empty.
        created_at: when it was queued.
        started_at: when it left the queue; None before.
        ended_at: None before the end.
    """

    id: str
    models: tuple[str, ...]
    dataset: str
    sets: tuple[str, ...]
    files: tuple[str, ...]
    protocol: EvaluationProtocol
    num_samples: int
    seed: int
    in_sample: bool
    max_windows: int | None
    frames_per_step: int
    state: EvaluationState
    progress: EvaluationProgress
    error: str
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None


def create_message(
    models: Iterable[str], files: Iterable[RecordingFile], **options: Unpack[EvaluationOptions]
) -> pb.CreateEvaluationRequest:
    """A request as the contract carries it."""
    check_names(EvaluationOptions, options)
    protocol = options.get("protocol", "unspecified")
    return pb.CreateEvaluationRequest(
        evaluation_id=options.get("evaluation_id", ""),
        config=pb.EvaluationConfig(
            models=models,
            dataset=options.get("dataset", ""),
            sets=options.get("sets", ()),
            protocol=pb.EvaluationProtocol.Value(f"EVALUATION_PROTOCOL_{protocol.upper()}"),
            num_samples=options.get("num_samples"),
            seed=options.get("seed"),
            in_sample=options.get("in_sample", False),
            max_windows=options.get("max_windows"),
            frames_per_step=options.get("frames_per_step"),
        ),
        files=[pb.RecordingFile(name=file.name, content=file.content) for file in files],
        request_id=options.get("request_id", ""),
    )


def create_body(models: Iterable[str], **options: Unpack[EvaluationOptions]) -> Json:
    """A request as JSON, but for its files and its request id."""
    check_names(EvaluationOptions, options)
    body: Json = {"models": list(models), **options}
    body.pop("request_id", None)
    if "sets" in body:
        body["sets"] = list(body["sets"])
    return body


def from_message(message: pb.Evaluation) -> Evaluation:
    """An evaluation of the contract."""
    config, progress = message.config, message.progress
    left = progress.time_left.ToTimedelta() if progress.HasField("time_left") else None
    return Evaluation(
        id=message.id,
        models=tuple(config.models),
        dataset=config.dataset,
        sets=tuple(config.sets),
        files=tuple(message.files),
        protocol=_PROTOCOLS[config.protocol],
        num_samples=config.num_samples,
        seed=config.seed,
        in_sample=config.in_sample,
        max_windows=config.max_windows if config.HasField("max_windows") else None,
        frames_per_step=config.frames_per_step,
        state=_STATES[message.state],
        progress=EvaluationProgress(
            progress.share,
            progress.windows_done,
            progress.windows_total,
            progress.model,
            progress.set,
            None if left is None else left.total_seconds(),
        ),
        error=message.error,
        created_at=_instant(message.create_time),
        started_at=_instant(message.start_time) if message.HasField("start_time") else None,
        ended_at=_instant(message.end_time) if message.HasField("end_time") else None,
    )


def from_body(body: Json) -> Evaluation:
    """An evaluation in JSON."""
    progress = body["progress"]
    return Evaluation(
        id=body["id"],
        models=tuple(body["models"]),
        dataset=body["dataset"],
        sets=tuple(body["sets"]),
        files=tuple(body["files"]),
        protocol=body["protocol"],
        num_samples=body["num_samples"],
        seed=body["seed"],
        in_sample=body["in_sample"],
        max_windows=body["max_windows"],
        frames_per_step=body["frames_per_step"],
        state=EvaluationState(body["state"]),
        progress=EvaluationProgress(
            progress["share"],
            progress["windows_done"],
            progress["windows_total"],
            progress["model"],
            progress["set"],
            progress["seconds_left"],
        ),
        error=body["error"],
        created_at=datetime.fromisoformat(body["create_time"]),
        started_at=_optional(body["start_time"]),
        ended_at=_optional(body["end_time"]),
    )


_PROTOCOLS: dict[int, EvaluationProtocol] = {
    pb.EVALUATION_PROTOCOL_SGAN: "sgan",
    pb.EVALUATION_PROTOCOL_ALL: "all",
    pb.EVALUATION_PROTOCOL_STREAMING: "streaming",
    pb.EVALUATION_PROTOCOL_PAPER: "paper",
}
_STATES: dict[int, EvaluationState] = {
    pb.EVALUATION_STATE_QUEUED: EvaluationState.QUEUED,
    pb.EVALUATION_STATE_RUNNING: EvaluationState.RUNNING,
    pb.EVALUATION_STATE_SUCCEEDED: EvaluationState.SUCCEEDED,
    pb.EVALUATION_STATE_FAILED: EvaluationState.FAILED,
    pb.EVALUATION_STATE_CANCELLED: EvaluationState.CANCELLED,
}


def _instant(message: Timestamp) -> datetime:
    return message.ToDatetime(tzinfo=UTC)


def _optional(text: str | None) -> datetime | None:
    return None if text is None else datetime.fromisoformat(text)
