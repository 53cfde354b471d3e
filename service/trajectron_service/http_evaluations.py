"""Evaluations over HTTP: decode, call the use cases, encode."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated

import orjson
from fastapi import Header, Query
from fastapi.sse import KEEPALIVE_COMMENT, EventSourceResponse, format_sse_event
from starlette.requests import Request
from starlette.responses import Response

from trajectron_proto.v1 import evaluation_pb2 as pb
from trajectron_service import passes
from trajectron_service.errors import ServiceError
from trajectron_service.evaluations.jobs import Evaluations
from trajectron_service.evaluations.messages import EvaluationInfo, ResultFormat
from trajectron_service.grpc_evaluations import evaluation_message
from trajectron_service.http_api import respond
from trajectron_service.http_body import while_connected
from trajectron_service.http_errors import problem_of
from trajectron_service.http_evaluation_schemas import CreateEvaluationRequest, evaluation_json
from trajectron_service.http_forms import read_form

# Proxies close connections on which nothing moves for a minute.
_PING_S = 15.0
_EVENTS_HEADERS = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}
# A report shows names that clients chose: it is text and drawings, and nothing of it runs.
_RESULT_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:",
    "X-Content-Type-Options": "nosniff",
}


class HttpEvaluations:
    """The use cases over HTTP; ``http_evaluation_routes`` says at which paths.

    Args:
        evaluations: the core.
        max_body_bytes: larger bodies are refused while they are read.
    """

    def __init__(self, evaluations: Evaluations, max_body_bytes: int) -> None:
        self._evaluations = evaluations
        self._max_body_bytes = max_body_bytes

    async def create(
        self,
        request: Request,
        idempotency_key: Annotated[
            str,
            Header(
                description="1 to 128 characters: sent again with the same request it gives the "
                "evaluation that the first one made."
            ),
        ] = "",
    ) -> Response:
        """Queues an evaluation: of a data set that the server knows, or of files sent along.

        Files come as `multipart/form-data`: `evaluation` holds the JSON, each `files` one
        recording, CSV (`time,id,type,x,y`) or ETH/UCY text. A file that cannot be read is
        refused with its line.
        """
        body, files = await read_form(
            request, CreateEvaluationRequest, "evaluation", self._max_body_bytes
        )
        work = self._evaluations.create(
            body.evaluation_id, body.to_config(), files, idempotency_key
        )
        info = await while_connected(request, work)
        answer = respond(
            request,
            lambda: evaluation_json(info),
            lambda: pb.CreateEvaluationResponse(evaluation=evaluation_message(info)),
        )
        answer.status_code = 201
        answer.headers["Location"] = f"/v1/evaluations/{info.id}"
        return answer

    async def list_page(
        self,
        request: Request,
        page_size: Annotated[
            int | None, Query(description="Evaluations on a page, 1 to 1000; default 100.")
        ] = None,
        page_token: Annotated[
            str, Query(description="`next_page_token` of the page before; empty for the first.")
        ] = "",
    ) -> Response:
        """Lists evaluations, the newest first, a page at a time."""
        infos, token = await self._evaluations.list_page(page_size, page_token)
        return respond(
            request,
            lambda: {
                "evaluations": [evaluation_json(info) for info in infos],
                "next_page_token": token,
            },
            lambda: pb.ListEvaluationsResponse(
                evaluations=[evaluation_message(info) for info in infos], next_page_token=token
            ),
        )

    async def get(self, request: Request, evaluation_id: str) -> Response:
        """An evaluation as it is now."""
        info = await self._evaluations.get(evaluation_id)
        return respond(
            request,
            lambda: evaluation_json(info),
            lambda: pb.GetEvaluationResponse(evaluation=evaluation_message(info)),
        )

    async def watch(self, evaluation_id: str) -> Response:
        """The evaluation now, and again whenever it has changed, as server-sent events.

        Each event `evaluation` holds the evaluation as JSON; the stream ends after the one that
        shows its end. An event `problem` says why it ends before: the evaluation was deleted,
        the token has expired or was withdrawn, or the service is stopping.
        """
        infos = passes.while_good(self._evaluations.watch(evaluation_id))
        first = await anext(infos)
        return EventSourceResponse(_events(first, infos), headers=_EVENTS_HEADERS)

    async def cancel(self, request: Request, evaluation_id: str) -> Response:
        """Ends an evaluation that is queued or running; one that has ended stays as it is."""
        info = await self._evaluations.cancel(evaluation_id)
        return respond(
            request,
            lambda: evaluation_json(info),
            lambda: pb.CancelEvaluationResponse(evaluation=evaluation_message(info)),
        )

    async def delete(self, evaluation_id: str) -> Response:
        """Removes an evaluation and its files; ends it first where it is running."""
        await self._evaluations.delete(evaluation_id)
        return Response(status_code=204)

    async def result_json(self, evaluation_id: str) -> Response:
        """Everything that was measured, with the fingerprint of what was judged."""
        return await self._result(evaluation_id, ResultFormat.JSON)

    async def result_csv(self, evaluation_id: str) -> Response:
        """What was measured, one figure a line."""
        return await self._result(evaluation_id, ResultFormat.CSV)

    async def report(self, evaluation_id: str) -> Response:
        """A page with tables and figures, complete in itself."""
        return await self._result(evaluation_id, ResultFormat.HTML)

    async def _result(self, evaluation_id: str, form: ResultFormat) -> Response:
        result = await self._evaluations.result(evaluation_id, form)
        headers = _RESULT_HEADERS | {"Content-Type": result.content_type}
        return Response(result.content, headers=headers)


async def _events(
    first: EvaluationInfo, others: AsyncIterator[EvaluationInfo]
) -> AsyncIterator[bytes]:
    yield _event(first)
    coming = asyncio.ensure_future(anext(others, None))
    try:
        while True:
            await asyncio.wait({coming}, timeout=_PING_S)
            if not coming.done():
                yield KEEPALIVE_COMMENT
                continue
            info = coming.result()
            if info is None:
                return
            yield _event(info)
            coming = asyncio.ensure_future(anext(others, None))
    except ServiceError as error:
        problem = orjson.dumps(problem_of(error).model_dump()).decode()
        yield format_sse_event(event="problem", data_str=problem)
    finally:
        coming.cancel()


def _event(info: EvaluationInfo) -> bytes:
    data = orjson.dumps(evaluation_json(info)).decode()
    return format_sse_event(event="evaluation", data_str=data)
