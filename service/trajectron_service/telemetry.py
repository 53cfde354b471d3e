"""Tracing by OpenTelemetry: spans of calls, of their stages, and of the batches they share.

The only module that imports it; ``lifecycle`` imports this one only when tracing is on.
Parents go by W3C ``traceparent``. A batch works for several calls, but a span has one parent:
a batch of one call is below that call, one of several is a trace of its own with a link to each,
and the ``queue`` span of each call links to the batch.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import cast

from opentelemetry import context, trace
from opentelemetry.context import Context
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import SERVICE_NAME, SERVICE_VERSION, Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.sdk.trace.sampling import ParentBased, TraceIdRatioBased
from opentelemetry.trace import Link, Span, SpanContext, SpanKind, Status, StatusCode
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from trajectron_service.tracing import TRACEPARENT, Ticket

_PROPAGATOR = TraceContextTextMapPropagator()
_NS = 1_000_000_000


def exporting(endpoint: str, share: float, version: str) -> Telemetry:
    """Tracing that sends spans to a collector, in the background.

    Args:
        endpoint: of OTLP over HTTP, such as ``http://127.0.0.1:4318``.
        share: of the traces that begin here; a client's own decision goes before.
        version: of the service.
    """
    resource = Resource.create({SERVICE_NAME: "trajectron", SERVICE_VERSION: version})
    provider = TracerProvider(
        sampler=ParentBased(TraceIdRatioBased(share)), resource=resource, shutdown_on_exit=False
    )
    exporter = OTLPSpanExporter(endpoint=f"{endpoint.rstrip('/')}/v1/traces")
    provider.add_span_processor(BatchSpanProcessor(exporter))
    return Telemetry(provider)


@dataclass(frozen=True)
class _Ticket:
    """The call that a job belongs to, and when it was queued (nanoseconds)."""

    parent: Context
    span: SpanContext
    queued_ns: int


class _Call:
    """One call's span."""

    def __init__(self, span: Span, protocol: str) -> None:
        self._span = span
        self._protocol = protocol
        carrier: dict[str, str] = {}
        _PROPAGATOR.inject(carrier, trace.set_span_in_context(span))
        self.traceparent = carrier.get(TRACEPARENT)

    def end(self, method: str, code: str, *, failed: bool) -> None:
        """Names the span after what is known only now, and ends it."""
        span = self._span
        span.update_name(method)
        if self._protocol == "http":
            verb, _, route = method.partition(" ")
            span.set_attributes(
                {
                    "http.request.method": verb,
                    "http.route": route,
                    "http.response.status_code": int(code),
                }
            )
        else:
            span.set_attributes(
                {
                    "rpc.system.name": "grpc",
                    "rpc.method": method,
                    "rpc.response.status_code": code,
                }
            )
        if failed:
            span.set_status(Status(StatusCode.ERROR))
        span.end()


class Telemetry:
    """``tracing.Tracing`` on a provider of spans."""

    def __init__(self, provider: TracerProvider) -> None:
        self._provider = provider
        self._tracer = provider.get_tracer("trajectron_service")
        # Of the batch that runs on the inference thread, where only that thread looks.
        self._batch: Context | None = None

    def call(self, protocol: str, method: str, carried: Mapping[str, str]) -> _Call:
        """See ``Tracing``."""
        parent = _PROPAGATOR.extract(carried, context=Context())
        span = self._tracer.start_span(method, parent, SpanKind.SERVER)
        # Never detached: the task ends with the call, and gRPC serialises after the handler.
        context.attach(trace.set_span_in_context(span))
        return _Call(span, protocol)

    def stage(self, name: str) -> AbstractContextManager[object]:
        """See ``Tracing``; what no call caused is not traced."""
        return self._stage(name)

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        if not _recorded(trace.get_current_span()):
            yield
            return
        span = self._tracer.start_span(name)
        try:
            yield
        except Exception:
            span.set_status(Status(StatusCode.ERROR))
            raise
        finally:
            span.end()

    def ticket(self) -> Ticket | None:
        """See ``Tracing``."""
        span = trace.get_current_span()
        if not _recorded(span):
            return None
        here = trace.set_span_in_context(span, Context())
        return Ticket(_Ticket(here, span.get_span_context(), time.time_ns()))

    @contextmanager
    def batch(self, tickets: Sequence[Ticket | None]) -> Iterator[None]:
        """See ``Tracing``."""
        found = [cast("_Ticket", ticket) for ticket in tickets if ticket is not None]
        if not found:
            yield
            return
        now_ns = time.time_ns()
        alone = len(found) == 1
        span = self._tracer.start_span(
            "batch",
            found[0].parent if alone else Context(),
            links=() if alone else [Link(ticket.span) for ticket in found],
            attributes={"trajectron.batch.jobs": len(tickets)},
            start_time=now_ns,
        )
        for ticket in found:
            waited = self._tracer.start_span(
                "queue",
                ticket.parent,
                links=[Link(span.get_span_context())],
                start_time=ticket.queued_ns,
            )
            waited.end(now_ns)
        self._batch = trace.set_span_in_context(span, Context())
        try:
            yield
        except Exception:
            span.set_status(Status(StatusCode.ERROR))
            raise
        finally:
            self._batch = None
            span.end()

    def staged(self, name: str, seconds: float) -> None:
        """See ``Tracing``; a batch that belongs to no traced call is not traced."""
        if self._batch is None:
            return
        now_ns = time.time_ns()
        begun_ns = now_ns - int(seconds * _NS)
        self._tracer.start_span(name, self._batch, start_time=begun_ns).end(now_ns)

    def close(self) -> None:
        """See ``Tracing``."""
        self._provider.shutdown()


def _recorded(span: Span) -> bool:
    """Whether it is one of a trace that is kept; of a call it may have ended already."""
    return span.get_span_context().trace_flags.sampled
