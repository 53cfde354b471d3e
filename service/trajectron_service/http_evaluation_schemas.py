"""The JSON of evaluations: requests (their shape only, as in ``http_schemas``) and answers."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import ConfigDict, Field

from trajectron_service.evaluations.messages import (
    EvaluationConfig,
    EvaluationInfo,
    EvaluationProtocol,
    EvaluationState,
)
from trajectron_service.http_answers import Answer
from trajectron_service.http_encode import rfc3339
from trajectron_service.http_schemas import Body


class CreateEvaluationRequest(Body):
    """What is judged, on what, and how."""

    model_config = ConfigDict(
        json_schema_extra={
            "required": ["models"],
            "examples": [
                {
                    "models": ["leave-one-out", "constant-velocity"],
                    "dataset": "eth_ucy",
                    "sets": ["zara1"],
                    "num_samples": 20,
                }
            ],
        },
    )

    evaluation_id: str = Field(
        "", description="1 to 128 of `A-Z a-z 0-9 . _ -`; assigned by the server when absent."
    )
    models: tuple[str, ...] = Field(
        (),
        description="The models and baselines to compare, in order: names from `GET /v1/models`, "
        "bundled models, `leave-one-out` (on each set the bundled model that was trained without "
        "it), and baselines such as `constant-velocity`. `NAME@z_best` judges a model's most "
        "probable mode alone, `NAME@stratified` its stratified samples.",
    )
    dataset: str = Field(
        "", description="A data set that the server knows: `eth_ucy`. None for files sent along."
    )
    sets: tuple[str, ...] = Field((), description="Of the data set; all of them when absent.")
    protocol: EvaluationProtocol = Field(
        EvaluationProtocol.SGAN,
        description="`sgan`: windows of 8 observed and 12 further steps, with at least two people "
        "present throughout. `all`: one suffices. `streaming`: recordings streamed once, "
        "everybody judged at every step. `paper`: the windows of the paper's Table 1.",
    )
    num_samples: int | None = Field(
        None, description="Futures drawn for each agent, 1 to 2000; default 100."
    )
    seed: int | None = Field(
        None,
        description="0 to 2^63 - 1; default 0. The same seed gives the same result, here and "
        "offline.",
    )
    in_sample: bool = Field(
        False,
        description="Whether a model may be judged on recordings that it was trained on; its row "
        "is then marked.",
    )
    max_windows: int | None = Field(
        None, description="Of a set, evenly spread; all of them when absent."
    )
    frames_per_step: int | None = Field(
        None,
        description="Frame numbers between two steps, for recordings in ETH/UCY text; default 10.",
    )

    def to_config(self) -> EvaluationConfig:
        """The configuration as the core takes it."""
        return EvaluationConfig(
            models=self.models,
            dataset=self.dataset,
            sets=self.sets,
            protocol=self.protocol,
            num_samples=self.num_samples,
            seed=self.seed,
            in_sample=self.in_sample,
            max_windows=self.max_windows,
            frames_per_step=self.frames_per_step,
        )


class EvaluationProgress(Answer):
    """How far an evaluation is."""

    share: float = Field(description="Of the work, 0 to 1.")
    windows_done: int = Field(description="Windows judged, each once for every model.")
    windows_total: int = Field(description="Of as many; 0 before they are known.")
    model: str = Field(description="The model being judged; empty before the first.")
    set: str = Field(description="The set it is judged on; empty before the first.")
    seconds_left: float | None = Field(description="Expected until the end; null while unknown.")


class Evaluation(Answer):
    """One batch evaluation."""

    id: str = Field(description="As chosen, or assigned by the server.")
    models: list[str] = Field(description="The models and baselines compared.")
    dataset: str = Field(description="The data set; empty for files sent along.")
    sets: list[str] = Field(description="The sets judged on; files are sets by themselves.")
    files: list[str] = Field(description="The recordings sent along.")
    protocol: EvaluationProtocol = Field(description="How windows are cut.")
    num_samples: int = Field(description="Futures drawn for each agent.")
    seed: int = Field(description="Of the samples.")
    in_sample: bool = Field(description="Whether models may be judged on what they have seen.")
    max_windows: int | None = Field(description="Of a set; null for all.")
    frames_per_step: int = Field(description="Of recordings in ETH/UCY text.")
    state: EvaluationState = Field(description="Where it is in its life.")
    progress: EvaluationProgress = Field(description="How far it is.")
    error: str = Field(description="Of one that failed: what went wrong; else empty.")
    create_time: datetime = Field(description="RFC 3339, UTC.")
    start_time: datetime | None = Field(description="When it left the queue; null before.")
    end_time: datetime | None = Field(description="Null before the end.")


class Evaluations(Answer):
    """A page of evaluations, the newest first."""

    evaluations: list[Evaluation] = Field(description="The newest first.")
    next_page_token: str = Field(description="Empty on the last page.")


def evaluation_json(info: EvaluationInfo) -> dict[str, Any]:
    """An evaluation as ``Evaluation`` describes it."""
    config, progress = info.config, info.progress
    return {
        "id": info.id,
        "models": config.models,
        "dataset": config.dataset,
        "sets": config.sets,
        "files": info.files,
        "protocol": config.protocol.value,
        "num_samples": config.num_samples,
        "seed": config.seed,
        "in_sample": config.in_sample,
        "max_windows": config.max_windows,
        "frames_per_step": config.frames_per_step,
        "state": info.state.value,
        "progress": {
            "share": progress.share,
            "windows_done": progress.windows_done,
            "windows_total": progress.windows_total,
            "model": progress.model,
            "set": progress.set,
            "seconds_left": progress.seconds_left,
        },
        "error": info.error,
        "create_time": rfc3339(info.created_at),
        "start_time": None if info.started_at is None else rfc3339(info.started_at),
        "end_time": None if info.ended_at is None else rfc3339(info.ended_at),
    }
