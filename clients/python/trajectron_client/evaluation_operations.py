"""The calls about evaluations as data, as ``operations`` has those about forecasts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from trajectron_client import evaluations
from trajectron_client.evaluations import (
    Evaluation,
    EvaluationOptions,
    RecordingFile,
    ResultFormat,
)
from trajectron_client.operations import Operation
from trajectron_proto.v1 import evaluation_pb2 as pb

SERVICE = "trajectron.v1.EvaluationService"

_RESULTS: dict[ResultFormat, str] = {
    "json": "result.json",
    "csv": "result.csv",
    "html": "report.html",
}


def create(
    models: Sequence[str],
    files: Sequence[RecordingFile | str | Path],
    options: EvaluationOptions,
) -> Operation[Evaluation]:
    """Queue an evaluation."""
    names = tuple(models)
    read = [f if isinstance(f, RecordingFile) else RecordingFile.read(f) for f in files]
    key = options.get("request_id")
    return Operation(
        "CreateEvaluation",
        lambda: evaluations.create_message(names, read, **options),
        _one,
        "POST",
        "/v1/evaluations",
        evaluations.from_body,
        lambda: evaluations.create_body(names, **options),
        service=SERVICE,
        files=lambda: ("evaluation", [(file.name, file.content) for file in read]),
        headers={} if key is None else {"Idempotency-Key": key},
    )


def get(evaluation_id: str) -> Operation[Evaluation]:
    """An evaluation as it is now."""
    return Operation(
        "GetEvaluation",
        lambda: pb.GetEvaluationRequest(evaluation_id=evaluation_id),
        _one,
        "GET",
        path(evaluation_id),
        evaluations.from_body,
        service=SERVICE,
    )


def list_page(
    page_size: int | None, page_token: str
) -> Operation[tuple[tuple[Evaluation, ...], str]]:
    """One page of the evaluations, and the token of the next page."""
    params: dict[str, str | int] = {} if page_size is None else {"page_size": page_size}
    if page_token:
        params["page_token"] = page_token
    return Operation(
        "ListEvaluations",
        lambda: pb.ListEvaluationsRequest(page_size=page_size, page_token=page_token),
        lambda reply: (
            tuple(evaluations.from_message(one) for one in reply.evaluations),
            reply.next_page_token,
        ),
        "GET",
        "/v1/evaluations",
        lambda reply: (
            tuple(evaluations.from_body(one) for one in reply["evaluations"]),
            reply["next_page_token"],
        ),
        params=params,
        service=SERVICE,
    )


def cancel(evaluation_id: str) -> Operation[Evaluation]:
    """End an evaluation."""
    return Operation(
        "CancelEvaluation",
        lambda: pb.CancelEvaluationRequest(evaluation_id=evaluation_id),
        _one,
        "POST",
        f"{path(evaluation_id)}:cancel",
        evaluations.from_body,
        service=SERVICE,
    )


def delete(evaluation_id: str) -> Operation[None]:
    """Remove an evaluation."""
    return Operation(
        "DeleteEvaluation",
        lambda: pb.DeleteEvaluationRequest(evaluation_id=evaluation_id),
        lambda _: None,
        "DELETE",
        path(evaluation_id),
        lambda _: None,
        service=SERVICE,
    )


def result(evaluation_id: str, form: ResultFormat) -> Operation[bytes]:
    """The result of an evaluation."""
    return Operation(
        "GetEvaluationResult",
        lambda: pb.GetEvaluationResultRequest(
            evaluation_id=evaluation_id,
            format=pb.EvaluationResultFormat.Value(f"EVALUATION_RESULT_FORMAT_{form.upper()}"),
        ),
        lambda reply: bytes(reply.content),
        "GET",
        f"{path(evaluation_id)}/{_RESULTS[form]}",
        bytes,
        service=SERVICE,
        raw=True,
    )


def path(evaluation_id: str) -> str:
    """Where an evaluation is over HTTP."""
    return f"/v1/evaluations/{quote(evaluation_id, safe='')}"


def _one(reply: Any) -> Evaluation:
    return evaluations.from_message(reply.evaluation)
