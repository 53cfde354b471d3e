"""Plays scenes to a running service, prints what it answers, and measures how fast."""

from __future__ import annotations

import asyncio
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterator

import numpy as np
from rich.table import Table

from trajectron_client import (
    Access,
    Agent,
    AsyncClient,
    Forecast,
    ForecastOptions,
    Frame,
    SessionOptions,
    StreamReply,
)
from trajectron_service.commands.options import out
from trajectron_service.commands.recordings import Scene

# Agents named on the line of a frame; all of them are forecast.
_NAMED_AGENTS = 2


class Playback:
    """One recording on its way through a stream.

    Args:
        scenes: what is sent, in order of time.
        interval_s: wall-clock seconds between two frames; None sends each as soon as the one
            before is answered.
        show_frames: whether every frame gets a line.
    """

    def __init__(
        self, scenes: Iterator[Scene], *, interval_s: float | None, show_frames: bool
    ) -> None:
        self._scenes = scenes
        self._interval_s = interval_s
        self._show_frames = show_frames
        self._answered = asyncio.Semaphore(1)
        self._waiting: deque[tuple[Scene, float]] = deque()
        self._latencies_s: list[float] = []
        self._outcomes: Counter[str] = Counter()
        self._forecasts = 0
        self._duration_s = 0.0

    async def run(
        self, target: str, session: str | None, config: SessionOptions, options: ForecastOptions
    ) -> None:
        """Streams everything; raises what the client raises."""
        async with AsyncClient(target, access=Access.from_environment()) as client:
            stream = client.stream(
                self._frames(),
                session_id=session,
                config=config,
                close_session_at_end=session is None,
                **options,
            )
            start = time.perf_counter()
            async with stream:
                async for reply in stream:
                    self._take(reply)
            self._duration_s = time.perf_counter() - start

    async def _frames(self) -> AsyncIterator[Frame]:
        """The scenes as frames, each when it is due."""
        clock = asyncio.get_running_loop().time
        start = clock()
        for number, scene in enumerate(self._scenes):
            if self._interval_s is None:
                await self._answered.acquire()
            else:
                await asyncio.sleep(max(start + number * self._interval_s - clock(), 0.0))
            self._waiting.append((scene, time.perf_counter()))
            yield Frame(scene.time_s, [Agent(*agent) for agent in scene.agents])

    def _take(self, reply: StreamReply) -> None:
        """Counts and shows a reply; they come in the order of the frames."""
        scene, sent = self._waiting.popleft()
        latency_s = time.perf_counter() - sent
        self._answered.release()
        self._latencies_s.append(latency_s)
        self._outcomes[reply.result.outcome.value] += 1
        self._forecasts += reply.forecast is not None
        if self._show_frames:
            out.print(_line(scene, latency_s, reply), markup=False)

    def summarise(self) -> None:
        """Prints how many frames went, what became of them, and the latencies' percentiles."""
        if not self._latencies_s:
            out.print("no frames in this part of the recording")
            return
        latencies_ms = np.array(self._latencies_s) * 1e3
        table = Table(title="replay", title_justify="left", show_header=False)
        table.add_row("frames", f"{len(latencies_ms)} in {self._duration_s:.1f} s")
        for outcome, count in self._outcomes.most_common():
            table.add_row(f"  {outcome}", str(count))
        table.add_row("forecasts", str(self._forecasts))
        p50, p95, p99 = np.percentile(latencies_ms, [50, 95, 99])
        table.add_row(
            "latency, ms",
            f"p50 {p50:.1f}   p95 {p95:.1f}   p99 {p99:.1f}   max {latencies_ms.max():.1f}",
        )
        out.print(table)


def _line(scene: Scene, latency_s: float, reply: StreamReply) -> str:
    start = f"{scene.time_s:9.2f} s {len(scene.agents):4d} agents {latency_s * 1e3:7.1f} ms   "
    if reply.result.refused:
        return f"{start}{reply.result.outcome.value}: {reply.result.message}"
    if reply.error is not None:
        return f"{start}no forecast: {reply.error}"
    return start + ("" if reply.forecast is None else _ends(reply.forecast))


def _ends(forecast: Forecast) -> str:
    """Where the agents seen for longest are most likely to be at the end."""
    longest = sorted(forecast, key=lambda agent: -agent.observations)[:_NAMED_AGENTS]
    ends = []
    for agent in longest:
        if agent.mean is not None:
            mode = agent.most_probable_mode
            x, y = agent.mean[mode, -1]
            share = agent.mode_probabilities[mode]
            ends.append(f"{agent.id} to ({x:.1f}, {y:.1f}) {share:.0%}")
    rest = len(forecast) - len(ends)
    more = f" and {rest} more" if rest else ""
    return f"in {forecast.time_offsets_s[-1]:.1f} s: " + "; ".join(ends) + more if ends else ""
