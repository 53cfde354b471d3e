"""A load of sessions: simulated crowds sent at their own pace, answers counted and timed.

The pace is that of the clock, whatever the service does: a frame is sent when it is due, and its
latency counts from then, so that a service that falls behind cannot make the load lighter.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from trajectron_client import (
    AsyncClient,
    AsyncHttpClient,
    ForecastOptions,
    Frame,
    ServiceError,
    SessionOptions,
    TrajectronError,
)
from trajectron_model.simulation import Scenario, simulate

# Crowds that sessions share among them: simulating one for each would take longer than the load.
_CROWDS = 4
_PERCENTILES = (50, 90, 95, 99, 100)


@dataclass(frozen=True)
class LoadPlan:
    """What is sent.

    Attributes:
        sessions: open at once, one stream (gRPC) or one caller (HTTP) each.
        agents: in each session's crowd, about.
        rate_hz: frames a second of each session.
        seconds: for which each session sends.
        ramp_s: within which all sessions have begun.
        deadline_s: an answer later than that is a miss.
        forecast: asked of every frame.
        model: None for the default.
        seed: of the crowds.
    """

    sessions: int
    agents: int
    rate_hz: float
    seconds: float
    ramp_s: float
    deadline_s: float
    forecast: ForecastOptions
    model: str | None = None
    seed: int = 0

    @property
    def interval_s(self) -> float:
        """Between two frames of a session."""
        return 1.0 / self.rate_hz


@dataclass
class LoadReport:
    """What came back; a frame is *lost* when it was sent and never answered.

    Attributes:
        sent: frames.
        forecasts: answers with a forecast.
        late: forecasts after their deadline.
        refusals: answers with an error instead, by its reason.
        broken: sessions that ended early, by what ended them.
        latencies_s: of forecasts, from when the frame was due.
        seconds: from the first frame to the last answer.
    """

    sent: int = 0
    forecasts: int = 0
    late: int = 0
    refusals: Counter[str] = field(default_factory=Counter)
    broken: Counter[str] = field(default_factory=Counter)
    latencies_s: list[float] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def lost(self) -> int:
        """Frames without any answer."""
        return self.sent - self.forecasts - self.refusals.total()

    def answered(self, due: float, deadline_s: float) -> None:
        """Counts a forecast of a frame that was due on ``time.perf_counter``."""
        latency_s = time.perf_counter() - due
        self.forecasts += 1
        self.late += latency_s > deadline_s
        self.latencies_s.append(latency_s)

    def to_json(self) -> dict[str, Any]:
        """All figures as JSON values; latencies as percentiles in milliseconds."""
        seconds = max(self.seconds, 1e-9)
        latencies = np.array(self.latencies_s or [np.nan]) * 1e3
        values = np.percentile(latencies, _PERCENTILES).tolist()
        return {
            "seconds": self.seconds,
            "sent": self.sent,
            "forecasts": self.forecasts,
            "sent_per_s": self.sent / seconds,
            "forecasts_per_s": self.forecasts / seconds,
            "in_time_per_s": (self.forecasts - self.late) / seconds,
            "late": self.late,
            "lost": self.lost,
            "refusals": dict(self.refusals),
            "broken_sessions": dict(self.broken),
            "latency_ms": (
                dict(zip((f"p{p}" for p in _PERCENTILES), values, strict=True))
                if self.latencies_s
                else {}
            ),
        }


async def send_over_grpc(client: AsyncClient, plan: LoadPlan) -> LoadReport:
    """Every session a stream; all at once."""
    return await _all_sessions(plan, lambda film, report: _stream(client, plan, film, report))


async def send_over_http(client: AsyncHttpClient, plan: LoadPlan) -> LoadReport:
    """Every session a caller who pushes each frame, then asks for its forecast."""
    return await _all_sessions(plan, lambda film, report: _call(client, plan, film, report))


async def _all_sessions(plan: LoadPlan, run: Any) -> LoadReport:
    films = await asyncio.to_thread(_films, plan)
    report = LoadReport()

    async def one(number: int) -> None:
        await asyncio.sleep(plan.ramp_s * number / plan.sessions)
        try:
            await run(films[number % len(films)], report)
        except TrajectronError as error:
            report.broken[type(error).__name__] += 1

    start = time.perf_counter()
    await asyncio.gather(*(one(number) for number in range(plan.sessions)))
    report.seconds = time.perf_counter() - start
    return report


def _films(plan: LoadPlan) -> list[list[Frame]]:
    """The frames of each crowd."""
    steps = max(1, round(plan.seconds * plan.rate_hz))
    films = []
    for number in range(min(_CROWDS, plan.sessions)):
        walk = simulate(
            Scenario.CROSSING, plan.agents, seed=plan.seed + number, dt_s=plan.interval_s
        )
        films.append(
            [
                Frame.from_arrays(scene.time_s, scene.ids, scene.positions.tolist())
                for scene in islice(walk, steps)
            ]
        )
    return films


async def _paced(film: Sequence[Frame], interval_s: float) -> AsyncIterator[tuple[Frame, float]]:
    """Each frame when it is due, and when that was."""
    start = time.perf_counter()
    for number, frame in enumerate(film):
        due = start + number * interval_s
        await asyncio.sleep(max(0.0, due - time.perf_counter()))
        yield frame, due


async def _stream(
    client: AsyncClient, plan: LoadPlan, film: Sequence[Frame], report: LoadReport
) -> None:
    due: deque[float] = deque()

    async def frames() -> AsyncIterator[Frame]:
        async for frame, when in _paced(film, plan.interval_s):
            due.append(when)
            report.sent += 1
            yield frame

    stream = client.stream(
        frames(), config=_session(plan), close_session_at_end=True, **plan.forecast
    )
    async with stream:
        async for reply in stream:
            when = due.popleft()
            if reply.error is not None:
                report.refusals[reply.error.reason] += 1
            elif reply.forecast is None:
                report.refusals[reply.result.outcome.value.upper()] += 1
            else:
                report.answered(when, plan.deadline_s)


async def _call(
    client: AsyncHttpClient, plan: LoadPlan, film: Sequence[Frame], report: LoadReport
) -> None:
    async with client.session(**_session(plan)) as session:
        async for frame, when in _paced(film, plan.interval_s):
            report.sent += 1
            try:
                await session.observe(frame)
                await session.predict(**plan.forecast)
            except ServiceError as error:
                report.refusals[error.reason] += 1
            else:
                report.answered(when, plan.deadline_s)


def _session(plan: LoadPlan) -> SessionOptions:
    options = SessionOptions(frame_interval_s=plan.interval_s)
    if plan.model is not None:
        options["model"] = plan.model
    return options
