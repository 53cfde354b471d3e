"""The service's unary calls as data: what to send and how to read the answer, on both transports.

The clients only carry an operation out, so all of them take and return the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar
from urllib.parse import quote

from google.protobuf.message import Message

from trajectron_client import json_bodies, protobuf
from trajectron_client.forecast import Forecast
from trajectron_client.replies import FrameResult, ModelInfo, SessionInfo, SessionSnapshot
from trajectron_client.scene import ForecastOptions, Frame, SessionOptions, UnknownTypes
from trajectron_proto.v1 import trajectron_pb2 as pb

T = TypeVar("T")
Json = dict[str, Any]
SERVICE = "trajectron.v1.TrajectronService"


def _no_body() -> None:
    return None


def _no_params() -> Mapping[str, str | int]:
    return {}


def _no_headers() -> Mapping[str, str]:
    return {}


def _no_files() -> tuple[str, Sequence[tuple[str, bytes]]]:
    return "", ()


@dataclass(frozen=True)
class Operation(Generic[T]):
    """One call.

    Attributes:
        rpc: the method's name in the contract.
        message: makes its request.
        from_message: reads its response.
        verb: the HTTP verb.
        path: the HTTP path.
        body: makes the JSON body; None for none.
        params: the query's parameters.
        from_body: reads the JSON answer.
        service: the contract's service that has the method.
        raw: whether ``from_body`` takes the answer's bytes as they are.
        files: for a form: the field that holds the JSON, and names and contents of files.
        headers: sent along over HTTP.
    """

    rpc: str
    message: Callable[[], Message]
    from_message: Callable[[Any], T]
    verb: str
    path: str
    from_body: Callable[[Any], T]
    body: Callable[[], Json | None] = _no_body
    params: Mapping[str, str | int] = field(default_factory=_no_params)
    service: str = SERVICE
    raw: bool = False
    files: Callable[[], tuple[str, Sequence[tuple[str, bytes]]]] = _no_files
    headers: Mapping[str, str] = field(default_factory=_no_headers)


def predict(
    frames: Iterable[Frame],
    *,
    model: str | None,
    unknown_types: UnknownTypes,
    type_map: Mapping[str, str] | None,
    frame_interval_s: float | None,
    options: ForecastOptions,
) -> Operation[Forecast]:
    """Forecast from a scene's history."""
    history = tuple(frames)

    def message() -> pb.PredictRequest:
        return pb.PredictRequest(
            model=model or "",
            frames=[protobuf.frame(frame) for frame in history],
            options=protobuf.forecast_options(**options),
            unknown_types=protobuf.unknown_types(unknown_types),
            type_map=type_map or {},
            frame_interval=protobuf.duration(frame_interval_s),
        )

    def body() -> Json:
        optional = {"model": model, "frame_interval_s": frame_interval_s}
        return {
            "frames": [json_bodies.frame(frame) for frame in history],
            "unknown_types": unknown_types,
            "type_map": dict(type_map or {}),
            **{name: value for name, value in optional.items() if value is not None},
            **json_bodies.forecast_options(**options),
        }

    return Operation(
        "Predict",
        message,
        lambda reply: protobuf.to_forecast(reply.forecast),
        "POST",
        "/v1/predict",
        json_bodies.to_forecast,
        body,
    )


def create_session(session_id: str | None, options: SessionOptions) -> Operation[SessionInfo]:
    """Open a session."""

    def body() -> Json:
        named = {} if session_id is None else {"session_id": session_id}
        return named | json_bodies.session_options(**options)

    return Operation(
        "CreateSession",
        lambda: pb.CreateSessionRequest(
            session_id=session_id or "", config=protobuf.session_config(**options)
        ),
        lambda reply: protobuf.to_session_info(reply.session),
        "POST",
        "/v1/sessions",
        json_bodies.to_session_info,
        body,
    )


def get_session(session_id: str) -> Operation[SessionSnapshot]:
    """A session with its graph."""
    return Operation(
        "GetSession",
        lambda: pb.GetSessionRequest(session_id=session_id),
        protobuf.to_session_snapshot,
        "GET",
        _session_path(session_id),
        json_bodies.to_session_snapshot,
    )


def list_sessions(
    page_size: int | None, page_token: str
) -> Operation[tuple[tuple[SessionInfo, ...], str]]:
    """One page of the open sessions, and the token of the next page."""
    params: dict[str, str | int] = {} if page_size is None else {"page_size": page_size}
    if page_token:
        params["page_token"] = page_token
    return Operation(
        "ListSessions",
        lambda: pb.ListSessionsRequest(page_size=page_size, page_token=page_token),
        lambda reply: (
            tuple(protobuf.to_session_info(session) for session in reply.sessions),
            reply.next_page_token,
        ),
        "GET",
        "/v1/sessions",
        lambda reply: (
            tuple(json_bodies.to_session_info(session) for session in reply["sessions"]),
            reply["next_page_token"],
        ),
        params=params,
    )


def delete_session(session_id: str) -> Operation[None]:
    """Close a session."""
    return Operation(
        "DeleteSession",
        lambda: pb.DeleteSessionRequest(session_id=session_id),
        lambda _: None,
        "DELETE",
        _session_path(session_id),
        lambda _: None,
    )


def observe(session_id: str, frames: Iterable[Frame]) -> Operation[tuple[FrameResult, ...]]:
    """Push frames to a session."""
    batch = tuple(frames)
    return Operation(
        "Observe",
        lambda: pb.ObserveRequest(
            session_id=session_id, frames=[protobuf.frame(frame) for frame in batch]
        ),
        lambda reply: tuple(protobuf.to_frame_result(result) for result in reply.results),
        "POST",
        f"{_session_path(session_id)}:observe",
        lambda reply: tuple(json_bodies.to_frame_result(result) for result in reply["results"]),
        lambda: {"frames": [json_bodies.frame(frame) for frame in batch]},
    )


def predict_session(session_id: str, options: ForecastOptions) -> Operation[Forecast]:
    """Forecast from a session's newest frame."""
    return Operation(
        "PredictSession",
        lambda: pb.PredictSessionRequest(
            session_id=session_id, options=protobuf.forecast_options(**options)
        ),
        lambda reply: protobuf.to_forecast(reply.forecast),
        "POST",
        f"{_session_path(session_id)}:predict",
        json_bodies.to_forecast,
        lambda: json_bodies.forecast_options(**options),
    )


def list_models() -> Operation[tuple[ModelInfo, ...]]:
    """The models that the server can run."""
    return Operation(
        "ListModels",
        pb.ListModelsRequest,
        lambda reply: tuple(protobuf.to_model_info(model) for model in reply.models),
        "GET",
        "/v1/models",
        lambda reply: tuple(json_bodies.to_model_info(model) for model in reply["models"]),
    )


def _session_path(session_id: str) -> str:
    return f"/v1/sessions/{quote(session_id, safe='')}"
