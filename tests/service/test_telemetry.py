"""Spans on their way to a collector, and what happens without the packages for that."""

from __future__ import annotations

import contextvars
import gzip
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from benchmarks import tracing as benchmark
from trajectron_service import lifecycle, telemetry
from trajectron_service.settings import Settings, SettingsError


async def test_the_benchmark_gives_the_cost_of_hooks_beside_a_calls() -> None:
    off_s, ratio, hooks_s = await benchmark.measure(rounds=1, calls=5)
    assert 0.0 < hooks_s < off_s
    assert ratio > 0.0


def test_tracing_without_its_packages_is_refused_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "trajectron_service.telemetry", raising=False)
    monkeypatch.delattr("trajectron_service.telemetry", raising=False)
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with pytest.raises(SettingsError, match=r"tracing: 'otlp' needs .*\[service,tracing\]"):
        lifecycle._tracing(Settings(tracing="otlp"))


class _Collector(BaseHTTPRequestHandler):
    received: list[tuple[str, bytes]]

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["content-length"]))
        if self.headers.get("content-encoding") == "gzip":
            body = gzip.decompress(body)
        self.received.append((self.path, body))
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Says nothing."""


@pytest.fixture
def collector() -> Iterator[tuple[str, list[tuple[str, bytes]]]]:
    """A collector of spans on loopback: its endpoint, and what it has received."""
    received: list[tuple[str, bytes]] = []
    handler = type("Collector", (_Collector,), {"received": received})
    server = HTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", received
    server.shutdown()
    thread.join()
    server.server_close()


def test_spans_reach_a_collector_over_http(
    collector: tuple[str, list[tuple[str, bytes]]],
) -> None:
    endpoint, received = collector
    tracing = telemetry.exporting(endpoint, 1.0, "1.2.3")
    context = contextvars.copy_context()
    context.run(lambda: tracing.call("grpc", "Predict", {}).end("Predict", "OK", failed=False))
    tracing.close()
    ((path, body),) = received
    assert path == "/v1/traces"
    (resource,) = ExportTraceServiceRequest.FromString(body).resource_spans
    facts = {one.key: one.value.string_value for one in resource.resource.attributes}
    assert (facts["service.name"], facts["service.version"]) == ("trajectron", "1.2.3")
    assert [span.name for span in resource.scope_spans[0].spans] == ["Predict"]
