"""One way to ask the service over either transport, for claims that hold of both.

Requests are written as the JSON API has them; answers come back in the shape of the JSON
API with numpy arrays of absolute positions. Nothing of the service's own code takes part.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import grpc
import httpx
import numpy as np
from google.protobuf.duration_pb2 import Duration
from google.rpc import error_details_pb2, status_pb2

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_proto.v1.trajectron_pb2_grpc import TrajectronServiceStub

if TYPE_CHECKING:
    from trajectron_proto.v1.trajectron_pb2_grpc import TrajectronServiceAsyncStub

Json = dict[str, Any]

_OPTION_NAMES = (
    "mode",
    "num_samples",
    "horizon",
    "seed",
    "agents",
    "include_modes",
    "sampling",
    "deadline_s",
    "allow_fewer_samples",
)

# By kind, written out again here so that a slip in the service's own table shows.
CODES = {
    "INVALID_ARGUMENT": {"http": "422", "grpc": "INVALID_ARGUMENT"},
    "UNKNOWN_SESSION": {"http": "404", "grpc": "NOT_FOUND"},
    "UNKNOWN_MODEL": {"http": "404", "grpc": "NOT_FOUND"},
    "UNKNOWN_AGENT": {"http": "404", "grpc": "NOT_FOUND"},
    "SESSION_EXISTS": {"http": "409", "grpc": "ALREADY_EXISTS"},
    "FRAME_CONFLICT": {"http": "409", "grpc": "FAILED_PRECONDITION"},
    "FRAME_OUT_OF_ORDER": {"http": "409", "grpc": "FAILED_PRECONDITION"},
    "NO_FRAMES": {"http": "409", "grpc": "FAILED_PRECONDITION"},
    "TOO_MANY_SESSIONS": {"http": "429", "grpc": "RESOURCE_EXHAUSTED"},
    "TOO_LARGE": {"http": "413", "grpc": "RESOURCE_EXHAUSTED"},
    "OVERLOADED": {"http": "429", "grpc": "RESOURCE_EXHAUSTED"},
    "DRAINING": {"http": "503", "grpc": "UNAVAILABLE"},
    "DEADLINE_EXCEEDED": {"http": "504", "grpc": "DEADLINE_EXCEEDED"},
}


@dataclass
class RefusalError(Exception):
    """An error answer: its kind, the transport's own code, the fields it names."""

    kind: str
    code: str
    message: str
    fields: tuple[str, ...]
    retry_after_s: float | None

    def __str__(self) -> str:
        return f"{self.kind} ({self.code}): {self.message} {self.fields}"


class Driver(Protocol):
    """The use cases, over some transport."""

    name: str

    async def predict(self, frames: Sequence[Json], **fields: Any) -> Json: ...

    async def create_session(self, session_id: str | None = None, **config: Any) -> Json: ...

    async def get_session(self, session_id: str) -> Json: ...

    async def list_sessions(self, page_size: int | None = None, page_token: str = "") -> Json: ...

    async def delete_session(self, session_id: str) -> None: ...

    async def observe(self, session_id: str, frames: Sequence[Json]) -> list[Json]: ...

    async def predict_session(self, session_id: str, **options: Any) -> Json: ...

    async def list_models(self) -> list[Json]: ...


class HttpDriver:
    """Over HTTP, as JSON."""

    name = "http"

    def __init__(self, client: httpx.AsyncClient) -> None:
        self.client = client

    async def predict(self, frames: Sequence[Json], **fields: Any) -> Json:
        return _forecast(await self._ask("POST", "/predict", {"frames": frames, **fields}))

    async def create_session(self, session_id: str | None = None, **config: Any) -> Json:
        body = config if session_id is None else {"session_id": session_id, **config}
        return await self._ask("POST", "/v1/sessions", body)

    async def get_session(self, session_id: str) -> Json:
        return await self._ask("GET", f"/v1/sessions/{session_id}")

    async def list_sessions(self, page_size: int | None = None, page_token: str = "") -> Json:
        parameters: Json = {"page_token": page_token}
        if page_size is not None:
            parameters["page_size"] = page_size
        return await self._ask("GET", "/v1/sessions", parameters=parameters)

    async def delete_session(self, session_id: str) -> None:
        await self._ask("DELETE", f"/v1/sessions/{session_id}")

    async def observe(self, session_id: str, frames: Sequence[Json]) -> list[Json]:
        body = {"frames": frames}
        answer = await self._ask("POST", f"/v1/sessions/{session_id}:observe", body)
        results: list[Json] = answer["results"]
        return results

    async def predict_session(self, session_id: str, **options: Any) -> Json:
        return _forecast(await self._ask("POST", f"/v1/sessions/{session_id}:predict", options))

    async def list_models(self) -> list[Json]:
        models: list[Json] = (await self._ask("GET", "/v1/models"))["models"]
        return models

    async def _ask(
        self, verb: str, path: str, body: Json | None = None, parameters: Json | None = None
    ) -> Json:
        # NaN and Infinity are written as Python's json does: no JSON, but what clients send.
        content = None if body is None else json.dumps(body).encode()
        answer = await self.client.request(verb, path, content=content, params=parameters)
        if answer.is_error:
            raise http_refusal(answer)
        value: Json = answer.json() if answer.content else {}
        return value


