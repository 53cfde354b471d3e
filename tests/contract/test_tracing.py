"""Spans of calls over both transports, as a client that sends ``traceparent`` finds them."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import grpc
import httpx
import pytest
import pytest_asyncio
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from tests.contract.drivers import frame_message
from tests.contract.scenes import walking
from tests.contract.servers import small_settings

from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_proto.v1 import trajectron_pb2_grpc
from trajectron_service.lifecycle import Service, running
from trajectron_service.telemetry import Telemetry
from trajectron_service.tracing import Call, Ticket

pytestmark = pytest.mark.asyncio(loop_scope="session")

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
TRACEPARENT = f"00-{TRACE}-{PARENT}-01"
NOT_SAMPLED = f"00-{TRACE}-{PARENT}-00"
STAGES = {"decode", "queue", "batch", "encode", "sample", "serialise"}


class Spans:
    """What has been exported so far."""

    def __init__(self) -> None:
        self._exporter = InMemorySpanExporter()
        self.provider = TracerProvider(shutdown_on_exit=False)
        self.provider.add_span_processor(SimpleSpanProcessor(self._exporter))

    def clear(self) -> None:
        self._exporter.clear()

    def all(self) -> list[ReadableSpan]:
        return list(self._exporter.get_finished_spans())

    def named(self, name: str) -> list[ReadableSpan]:
        return [span for span in self.all() if span.name == name]

    async def named_soon(self, name: str) -> ReadableSpan:
        """The one of that name; a call's span ends just after its answer was sent."""
        for _ in range(200):
            if found := self.named(name):
                (span,) = found
                return span
            await asyncio.sleep(0.01)
        raise AssertionError(f"no span {name}; there are {[span.name for span in self.all()]}")


@pytest.fixture(scope="module")
def recorded() -> Spans:
    return Spans()


