"""One way to ask for evaluations over either transport; answers are as in the JSON API."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import grpc
import httpx
from google.protobuf.json_format import MessageToDict
from tests.contract.drivers import Json, grpc_refusal, http_refusal

from trajectron_proto.v1 import evaluation_pb2 as pb
from trajectron_proto.v1.evaluation_pb2_grpc import EvaluationServiceStub

if TYPE_CHECKING:
    from trajectron_proto.v1.evaluation_pb2_grpc import EvaluationServiceAsyncStub

Files = Mapping[str, bytes]


class EvaluationDriver(Protocol):
    """The use cases of evaluations, over some transport."""

    name: str

    async def create(
        self, files: Files | None = None, request_id: str = "", **fields: Any
    ) -> Json: ...

    async def get(self, evaluation_id: str) -> Json: ...

    async def list_page(self, page_size: int | None = None, page_token: str = "") -> Json: ...

    def watch(self, evaluation_id: str) -> AsyncIterator[Json]: ...

    async def cancel(self, evaluation_id: str) -> Json: ...

    async def delete(self, evaluation_id: str) -> None: ...

    async def result(self, evaluation_id: str, form: str) -> tuple[bytes, str]: ...


class HttpEvaluationDriver:
    """Over HTTP."""

    name = "http"

    def __init__(self, client: httpx.AsyncClient) -> None:
        self.client = client

    async def create(self, files: Files | None = None, request_id: str = "", **fields: Any) -> Json:
        headers = {"Idempotency-Key": request_id} if request_id else {}
        if files is None:
            return await self._ask("POST", "", json=fields, headers=headers)
        form: list[tuple[str, Any]] = [("evaluation", (None, json.dumps(fields)))]
        form += [("files", (name, content)) for name, content in files.items()]
        return await self._ask("POST", "", files=form, headers=headers)

    async def get(self, evaluation_id: str) -> Json:
        return await self._ask("GET", f"/{evaluation_id}")

    async def list_page(self, page_size: int | None = None, page_token: str = "") -> Json:
        parameters: Json = {"page_token": page_token}
        if page_size is not None:
            parameters["page_size"] = page_size
        return await self._ask("GET", "", params=parameters)

    async def watch(self, evaluation_id: str) -> AsyncIterator[Json]:
        path = f"/v1/evaluations/{evaluation_id}:watch"
        async with self.client.stream("GET", path) as answer:
            if answer.is_error:
                await answer.aread()
                raise http_refusal(answer)
            assert answer.headers["content-type"].startswith("text/event-stream")
            kind = ""
            async for line in answer.aiter_lines():
                if line.startswith("event: "):
                    kind = line.removeprefix("event: ")
                elif line.startswith("data: "):
                    assert kind == "evaluation", line
                    yield json.loads(line.removeprefix("data: "))

    async def cancel(self, evaluation_id: str) -> Json:
        return await self._ask("POST", f"/{evaluation_id}:cancel")

    async def delete(self, evaluation_id: str) -> None:
        await self._ask("DELETE", f"/{evaluation_id}")

    async def result(self, evaluation_id: str, form: str) -> tuple[bytes, str]:
        name = "report.html" if form == "html" else f"result.{form}"
        answer = await self.client.get(f"/v1/evaluations/{evaluation_id}/{name}")
        if answer.is_error:
            raise http_refusal(answer)
        return answer.content, answer.headers["content-type"]

    async def _ask(self, verb: str, path: str, **request: Any) -> Json:
        answer = await self.client.request(verb, f"/v1/evaluations{path}", **request)
        if answer.is_error:
            raise http_refusal(answer)
        value: Json = answer.json() if answer.content else {}
        return value


class GrpcEvaluationDriver:
    """Over gRPC."""

    name = "grpc"

    def __init__(self, channel: grpc.aio.Channel) -> None:
        self.stub: EvaluationServiceAsyncStub = EvaluationServiceStub(channel)

    async def create(self, files: Files | None = None, request_id: str = "", **fields: Any) -> Json:
        evaluation_id = fields.pop("evaluation_id", "")
        if "protocol" in fields:
            fields["protocol"] = f"EVALUATION_PROTOCOL_{fields['protocol'].upper()}"
        request = pb.CreateEvaluationRequest(
            evaluation_id=evaluation_id,
            config=pb.EvaluationConfig(**fields),
            files=[pb.RecordingFile(name=n, content=c) for n, c in (files or {}).items()],
            request_id=request_id,
        )
        return _view((await _answer(self.stub.CreateEvaluation(request))).evaluation)

    async def get(self, evaluation_id: str) -> Json:
        request = pb.GetEvaluationRequest(evaluation_id=evaluation_id)
        return _view((await _answer(self.stub.GetEvaluation(request))).evaluation)

    async def list_page(self, page_size: int | None = None, page_token: str = "") -> Json:
        request = pb.ListEvaluationsRequest(page_size=page_size, page_token=page_token)
        answer = await _answer(self.stub.ListEvaluations(request))
        return {
            "evaluations": [_view(one) for one in answer.evaluations],
            "next_page_token": answer.next_page_token,
        }

    async def watch(self, evaluation_id: str) -> AsyncIterator[Json]:
        call: Any = self.stub.WatchEvaluation(
            pb.WatchEvaluationRequest(evaluation_id=evaluation_id)
        )
        try:
            async for reply in call:
                yield _view(reply.evaluation)
        except grpc.aio.AioRpcError as error:
            raise grpc_refusal(error) from None

    async def cancel(self, evaluation_id: str) -> Json:
        request = pb.CancelEvaluationRequest(evaluation_id=evaluation_id)
        return _view((await _answer(self.stub.CancelEvaluation(request))).evaluation)

    async def delete(self, evaluation_id: str) -> None:
        request = pb.DeleteEvaluationRequest(evaluation_id=evaluation_id)
        await _answer(self.stub.DeleteEvaluation(request))

    async def result(self, evaluation_id: str, form: str) -> tuple[bytes, str]:
        request = pb.GetEvaluationResultRequest(
            evaluation_id=evaluation_id,
            format=pb.EvaluationResultFormat.Value(f"EVALUATION_RESULT_FORMAT_{form.upper()}"),
        )
        answer = await _answer(self.stub.GetEvaluationResult(request))
        return answer.content, answer.content_type


async def _answer(call: Any) -> Any:
    try:
        return await call
    except grpc.aio.AioRpcError as error:
        raise grpc_refusal(error) from None


def _view(message: pb.Evaluation) -> Json:
    """An evaluation in the shape of the JSON API."""
    seen: Json = MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
    config = seen.pop("config")
    left = message.progress.time_left
    timed = message.progress.HasField("time_left")
    progress = seen["progress"] | {
        "windows_done": message.progress.windows_done,
        "windows_total": message.progress.windows_total,
        "seconds_left": left.seconds + left.nanos * 1e-9 if timed else None,
    }
    progress.pop("time_left", None)
    return {
        "start_time": None,
        "end_time": None,
        "max_windows": None,
        **config,
        **seen,
        "protocol": config["protocol"].removeprefix("EVALUATION_PROTOCOL_").lower(),
        "state": seen["state"].removeprefix("EVALUATION_STATE_").lower(),
        "seed": message.config.seed,
        "progress": progress,
    }
