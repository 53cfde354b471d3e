"""Evaluations over gRPC: decode, call the use cases, encode."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import aclosing
from typing import Any

import grpc
from google.protobuf import duration_pb2, timestamp_pb2

from trajectron_proto.v1 import evaluation_pb2 as pb
from trajectron_proto.v1 import evaluation_pb2_grpc
from trajectron_service.errors import invalid
from trajectron_service.evaluations.jobs import Evaluations
from trajectron_service.evaluations.messages import (
    EvaluationConfig,
    EvaluationInfo,
    EvaluationProgress,
    EvaluationProtocol,
    EvaluationState,
    RecordingFile,
    ResultFormat,
)

# The handler's request and answer types differ from method to method.
Context = grpc.aio.ServicerContext[Any, Any]

_PROTOCOLS = {
    pb.EVALUATION_PROTOCOL_UNSPECIFIED: EvaluationProtocol.SGAN,
    pb.EVALUATION_PROTOCOL_SGAN: EvaluationProtocol.SGAN,
    pb.EVALUATION_PROTOCOL_ALL: EvaluationProtocol.ALL,
    pb.EVALUATION_PROTOCOL_STREAMING: EvaluationProtocol.STREAMING,
    pb.EVALUATION_PROTOCOL_PAPER: EvaluationProtocol.PAPER,
}
_PROTOCOLS_OUT = {
    EvaluationProtocol.SGAN: pb.EVALUATION_PROTOCOL_SGAN,
    EvaluationProtocol.ALL: pb.EVALUATION_PROTOCOL_ALL,
    EvaluationProtocol.STREAMING: pb.EVALUATION_PROTOCOL_STREAMING,
    EvaluationProtocol.PAPER: pb.EVALUATION_PROTOCOL_PAPER,
}
_STATES_OUT = {
    EvaluationState.QUEUED: pb.EVALUATION_STATE_QUEUED,
    EvaluationState.RUNNING: pb.EVALUATION_STATE_RUNNING,
    EvaluationState.SUCCEEDED: pb.EVALUATION_STATE_SUCCEEDED,
    EvaluationState.FAILED: pb.EVALUATION_STATE_FAILED,
    EvaluationState.CANCELLED: pb.EVALUATION_STATE_CANCELLED,
}
_FORMATS = {
    pb.EVALUATION_RESULT_FORMAT_UNSPECIFIED: ResultFormat.JSON,
    pb.EVALUATION_RESULT_FORMAT_JSON: ResultFormat.JSON,
    pb.EVALUATION_RESULT_FORMAT_CSV: ResultFormat.CSV,
    pb.EVALUATION_RESULT_FORMAT_HTML: ResultFormat.HTML,
}


class GrpcEvaluations(evaluation_pb2_grpc.EvaluationServiceServicer):
    """The use cases over gRPC; each method is one RPC of ``trajectron.v1``."""

    def __init__(self, evaluations: Evaluations) -> None:
        self._evaluations = evaluations

    async def CreateEvaluation(  # noqa: N802  the contract's name, here and below
        self, request: pb.CreateEvaluationRequest, _context: Context
    ) -> pb.CreateEvaluationResponse:
        """Queues an evaluation."""
        info = await self._evaluations.create(
            request.evaluation_id,
            _config(request.config),
            tuple(RecordingFile(file.name, file.content) for file in request.files),
            request.request_id,
        )
        return pb.CreateEvaluationResponse(evaluation=evaluation_message(info))

    async def GetEvaluation(  # noqa: N802
        self, request: pb.GetEvaluationRequest, _context: Context
    ) -> pb.GetEvaluationResponse:
        """An evaluation as it is now."""
        info = await self._evaluations.get(request.evaluation_id)
        return pb.GetEvaluationResponse(evaluation=evaluation_message(info))

    async def ListEvaluations(  # noqa: N802
        self, request: pb.ListEvaluationsRequest, _context: Context
    ) -> pb.ListEvaluationsResponse:
        """The evaluations, the newest first, a page at a time."""
        infos, token = await self._evaluations.list_page(
            request.page_size if request.HasField("page_size") else None, request.page_token
        )
        return pb.ListEvaluationsResponse(
            evaluations=[evaluation_message(info) for info in infos], next_page_token=token
        )

    async def WatchEvaluation(  # noqa: N802
        self, request: pb.WatchEvaluationRequest, _context: Context
    ) -> AsyncIterator[pb.WatchEvaluationResponse]:
        """An evaluation now, and again whenever it has changed, until it has ended."""
        async with aclosing(self._evaluations.watch(request.evaluation_id)) as infos:
            async for info in infos:
                yield pb.WatchEvaluationResponse(evaluation=evaluation_message(info))

    async def CancelEvaluation(  # noqa: N802
        self, request: pb.CancelEvaluationRequest, _context: Context
    ) -> pb.CancelEvaluationResponse:
        """Ends an evaluation."""
        info = await self._evaluations.cancel(request.evaluation_id)
        return pb.CancelEvaluationResponse(evaluation=evaluation_message(info))

    async def DeleteEvaluation(  # noqa: N802
        self, request: pb.DeleteEvaluationRequest, _context: Context
    ) -> pb.DeleteEvaluationResponse:
        """Removes an evaluation and its files."""
        await self._evaluations.delete(request.evaluation_id)
        return pb.DeleteEvaluationResponse()

    async def GetEvaluationResult(  # noqa: N802
        self, request: pb.GetEvaluationResultRequest, _context: Context
    ) -> pb.GetEvaluationResultResponse:
        """The result of an evaluation that has succeeded."""
        if request.format not in _FORMATS:
            raise invalid("format", f"{request.format} is not an EvaluationResultFormat")
        result = await self._evaluations.result(request.evaluation_id, _FORMATS[request.format])
        return pb.GetEvaluationResultResponse(
            content=result.content, content_type=result.content_type
        )


def _config(message: pb.EvaluationConfig) -> EvaluationConfig:
    if message.protocol not in _PROTOCOLS:
        raise invalid("config.protocol", f"{message.protocol} is not an EvaluationProtocol")
    return EvaluationConfig(
        models=tuple(message.models),
        dataset=message.dataset,
        sets=tuple(message.sets),
        protocol=_PROTOCOLS[message.protocol],
        num_samples=message.num_samples if message.HasField("num_samples") else None,
        seed=message.seed if message.HasField("seed") else None,
        in_sample=message.in_sample,
        max_windows=message.max_windows if message.HasField("max_windows") else None,
        frames_per_step=message.frames_per_step if message.HasField("frames_per_step") else None,
    )


def evaluation_message(info: EvaluationInfo) -> pb.Evaluation:
    """An evaluation as clients see it."""
    config = info.config
    return pb.Evaluation(
        id=info.id,
        config=pb.EvaluationConfig(
            models=config.models,
            dataset=config.dataset,
            sets=config.sets,
            protocol=_PROTOCOLS_OUT[config.protocol],
            num_samples=config.num_samples,
            seed=config.seed,
            in_sample=config.in_sample,
            max_windows=config.max_windows,
            frames_per_step=config.frames_per_step,
        ),
        files=info.files,
        state=_STATES_OUT[info.state],
        progress=_progress(info.progress),
        error=info.error,
        create_time=_instant(info.created_at),
        start_time=_instant(info.started_at),
        end_time=_instant(info.ended_at),
    )


def _progress(progress: EvaluationProgress) -> pb.EvaluationProgress:
    left = None
    if progress.seconds_left is not None:
        left = duration_pb2.Duration()
        left.FromMilliseconds(round(progress.seconds_left * 1e3))
    return pb.EvaluationProgress(
        share=progress.share,
        windows_done=progress.windows_done,
        windows_total=progress.windows_total,
        model=progress.model,
        set=progress.set,
        time_left=left,
    )


def _instant(unix_s: float | None) -> timestamp_pb2.Timestamp | None:
    if unix_s is None:
        return None
    instant = timestamp_pb2.Timestamp()
    instant.FromMilliseconds(round(unix_s * 1e3))
    return instant
