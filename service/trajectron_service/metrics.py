"""Every metric of the service, on a registry of its own.

No ids in labels, but names of tenants where one meets its quota: those are the operator's, and
bounded.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import numpy as np
from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    disable_created_metrics,
    generate_latest,
)

from trajectron_model.evaluation import metrics
from trajectron_model.evaluation.densities import LEVELS
from trajectron_model.evaluation.live import LiveScores
from trajectron_service.tracing import OFF, Tracing

# From a quarter of a millisecond to some seconds; 0.4 s is the usual model's step.
SECONDS = (
    0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4,
)  # fmt: skip
# From a second to a day.
LONG_SECONDS = (1, 5, 15, 60, 300, 900, 3600, 4 * 3600, 24 * 3600)
SIZES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
AGENTS = (0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
METERS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
CONTENT_TYPE = "text/plain; version=1.0.0; charset=utf-8"

Stage = Literal["decode", "queue", "encode", "sample", "serialise", "store"]


class AccuracyMetrics:
    """What forecasts of sessions scored when their future had come; see ``watching``.

    Sums and counts by model and agent type, so that means over any time are a ratio of two
    rates. ``step`` counts the model's steps from 1; ``point`` says which point forecast: the
    mean of the most probable mode, or over all modes.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        kind = ("model", "type")
        self.ade = Histogram(
            "trajectron_accuracy_ade_meters",
            "Mean distance of a point forecast from the truth, over the steps that came.",
            (*kind, "point"),
            buckets=METERS,
            registry=registry,
        )
        self.fde = Histogram(
            "trajectron_accuracy_fde_meters",
            "Distance of a point forecast from the truth at the last step that came.",
            (*kind, "point"),
            buckets=METERS,
            registry=registry,
        )
        self.steps = Counter(
            "trajectron_accuracy_steps",
            "Agents scored at a step: what the sums by step are divided by.",
            (*kind, "step"),
            registry=registry,
        )
        self.displacement = Counter(
            "trajectron_accuracy_displacement_meters",
            "Sum of the distances of a point forecast from the truth at a step.",
            (*kind, "point", "step"),
            registry=registry,
        )
        self.nll = Counter(
            "trajectron_accuracy_nll_nats",
            "Sum of the sizes of the negative log likelihoods (of positions in metres, under the "
            "whole mixture) at a step; those below zero apart, so that neither sum falls.",
            (*kind, "step", "sign"),
            registry=registry,
        )
        self.covered = Counter(
            "trajectron_accuracy_covered",
            "Agents that stood within the forecast's region of so many percent at a step.",
            (*kind, "step", "region"),
            registry=registry,
        )
        self.agents = Counter(
            "trajectron_accuracy_agents",
            "Agents' forecasts by what became of them: scored, unseen (none of the future came), "
            "skipped (no budget), evicted (too many pending), failed.",
            ("outcome",),
            registry=registry,
        )
        self.pending = Gauge(
            "trajectron_accuracy_pending_agents",
            "Agents' forecasts that wait for their future.",
            registry=registry,
        )
        self.seconds = Counter(
            "trajectron_accuracy_seconds",
            "Time that watching took: to draw mixtures, to read frames, to score.",
            registry=registry,
        )

    def note(self, model: str, kind: str, scores: LiveScores) -> None:
        """Adds the scores of some agents of one type."""
        for point, distance in (("mode", scores.distance_mode_m), ("mean", scores.distance_mean_m)):
            for ade in metrics.average_displacement(distance).tolist():
                self.ade.labels(model, kind, point).observe(ade)
            for fde in metrics.final_displacement(distance).tolist():
                self.fde.labels(model, kind, point).observe(fde)
            for step, total in enumerate(np.nansum(distance, axis=0).tolist(), start=1):
                self.displacement.labels(model, kind, point, step).inc(total)
        nll = np.nan_to_num(scores.nll_mixture)  # [A, H]
        columns = zip(
            (~np.isnan(scores.distance_mean_m)).sum(axis=0).tolist(),
            np.maximum(nll, 0.0).sum(axis=0).tolist(),
            np.maximum(-nll, 0.0).sum(axis=0).tolist(),
            np.nansum(scores.covered, axis=1).T.tolist(),
            strict=True,
        )
        for step, (count, above, below, covered) in enumerate(columns, start=1):
            self.steps.labels(model, kind, step).inc(count)
            self.nll.labels(model, kind, step, "positive").inc(above)
            self.nll.labels(model, kind, step, "negative").inc(below)
            for level, inside in zip(LEVELS, covered, strict=True):
                self.covered.labels(model, kind, step, f"{100 * level:g}").inc(inside)