def http_refusal(answer: httpx.Response) -> RefusalError:
    """What a problem+json says."""
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    problem = answer.json()
    assert problem["status"] == answer.status_code
    retry_after = answer.headers.get("retry-after")
    assert (retry_after is not None) == problem["retryable"]
    return RefusalError(
        kind=problem["reason"],
        code=str(answer.status_code),
        message=problem["detail"],
        fields=tuple(violation["field"] for violation in problem["violations"]),
        retry_after_s=None if retry_after is None else float(retry_after),
    )


class GrpcDriver:
    """Over gRPC."""

    name = "grpc"

    def __init__(self, channel: grpc.aio.Channel) -> None:
        self.stub: TrajectronServiceAsyncStub = TrajectronServiceStub(channel)

    async def predict(self, frames: Sequence[Json], **fields: Any) -> Json:
        options = {name: fields.pop(name) for name in _OPTION_NAMES if name in fields}
        with _refusals():
            request = pb.PredictRequest(
                frames=[frame_message(frame) for frame in frames],
                options=options_message(options),
                **_config(fields),
            )
            return forecast_view((await self.stub.Predict(request)).forecast)

    async def create_session(self, session_id: str | None = None, **config: Any) -> Json:
        request = pb.CreateSessionRequest(
            session_id=session_id or "", config=pb.SessionConfig(**_config(config))
        )
        with _refusals():
            return _session_view((await self.stub.CreateSession(request)).session)

    async def get_session(self, session_id: str) -> Json:
        with _refusals():
            answer = await self.stub.GetSession(pb.GetSessionRequest(session_id=session_id))
        return _session_view(answer.session) | {"graph": _graph_view(answer.graph)}

    async def list_sessions(self, page_size: int | None = None, page_token: str = "") -> Json:
        request = pb.ListSessionsRequest(page_size=page_size, page_token=page_token)
        with _refusals():
            answer = await self.stub.ListSessions(request)
        return {
            "sessions": [_session_view(session) for session in answer.sessions],
            "next_page_token": answer.next_page_token,
        }

    async def delete_session(self, session_id: str) -> None:
        with _refusals():
            await self.stub.DeleteSession(pb.DeleteSessionRequest(session_id=session_id))

    async def observe(self, session_id: str, frames: Sequence[Json]) -> list[Json]:
        request = pb.ObserveRequest(
            session_id=session_id, frames=[frame_message(frame) for frame in frames]
        )
        with _refusals():
            return [result_view(result) for result in (await self.stub.Observe(request)).results]

    async def predict_session(self, session_id: str, **options: Any) -> Json:
        request = pb.PredictSessionRequest(session_id=session_id, options=options_message(options))
        with _refusals():
            return forecast_view((await self.stub.PredictSession(request)).forecast)

    async def list_models(self) -> list[Json]:
        answer = await self.stub.ListModels(pb.ListModelsRequest())
        return [
            {
                "name": model.name,
                "hash": model.hash,
                "agent_types": list(model.agent_types),
                "kernels": model.kernels,
                "dt_s": _seconds(model.dt),
                "horizon": model.horizon,
                "latent_values": model.latent_values,
                "is_default": model.is_default,
                "provenance": json.loads(model.provenance_json),
            }
            for model in answer.models
        ]


@contextmanager
def _refusals() -> Any:
    try:
        yield
    except grpc.aio.AioRpcError as error:
        raise grpc_refusal(error) from None


def grpc_refusal(error: grpc.aio.AioRpcError) -> RefusalError:
    """What a google.rpc.Status says."""
    metadata = dict(error.trailing_metadata() or ())
    status = status_pb2.Status.FromString(bytes(metadata["grpc-status-details-bin"]))
    assert (status.code, status.message) == (error.code().value[0], error.details())
    return status_refusal(status, error.code().name)


def status_refusal(status: status_pb2.Status, code: str = "") -> RefusalError:
    """What the details of a status say."""
    info = error_details_pb2.ErrorInfo()
    request = error_details_pb2.BadRequest()
    retry = error_details_pb2.RetryInfo()
    assert any(detail.Unpack(info) for detail in status.details)
    assert info.domain == "trajectron"
    retryable = any(detail.Unpack(retry) for detail in status.details)
    for detail in status.details:
        detail.Unpack(request)
    return RefusalError(
        kind=info.reason,
        code=code,
        message=status.message,
        fields=tuple(violation.field for violation in request.field_violations),
        retry_after_s=_seconds(retry.retry_delay) if retryable else None,
    )


def frame_message(frame: Json) -> pb.Frame:
    """A frame of the JSON API as a message."""
    time = {"time_s": frame["time"]} if "time" in frame else {}
    return pb.Frame(**time, agents=[pb.Agent(**agent) for agent in frame["agents"]])


