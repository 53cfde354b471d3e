"""What holds of gRPC alone: statuses, bytes, health, reflection, limits."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import grpc
import pytest
from google.protobuf.timestamp_pb2 import Timestamp
from google.rpc import error_details_pb2, status_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from tests.contract.drivers import GrpcDriver, frame_message, grpc_refusal
from tests.contract.scenes import walking
from tests.contract.servers import MAX_MESSAGE_BYTES, MAX_REPLY_BYTES

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service.lifecycle import Service

pytestmark = pytest.mark.asyncio(loop_scope="session")

SERVICE = "trajectron.v1.TrajectronService"
UNARY = (
    "Predict", "CreateSession", "GetSession", "ListSessions", "DeleteSession", "Observe",
    "PredictSession", "ListModels",
)  # fmt: skip
# Field 1 as text that is no UTF-8.
NOT_UTF8 = b"\x0a\x02\xc3\x28"


async def refusal_of(call: Any) -> grpc.aio.AioRpcError:
    """The error that a call ends with."""
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        await call
    return caught.value


async def still_answers(channel: grpc.aio.Channel) -> None:
    """The server lives on, on the same connection."""
    assert (await GrpcDriver(channel).predict(walking(), num_samples=1))["agents"]


async def test_a_status_has_its_standard_details(channel: grpc.aio.Channel) -> None:
    call = GrpcDriver(channel).stub.Predict(
        pb.PredictRequest(
            frames=[frame_message(one) for one in walking()],
            options=pb.ForecastOptions(horizon=99),
        )
    )
    error = await refusal_of(call)
    assert error.code() is grpc.StatusCode.INVALID_ARGUMENT
    metadata = dict(error.trailing_metadata() or ())
    status = status_pb2.Status.FromString(bytes(metadata["grpc-status-details-bin"]))
    assert [detail.TypeName() for detail in status.details] == [
        "google.rpc.ErrorInfo",
        "google.rpc.BadRequest",
    ]
    info, request = error_details_pb2.ErrorInfo(), error_details_pb2.BadRequest()
    status.details[0].Unpack(info)
    status.details[1].Unpack(request)
    assert (info.reason, info.domain) == ("INVALID_ARGUMENT", "trajectron")
    [violation] = request.field_violations
    assert violation.field.endswith("horizon")
    assert "60" in violation.description


@pytest.mark.parametrize(
    ("method", "raw"),
    [
        (method, raw)
        for method in UNARY
        for raw in (b"\xff\xff\xff\xff", b"\x0a\xff\xff\xff\xff\x0f", NOT_UTF8 * 3)
        # To these two field 1 is unknown or a number, and an unknown field may hold any bytes.
        if not (method in {"ListModels", "ListSessions"} and raw.startswith(NOT_UTF8))
    ],
)
async def test_bytes_that_are_no_message_are_refused(
    channel: grpc.aio.Channel, method: str, raw: bytes
) -> None:
    call: Any = channel.unary_unary(f"/{SERVICE}/{method}")
    error = await refusal_of(call(raw))
    refusal = grpc_refusal(error)
    assert (refusal.kind, refusal.code) == ("MALFORMED", "INVALID_ARGUMENT")
    await still_answers(channel)


@pytest.mark.parametrize("opened", [True, False])
async def test_bytes_that_are_no_message_end_only_their_stream(
    channel: grpc.aio.Channel, opened: bool
) -> None:
    call: Any = channel.stream_stream(f"/{SERVICE}/StreamPredict")()
    if opened:
        await call.write(pb.StreamPredictRequest(open=pb.StreamOpen()).SerializeToString())
        pb.StreamPredictResponse.FromString(await call.read())
    await call.write(b"\xff\xff\xff")
    error = await refusal_of(call.read())
    assert grpc_refusal(error).kind == "MALFORMED"
    await still_answers(channel)


async def test_an_unknown_method_is_unimplemented(channel: grpc.aio.Channel) -> None:
    call: Any = channel.unary_unary(f"/{SERVICE}/Explode")
    error = await refusal_of(call(b""))
    assert error.code() is grpc.StatusCode.UNIMPLEMENTED


@pytest.mark.parametrize(
    ("request_", "field"),
    [
        (pb.PredictRequest(options=pb.ForecastOptions(mode=99)), "options.mode"),  # type: ignore[arg-type]  # no such mode
        (pb.PredictRequest(options=pb.ForecastOptions(sampling=9)), "options.sampling"),  # type: ignore[arg-type]  # no such sampling
        (pb.PredictRequest(unknown_types=99), "unknown_types"),  # type: ignore[arg-type]  # no such policy
    ],
)
async def test_values_that_no_enum_has_are_named(
    channel: grpc.aio.Channel, request_: pb.PredictRequest, field: str
) -> None:
    refusal = grpc_refusal(await refusal_of(GrpcDriver(channel).stub.Predict(request_)))
    assert (refusal.kind, refusal.fields) == ("INVALID_ARGUMENT", (field,))


async def test_frames_may_have_wall_clock_times(channel: grpc.aio.Channel) -> None:
    frames = [frame_message(one) for one in walking()]
    for number, one in enumerate(frames):
        one.timestamp.CopyFrom(Timestamp(seconds=1_700_000_000, nanos=400_000_000 * number))
        if number == 3:
            one.timestamp.CopyFrom(Timestamp(seconds=1_700_000_001, nanos=200_000_000))
    answer = await GrpcDriver(channel).stub.Predict(pb.PredictRequest(frames=frames[:3]))
    assert answer.forecast.reference_time_s == pytest.approx(1_700_000_000.8, abs=1e-5)
    assert answer.forecast.agents[0].observations == 3


async def test_a_message_over_the_limit_is_refused_and_one_below_is_read(
    channel: grpc.aio.Channel,
) -> None:
    stub = GrpcDriver(channel).stub
    padding = "x" * (MAX_MESSAGE_BYTES - 100)
    error = await refusal_of(stub.GetSession(pb.GetSessionRequest(session_id=padding)))
    assert error.code() is not grpc.StatusCode.RESOURCE_EXHAUSTED
    padding = "x" * (MAX_MESSAGE_BYTES + 100)
    error = await refusal_of(stub.GetSession(pb.GetSessionRequest(session_id=padding)))
    assert error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    await still_answers(channel)


async def test_the_limit_of_replies_is_ours_not_grpcs_default(channel: grpc.aio.Channel) -> None:
    stub = GrpcDriver(channel).stub
    options = pb.ForecastOptions(num_samples=1000, horizon=60, seed=1)

    def request(agents: int) -> pb.PredictRequest:
        frames = [frame_message(one) for one in walking(2, agents)]
        return pb.PredictRequest(frames=frames, options=options)

    large = await stub.Predict(request(10))
    assert 4 * 2**20 < large.ByteSize() < MAX_REPLY_BYTES
    error = await refusal_of(stub.Predict(request(15)))
    assert error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    await still_answers(channel)


async def test_a_deadline_is_kept(channel: grpc.aio.Channel) -> None:
    request = pb.PredictRequest(frames=[frame_message(one) for one in walking()])
    error = await refusal_of(GrpcDriver(channel).stub.Predict(request, timeout=1e-4))
    assert error.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    await still_answers(channel)


async def test_health_is_told_for_the_server_and_the_service(channel: grpc.aio.Channel) -> None:
    stub: Any = health_pb2_grpc.HealthStub(channel)
    for name in ("", SERVICE):
        answer = await stub.Check(health_pb2.HealthCheckRequest(service=name))
        assert answer.status == health_pb2.HealthCheckResponse.SERVING
    error = await refusal_of(stub.Check(health_pb2.HealthCheckRequest(service="nobody")))
    assert error.code() is grpc.StatusCode.NOT_FOUND


async def test_health_can_be_watched(channel: grpc.aio.Channel) -> None:
    stub: Any = health_pb2_grpc.HealthStub(channel)
    for name, status in {
        SERVICE: health_pb2.HealthCheckResponse.SERVING,
        "nobody": health_pb2.HealthCheckResponse.SERVICE_UNKNOWN,
    }.items():
        call = stub.Watch(health_pb2.HealthCheckRequest(service=name))
        assert (await call.read()).status == status
        call.cancel()


async def test_reflection_tells_the_services_and_their_files(channel: grpc.aio.Channel) -> None:
    # Its type stubs know synchronous channels only.
    make_stub = cast("Any", reflection_pb2_grpc.ServerReflectionStub)
    call: Any = make_stub(channel).ServerReflectionInfo()
    await call.write(reflection_pb2.ServerReflectionRequest(list_services=""))
    names = {one.name for one in (await call.read()).list_services_response.service}
    assert names == {
        SERVICE,
        "trajectron.v1.EvaluationService",
        "grpc.health.v1.Health",
        "grpc.reflection.v1alpha.ServerReflection",
    }
    await call.write(reflection_pb2.ServerReflectionRequest(file_containing_symbol=SERVICE))
    files = (await call.read()).file_descriptor_response.file_descriptor_proto
    assert any(b"StreamPredict" in one for one in files)
    await call.done_writing()


async def test_pings_of_impatient_clients_are_fine(service: Service) -> None:
    # A ping each 0.1 s is far more than we allow without data on the wire; each 10 s, as
    # clients do, would take minutes to tell apart. So the claim is about the setting.
    options = [
        ("grpc.keepalive_time_ms", 6_000),
        ("grpc.keepalive_timeout_ms", 2_000),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.max_pings_without_data", 0),
    ]
    target = f"127.0.0.1:{service.grpc_port}"
    async with grpc.aio.insecure_channel(target, options=options) as channel:
        await still_answers(channel)
        assert channel.get_state() is grpc.ChannelConnectivity.READY


async def test_calls_are_measured_by_method_and_code(
    channel: grpc.aio.Channel, service: Service
) -> None:
    before = service.metrics.render().decode()
    await refusal_of(
        GrpcDriver(channel).stub.GetSession(pb.GetSessionRequest(session_id="measured"))
    )
    await asyncio.sleep(0)
    after = service.metrics.render().decode()
    label = '{code="NOT_FOUND",method="GetSession",protocol="grpc"}'
    name = f"trajectron_request_duration_seconds_count{label}"
    assert count(after, name) == count(before, name) + 1


def count(text: str, name: str) -> float:
    """A counter's value in the Prometheus text format, zero when it is not there yet."""
    values = [line.rpartition(" ")[2] for line in text.splitlines() if line.startswith(name)]
    return float(values[0]) if values else 0.0