@pytest_asyncio.fixture(scope="module", loop_scope="session")
async def traced(
    recorded: Spans, model_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> AsyncIterator[Service]:
    """A service that traces, with a durable store."""
    store = f"sqlite:{tmp_path_factory.mktemp('traced') / 'sessions.db'}"
    settings = small_settings(model_path, store=store)
    async with running(settings, Telemetry(recorded.provider)) as service:
        yield service


@pytest.fixture
def spans(recorded: Spans, traced: Service) -> Spans:
    recorded.clear()
    return recorded


def frames() -> list[pb.Frame]:
    return [frame_message(one) for one in walking(frames=3)]


def hex_trace(span: ReadableSpan) -> str:
    assert span.context is not None
    return f"{span.context.trace_id:032x}"


def hex_span(span: ReadableSpan) -> str:
    assert span.context is not None
    return f"{span.context.span_id:016x}"


def parent(span: ReadableSpan) -> str | None:
    return None if span.parent is None else f"{span.parent.span_id:016x}"


def assert_whole(spans: Spans, call: ReadableSpan, stages: set[str]) -> None:
    """The call continues the client's trace, and its stages are below it, once each."""
    assert (hex_trace(call), parent(call)) == (TRACE, PARENT)
    below = {span.name: span for span in spans.all() if span is not call}
    assert len(below) == len(spans.all()) - 1
    assert set(below) == stages
    (batch,) = spans.named("batch")
    for name, span in below.items():
        assert hex_trace(span) == TRACE
        above = batch if name in ("encode", "sample") else call
        assert parent(span) == hex_span(above), name
        assert span.start_time is not None and span.end_time is not None
        assert span.start_time <= span.end_time
    (link,) = below["queue"].links
    assert link.context == batch.context


async def test_a_call_over_http_continues_the_clients_trace_and_shows_its_stages(
    spans: Spans, traced: Service
) -> None:
    url = f"http://127.0.0.1:{traced.http_port}/v1/predict"
    async with httpx.AsyncClient() as client:
        answer = await client.post(
            url, json={"frames": walking(frames=3)}, headers={"traceparent": TRACEPARENT}
        )
    assert answer.status_code == 200
    call = await spans.named_soon("POST /v1/predict")
    assert answer.headers["traceparent"] == f"00-{TRACE}-{hex_span(call)}-01"
    assert call.attributes is not None
    assert call.attributes["http.response.status_code"] == 200
    assert_whole(spans, call, STAGES)


async def test_a_call_over_grpc_continues_the_clients_trace_and_shows_its_stages(
    spans: Spans, traced: Service
) -> None:
    async with grpc.aio.insecure_channel(f"127.0.0.1:{traced.grpc_port}") as channel:
        stub = trajectron_pb2_grpc.TrajectronServiceStub(channel)
        calling = stub.Predict(
            pb.PredictRequest(frames=frames()), metadata=(("traceparent", TRACEPARENT),)
        )
        await calling
        sent_back = dict(await calling.initial_metadata())
    call = await spans.named_soon("Predict")
    assert sent_back["traceparent"] == f"00-{TRACE}-{hex_span(call)}-01"
    assert call.attributes is not None
    assert call.attributes["rpc.response.status_code"] == "OK"
    # Bytes are decoded before there is a call to speak of.
    assert_whole(spans, call, STAGES - {"decode"})


async def test_every_frame_of_a_stream_shows_its_stages_and_its_write(
    spans: Spans, traced: Service
) -> None:
    async def requests() -> AsyncIterator[pb.StreamPredictRequest]:
        options = pb.ForecastOptions(num_samples=2)
        yield pb.StreamPredictRequest(open=pb.StreamOpen(options=options))
        for number, one in enumerate(frames(), start=1):
            frame = pb.StreamFrame(sequence=number, frame=one)
            yield pb.StreamPredictRequest(frame=frame)

    async with grpc.aio.insecure_channel(f"127.0.0.1:{traced.grpc_port}") as channel:
        stub = trajectron_pb2_grpc.TrajectronServiceStub(channel)
        calling = stub.StreamPredict(requests(), metadata=(("traceparent", TRACEPARENT),))
        replies = [reply async for reply in calling]
        sent_back = dict(await calling.initial_metadata())
    assert str(sent_back["traceparent"]).startswith(f"00-{TRACE}-")
    assert len(replies) == 4
    call = await spans.named_soon("StreamPredict")
    assert (hex_trace(call), parent(call)) == (TRACE, PARENT)
    assert {hex_trace(span) for span in spans.all()} == {TRACE}
    assert {"queue", "batch", "encode", "sample", "serialise", "store"} <= {
        span.name for span in spans.all()
    }
    assert all(parent(span) == hex_span(call) for span in spans.named("store"))
    assert len(spans.named("serialise")) == len(replies)


async def test_a_call_without_a_traceparent_begins_a_trace(spans: Spans, traced: Service) -> None:
    async with httpx.AsyncClient() as client:
        answer = await client.get(f"http://127.0.0.1:{traced.http_port}/v1/sessions/nobody")
    assert answer.status_code == 404
    call = await spans.named_soon("GET /v1/sessions/{session_id}")
    assert call.parent is None
    assert answer.headers["traceparent"].split("-")[1] == hex_trace(call)
    assert call.status.is_ok or call.status.is_unset  # the client's fault, not ours


async def test_a_client_that_does_not_sample_its_trace_is_not_traced(
    spans: Spans, traced: Service
) -> None:
    async with httpx.AsyncClient() as client:
        answer = await client.post(
            f"http://127.0.0.1:{traced.http_port}/v1/predict",
            json={"frames": walking(frames=2)},
            headers={"traceparent": NOT_SAMPLED},
        )
        assert answer.status_code == 200
        assert answer.headers["traceparent"].startswith(f"00-{TRACE}-")
        assert answer.headers["traceparent"].endswith("-00")
        await client.get(f"http://127.0.0.1:{traced.http_port}/healthz")
    await spans.named_soon("GET /healthz")
    assert [span.name for span in spans.all()] == ["GET /healthz"]


async def test_a_call_that_fails_for_no_fault_of_the_client_says_so() -> None:
    spans = Spans()
    call = Telemetry(spans.provider).call("http", "GET", {})
    call.end("GET /readyz", "503", failed=True)
    (span,) = spans.all()
    assert not span.status.is_ok and not span.status.is_unset


async def test_a_batch_of_several_calls_links_to_each_of_them() -> None:
    spans = Spans()
    tracing = Telemetry(spans.provider)

    async def one(name: str) -> tuple[Ticket | None, Call]:
        call = tracing.call("grpc", name, {})
        return tracing.ticket(), call

    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(one(name)) for name in ("first", "second")]
    tickets, calls = zip(*(task.result() for task in tasks), strict=True)
    with tracing.batch([tickets[0], None, tickets[1]]):
        tracing.staged("encode", 0.25)
    for call, name in zip(calls, ("first", "second"), strict=True):
        call.end(name, "OK", failed=False)
    (batch,) = spans.named("batch")
    contexts = [spans.named(name)[0].context for name in ("first", "second")]
    assert batch.parent is None
    assert [link.context for link in batch.links] == contexts
    assert batch.attributes == {"trajectron.batch.jobs": 3}
    assert [span.links[0].context for span in spans.named("queue")] == [batch.context] * 2
    assert [span.parent for span in spans.named("queue")] == contexts
    (encode,) = spans.named("encode")
    assert encode.parent == batch.context
    assert encode.end_time is not None and encode.start_time is not None
    assert encode.end_time - encode.start_time == 250_000_000
    # After the batch no stage belongs to it any more.
    tracing.staged("sample", 0.1)
    assert spans.named("sample") == []


async def test_when_off_nothing_is_sent_back(
    http: httpx.AsyncClient,
) -> None:
    answer = await http.get("/v1/models", headers={"traceparent": TRACEPARENT})
    assert answer.status_code == 200 and "traceparent" not in answer.headers
