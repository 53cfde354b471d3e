"""The gRPC adapter: decode, call the application, encode.

``GrpcInterceptor`` stands around it: it turns errors into statuses and measures calls.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import aclosing, closing
from typing import Any, cast

import grpc

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_proto.v1 import trajectron_pb2_grpc
from trajectron_service import grpc_convert as convert
from trajectron_service import messages as core
from trajectron_service.application import Application
from trajectron_service.errors import invalid
from trajectron_service.grpc_errors import status_message

# The handler's request and answer types differ from method to method.
Context = grpc.aio.ServicerContext[Any, Any]


class GrpcApi(trajectron_pb2_grpc.TrajectronServiceServicer):
    """The use cases over gRPC; each method is one RPC of ``trajectron.v1``."""

    def __init__(self, application: Application) -> None:
        self._application = application

    async def Predict(  # noqa: N802  the contract's name, here and below
        self, request: pb.PredictRequest, context: Context
    ) -> pb.PredictResponse:
        """Stateless: a scene's history in, futures out."""
        interval = (
            convert.seconds(request.frame_interval) if request.HasField("frame_interval") else None
        )
        forecast = await self._application.predict(
            model=request.model or None,
            frames=convert.frames(request.frames),
            options=convert.forecast_options(request.options),
            unknown_types=convert.unknown_types(request.unknown_types),
            type_map=dict(request.type_map),
            frame_interval_s=interval,
            deadline=_deadline(context),
        )
        return pb.PredictResponse(forecast=convert.forecast_message(forecast))

    async def CreateSession(  # noqa: N802
        self, request: pb.CreateSessionRequest, _context: Context
    ) -> pb.CreateSessionResponse:
        """Opens a session."""
        session = await self._application.create_session(
            request.session_id or None, convert.session_config(request.config)
        )
        return pb.CreateSessionResponse(session=convert.session_message(session))

    async def GetSession(  # noqa: N802
        self, request: pb.GetSessionRequest, _context: Context
    ) -> pb.GetSessionResponse:
        """A session with its graph."""
        session, graph = await self._application.get_session(request.session_id)
        return pb.GetSessionResponse(
            session=convert.session_message(session), graph=convert.graph_message(graph)
        )

    async def ListSessions(  # noqa: N802
        self, request: pb.ListSessionsRequest, _context: Context
    ) -> pb.ListSessionsResponse:
        """Open sessions in order of id, a page at a time."""
        sessions, token = await self._application.list_sessions(
            request.page_size if request.HasField("page_size") else None, request.page_token
        )
        return pb.ListSessionsResponse(
            sessions=[convert.session_message(session) for session in sessions],
            next_page_token=token,
        )

    async def DeleteSession(  # noqa: N802
        self, request: pb.DeleteSessionRequest, _context: Context
    ) -> pb.DeleteSessionResponse:
        """Closes a session and forgets its state."""
        await self._application.delete_session(request.session_id)
        return pb.DeleteSessionResponse()

    async def Observe(  # noqa: N802
        self, request: pb.ObserveRequest, context: Context
    ) -> pb.ObserveResponse:
        """Pushes one or several frames, in order."""
        results = await self._application.observe(
            request.session_id, convert.frames(request.frames), _deadline(context)
        )
        return pb.ObserveResponse(results=[convert.result_message(result) for result in results])

    async def PredictSession(  # noqa: N802
        self, request: pb.PredictSessionRequest, context: Context
    ) -> pb.PredictSessionResponse:
        """Futures from the session's newest frame."""
        forecast = await self._application.predict_session(
            request.session_id, convert.forecast_options(request.options), _deadline(context)
        )
        return pb.PredictSessionResponse(forecast=convert.forecast_message(forecast))

    async def StreamPredict(  # noqa: N802
        self, request_iterator: AsyncIterator[pb.StreamPredictRequest], _context: Context
    ) -> AsyncIterator[pb.StreamPredictResponse]:
        """Frames in, one reply per frame out, in order."""
        requests = aiter(request_iterator)
        first = await anext(requests, pb.StreamPredictRequest())
        if first.WhichOneof("message") != "open":
            raise invalid("open", "must be the first message of a stream")
        stream = await self._application.open_stream(
            first.open.session_id or None,
            convert.session_config(first.open.config),
            convert.stream_options(first.open),
        )
        with closing(stream):
            yield pb.StreamPredictResponse(
                opened=pb.StreamOpened(
                    session=convert.session_message(stream.session), resumed=stream.resumed
                )
            )
            async with aclosing(stream.replies(_frames(requests))) as replies:
                async for reply in replies:
                    yield pb.StreamPredictResponse(reply=_reply_message(reply))

    async def ListModels(  # noqa: N802
        self, _request: pb.ListModelsRequest, _context: Context
    ) -> pb.ListModelsResponse:
        """The models that this server can run."""
        models = self._application.list_models()
        return pb.ListModelsResponse(models=[convert.model_message(model) for model in models])


def _deadline(context: Context) -> float | None:
    """When the client gives up, on ``time.monotonic``."""
    # None without a deadline, whatever the stubs say.
    remaining_s = cast("float | None", context.time_remaining())
    return None if remaining_s is None else time.monotonic() + remaining_s


async def _frames(
    requests: AsyncIterator[pb.StreamPredictRequest],
) -> AsyncIterator[core.StreamFrame]:
    async for request in requests:
        if request.WhichOneof("message") != "frame":
            raise invalid("frame", "every message after the first must bring a frame")
        yield convert.stream_frame(request.frame)


def _reply_message(reply: core.StreamReply) -> pb.StreamFrameReply:
    return pb.StreamFrameReply(
        sequence=reply.sequence,
        result=convert.result_message(reply.result),
        forecast=convert.forecast_message(reply.forecast) if reply.forecast else None,
        superseded=reply.superseded,
        error=status_message(reply.error) if reply.error else None,
    )