def options_message(options: Json) -> pb.ForecastOptions:
    """Options of the JSON API as a message; a name that it does not have is an error."""
    fields = dict(options)
    fields["agent_ids"] = fields.pop("agents", None) or ()
    if "mode" in fields:
        fields["mode"] = f"FORECAST_MODE_{fields['mode'].upper()}"
    if "deadline_s" in fields:
        fields["deadline"] = Duration()
        fields["deadline"].FromNanoseconds(round(fields.pop("deadline_s") * 1e9))
    if "sampling" in fields:
        fields["sampling"] = f"SAMPLING_{fields['sampling'].upper()}"
    return pb.ForecastOptions(**fields)


def _config(config: Json) -> Json:
    fields = dict(config)
    for name in ("frame_interval", "agent_timeout", "idle_timeout"):
        if f"{name}_s" in fields:
            span = Duration()
            span.FromNanoseconds(round(fields.pop(f"{name}_s") * 1e9))
            fields[name] = span
    if "unknown_types" in fields:
        fields["unknown_types"] = f"UNKNOWN_TYPE_POLICY_{fields['unknown_types'].upper()}"
    return fields


def forecast_view(message: pb.Forecast) -> Json:
    """A forecast in the shape of the JSON API."""
    return {
        "model": message.model,
        "model_hash": message.model_hash,
        "mode": pb.ForecastMode.Name(message.mode).removeprefix("FORECAST_MODE_").lower(),
        "seed": message.seed,
        "reference_time": message.reference_time_s,
        "time_offsets_s": list(message.time_offsets_s),
        "sample_semantics": pb.SampleSemantics.Name(message.sample_semantics)
        .removeprefix("SAMPLE_SEMANTICS_")
        .lower(),
        "mode_probability_floor": message.mode_probability_floor,
        "num_samples": message.num_samples,
        "fewer_samples": message.fewer_samples,
        "agents": [_agent_view(agent) for agent in message.agents],
    }


def _agent_view(agent: pb.AgentForecast) -> Json:
    position = np.array([agent.x, agent.y])
    return {
        "id": agent.id,
        "type": agent.type,
        "x": agent.x,
        "y": agent.y,
        "last_observed_time": agent.last_observed_time_s,
        "observations": agent.observations,
        "heading_known": agent.heading_known,
        "mode_probabilities": _array(agent.mode_probabilities),
        "mean": _array(agent.mean) + position if agent.HasField("mean") else None,
        "covariance": _array(agent.covariance) if agent.HasField("covariance") else None,
        "samples": _array(agent.samples) + position if agent.HasField("samples") else None,
        "sample_modes": list(agent.sample_modes) if agent.HasField("samples") else None,
    }


def _array(message: pb.Float32Array) -> Any:
    return np.frombuffer(message.data, "<f4").reshape(tuple(message.shape))


def _forecast(body: Json) -> Json:
    for agent in body["agents"]:
        for name in ("mode_probabilities", "mean", "covariance", "samples"):
            agent[name] = None if agent[name] is None else np.array(agent[name])
    return body


def _session_view(message: pb.Session) -> Json:
    config = message.config
    policy = pb.UnknownTypePolicy.Name(config.unknown_types)
    return {
        "id": message.id,
        "model": config.model,
        "frame_interval_s": _seconds(config.frame_interval),
        "agent_timeout_s": _seconds(config.agent_timeout),
        "idle_timeout_s": _seconds(config.idle_timeout),
        "unknown_types": policy.removeprefix("UNKNOWN_TYPE_POLICY_").lower(),
        "type_map": dict(config.type_map),
        "dt_s": _seconds(message.dt),
        "version": message.version,
        "create_time": message.create_time.ToJsonString(),
        "expire_time": message.expire_time.ToJsonString(),
        "last_frame_time": (
            message.last_frame_time_s if message.HasField("last_frame_time_s") else None
        ),
        "agent_count": message.agent_count,
        "last_sequence": message.last_sequence if message.HasField("last_sequence") else None,
    }


def _graph_view(graph: pb.SceneGraph) -> Json:
    return {
        "nodes": [
            {
                "id": node.id,
                "type": node.type,
                "x": node.x,
                "y": node.y,
                "observations": node.observations,
                "last_observed_time": node.last_observed_time_s,
            }
            for node in graph.nodes
        ],
        "edges": [
            {
                "receiver_id": edge.receiver_id,
                "sender_id": edge.sender_id,
                "age_steps": edge.age_steps,
                "gone_steps": edge.gone_steps,
                "modulation": edge.modulation,
            }
            for edge in graph.edges
        ],
    }


def result_view(result: pb.FrameResult) -> Json:
    """The answer to one frame in the shape of the JSON API."""
    return {
        "outcome": pb.FrameOutcome.Name(result.outcome).removeprefix("FRAME_OUTCOME_").lower(),
        "version": result.version,
        "gap_agents": list(result.gap_agent_ids),
        "ignored_agents": list(result.ignored_agent_ids),
        "field": result.field,
        "message": result.message,
    }


def _seconds(span: Duration) -> float:
    return span.seconds + span.nanos * 1e-9
