"""The HTTP adapter: decode, call the application, encode.

Forecasts are JSON with absolute positions; whoever sends ``Accept: application/x-protobuf``
gets the same message as over gRPC, with offsets.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import orjson
from fastapi import Query
from google.protobuf.message import Message
from starlette.requests import Request
from starlette.responses import Response

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service import grpc_convert as protobuf
from trajectron_service import http_encode as encode
from trajectron_service.application import Application
from trajectron_service.http_body import read_body, timed, while_connected
from trajectron_service.http_schemas import (
    CreateSessionRequest,
    ObserveRequest,
    PredictRequest,
    PredictSessionRequest,
)

PROTOBUF = "application/x-protobuf"


class HttpApi:
    """The use cases over HTTP; ``http_routes`` says at which paths.

    Args:
        application: the core.
        max_body_bytes: larger bodies are refused while they are read.
    """

    def __init__(self, application: Application, max_body_bytes: int) -> None:
        self._application = application
        self._max_body_bytes = max_body_bytes

    async def predict(self, request: Request) -> Response:
        """Stateless: a scene's history in, futures out. Nothing is kept."""
        body = await read_body(request, PredictRequest, self._max_body_bytes)
        work = self._application.predict(
            model=body.model or None,
            frames=body.to_frames(),
            options=body.to_options(),
            unknown_types=body.unknown_types,
            type_map=body.type_map,
            frame_interval_s=body.frame_interval_s,
            deadline=None,
        )
        forecast = await while_connected(request, work)
        return respond(
            request,
            lambda: encode.forecast_json(forecast),
            lambda: pb.PredictResponse(forecast=protobuf.forecast_message(forecast)),
        )

    async def create_session(self, request: Request) -> Response:
        """Opens a session: a scene whose graph the service keeps between frames."""
        body = await read_body(request, CreateSessionRequest, self._max_body_bytes)
        session = await self._application.create_session(body.session_id or None, body.to_config())
        answer = respond(
            request,
            lambda: encode.session_json(session),
            lambda: pb.CreateSessionResponse(session=protobuf.session_message(session)),
        )
        answer.status_code = 201
        answer.headers["Location"] = f"/v1/sessions/{session.id}"
        return answer

    async def list_sessions(
        self,
        request: Request,
        page_size: Annotated[
            int | None, Query(description="Sessions on a page, 1 to 1000; default 100.")
        ] = None,
        page_token: Annotated[
            str, Query(description="`next_page_token` of the page before; empty for the first.")
        ] = "",
    ) -> Response:
        """Lists open sessions in order of id, a page at a time."""
        sessions, token = await self._application.list_sessions(page_size, page_token)
        return respond(
            request,
            lambda: {
                "sessions": [encode.session_json(session) for session in sessions],
                "next_page_token": token,
            },
            lambda: pb.ListSessionsResponse(
                sessions=[protobuf.session_message(session) for session in sessions],
                next_page_token=token,
            ),
        )

    async def get_session(self, request: Request, session_id: str) -> Response:
        """A session with its graph: nodes, edges, ages, modulation."""
        session, graph = await self._application.get_session(session_id)
        return respond(
            request,
            lambda: encode.session_json(session) | {"graph": encode.graph_json(graph)},
            lambda: pb.GetSessionResponse(
                session=protobuf.session_message(session), graph=protobuf.graph_message(graph)
            ),
        )

    async def delete_session(self, session_id: str) -> Response:
        """Closes a session and forgets its state."""
        await self._application.delete_session(session_id)
        return Response(status_code=204)

    async def observe(self, request: Request, session_id: str) -> Response:
        """Pushes one or several frames, in order.

        Every frame gets its outcome; a refused frame leaves the others and the state
        untouched. A call with a single frame that is refused fails: 409 (conflict, out of
        order) or 422 (invalid).
        """
        body = await read_body(request, ObserveRequest, self._max_body_bytes)
        work = self._application.observe(session_id, body.to_frames(), deadline=None)
        results = await while_connected(request, work)
        return respond(
            request,
            lambda: {"results": [encode.result_json(result) for result in results]},
            lambda: pb.ObserveResponse(
                results=[protobuf.result_message(result) for result in results]
            ),
        )

    async def predict_session(self, request: Request, session_id: str) -> Response:
        """Futures from the session's newest frame; 409 before the first."""
        body = await read_body(request, PredictSessionRequest, self._max_body_bytes)
        work = self._application.predict_session(session_id, body.to_options(), deadline=None)
        forecast = await while_connected(request, work)
        return respond(
            request,
            lambda: encode.forecast_json(forecast),
            lambda: pb.PredictSessionResponse(forecast=protobuf.forecast_message(forecast)),
        )

    async def list_models(self, request: Request) -> Response:
        """The models that this server can run."""
        models = self._application.list_models()
        return respond(
            request,
            lambda: {"models": [encode.model_json(model) for model in models]},
            lambda: pb.ListModelsResponse(
                models=[protobuf.model_message(model) for model in models]
            ),
        )


def json_response(value: dict[str, Any], status: int = 200) -> Response:
    """A JSON answer; numpy arrays and scalars are written as they are."""
    content = orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY)
    return Response(content, status, media_type="application/json")


def respond(
    request: Request, as_json: Callable[[], dict[str, Any]], as_message: Callable[[], Message]
) -> Response:
    """An answer in the form that the request asks for: JSON, or the contract's message."""
    with timed(request, "serialise"):
        if PROTOBUF in request.headers.get("accept", ""):
            return Response(as_message().SerializeToString(), media_type=PROTOBUF)
        return json_response(as_json())