class Metrics:
    """What operators see. One object per application; safe to use from any thread.

    Args:
        tracing: told of the stages too; whoever has the metrics finds it here.
    """

    def __init__(self, tracing: Tracing = OFF) -> None:
        self.tracing = tracing
        disable_created_metrics()  # when a series began is of no use, and doubles the output
        self.registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        PlatformCollector(registry=registry)
        self.request_seconds = Histogram(
            "trajectron_request_duration_seconds",
            "Time to answer a call, by protocol (http, grpc), method and code.",
            ("protocol", "method", "code"),
            buckets=SECONDS,
            registry=registry,
        )
        self.stream_message_seconds = Histogram(
            "trajectron_stream_message_duration_seconds",
            "Time from a stream's frame read to its reply ready.",
            buckets=SECONDS,
            registry=registry,
        )
        self.stage_seconds = Histogram(
            "trajectron_stage_duration_seconds",
            "Time in one stage: decode and serialise of a message, queue of one job, encode and "
            "sample of one batch, one write to the store.",
            ("stage",),
            buckets=SECONDS,
            registry=registry,
        )
        self.batch_jobs = Histogram(
            "trajectron_batch_jobs",
            "Jobs that one batch took together.",
            buckets=SIZES,
            registry=registry,
        )
        self.scene_agents = Histogram(
            "trajectron_scene_agents",
            "Agents in a session's scene after new frames, those not timed out included.",
            buckets=AGENTS,
            registry=registry,
        )
        self.frames = Counter(
            "trajectron_frames", "Frames by outcome.", ("outcome",), registry=registry
        )
        self.evictions = Counter(
            "trajectron_sessions_closed",
            "Sessions closed by reason (deleted, idle, stream_ended, damaged, lost).",
            ("reason",),
            registry=registry,
        )
        self.parked = Counter(
            "trajectron_sessions_parked",
            "Idle sessions turned into bytes until they are used again.",
            registry=registry,
        )
        self.refusals = Counter(
            "trajectron_refusals",
            "Work refused or dropped, by the kind of error.",
            ("kind",),
            registry=registry,
        )
        self.http_connections = Gauge(
            "trajectron_http_connections",
            "Open HTTP connections, those of the metrics port among them.",
            registry=registry,
        )
        self.connections_cut = Counter(
            "trajectron_http_connections_cut",
            "HTTP connections ended by the service: too_many, slow_request (it did not arrive "
            "whole in time), slow_reader (its answer did not move).",
            ("reason",),
            registry=registry,
        )
        self.quota_refusals = Counter(
            "trajectron_quota_refusals",
            "Calls, frames and forecasts beyond a tenant's quota: refused, or, frames of streams, "
            "made to wait. After a hundred tenants the others count as one.",
            ("tenant", "quota"),
            registry=registry,
        )
        self.fewer_samples = Counter(
            "trajectron_forecasts_fewer_samples",
            "Forecasts of fewer samples than asked for, so that they are in time.",
            registry=registry,
        )
        self.tokens = Gauge("trajectron_tokens", "Tokens in force.", registry=registry)
        self.tokens_stale = Gauge(
            "trajectron_tokens_stale",
            "1 while the file of tokens cannot be used, so that those it held before count.",
            registry=registry,
        )
        self.inference_seconds = Counter(
            "trajectron_inference_seconds",
            "Time that batches took on the inference thread, watching left out.",
            registry=registry,
        )
        self.accuracy = AccuracyMetrics(registry)
        self.conflicts = Counter(
            "trajectron_session_conflicts",
            "Changes of sessions done again because another replica was faster.",
            registry=registry,
        )
        self.quarantined = Gauge(
            "trajectron_sessions_quarantined",
            "Unreadable sessions that the store keeps aside.",
            registry=registry,
        )
        self.store_info = Gauge(
            "trajectron_store_info",
            "Where sessions are kept, and what an acknowledged frame survives.",
            ("kind", "durability"),
            registry=registry,
        )
        self.store_up = Gauge(
            "trajectron_store_up",
            "1 while the store answers: how its last operation went.",
            registry=registry,
        )
        self.store_errors = Counter(
            "trajectron_store_errors",
            "Operations of the store that failed or took too long.",
            ("operation",),
            registry=registry,
        )
        self.store_group = Histogram(
            "trajectron_store_commit_operations",
            "Operations of sessions that shared one commit of the store.",
            buckets=SIZES,
            registry=registry,
        )
        self.superseded = Counter(
            "trajectron_forecasts_superseded",
            "Forecasts of streams left out because a newer frame had come.",
            registry=registry,
        )
        self.sessions = Gauge("trajectron_sessions", "Open sessions.", registry=registry)
        self.streams = Gauge("trajectron_streams", "Open streams.", registry=registry)
        self.agents = Gauge(
            "trajectron_agents", "Agents in the sessions held in memory.", registry=registry
        )
        self.edges = Gauge(
            "trajectron_edges",
            "Edges, present and fading, in the sessions held in memory.",
            registry=registry,
        )
        self.loop_lag = Histogram(
            "trajectron_event_loop_lag_seconds",
            "How much later than due sleeps of 20 ms end: something blocks the event loop where "
            "this is long, and everybody waits.",
            buckets=SECONDS,
            registry=registry,
        )
        self.queue_length = Gauge(
            "trajectron_queue_length", "Jobs waiting for the model.", registry=registry
        )
        self.in_hand = Gauge(
            "trajectron_work_in_hand", "Calls and streams being worked on.", registry=registry
        )
        self.ready = Gauge("trajectron_ready", "1 while new work is taken.", registry=registry)
        self.evaluations = Gauge(
            "trajectron_evaluations",
            "Batch evaluations kept, by state (queued, running, succeeded, failed, cancelled).",
            ("state",),
            registry=registry,
        )
        self.evaluation_seconds = Histogram(
            "trajectron_evaluation_duration_seconds",
            "Time from the start of a batch evaluation to its end, by the state it ended in.",
            ("state",),
            buckets=LONG_SECONDS,
            registry=registry,
        )
        self.model_info = Gauge(
            "trajectron_model_info",
            "A loaded model.",
            ("model", "hash", "default"),
            registry=registry,
        )
        self.build_info = Gauge(
            "trajectron_build_info", "What runs.", ("version", "python"), registry=registry
        )

    def build(self, version: str) -> None:
        """Notes the version of the service."""
        self.build_info.labels(version, platform.python_version()).set(1)

    def request(self, protocol: str, method: str, code: str, seconds: float) -> None:
        """Notes an answered call; ``code`` is the protocol's own (``200``, ``NOT_FOUND``)."""
        self.request_seconds.labels(protocol, method, code).observe(seconds)

    @contextmanager
    def stage(self, stage: Stage) -> Iterator[None]:
        """Times the block as one stage."""
        start = time.perf_counter()
        try:
            with self.tracing.stage(stage):
                yield
        finally:
            self.stage_seconds.labels(stage).observe(time.perf_counter() - start)

    def staged(self, stage: Stage, seconds: float) -> None:
        """Notes a stage of a batch that has just ended, on the inference thread."""
        self.stage_seconds.labels(stage).observe(seconds)
        self.tracing.staged(stage, seconds)

    def render(self) -> bytes:
        """All metrics in the Prometheus text format (``CONTENT_TYPE``)."""
        return generate_latest(self.registry)
