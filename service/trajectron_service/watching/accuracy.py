"""Forecasts of sessions, held until their future has come, then scored: ``LiveAccuracy``.

**What is judged** is what the offline protocol ``streaming`` judges: agents seen in the frame
that the forecast starts from, at the steps of their future that came, up to the model's own
horizon; the whole mixture of the model, whatever mode was asked for.

**Which.** A share of the forecasts: as many as a budget allows, a share of the time that
inference takes (``budget``). All of it is counted: the mixture of a forecast that was asked
without modes has to be drawn, then the truth is read off the frames, then densities are taken.
Drawing and scoring run on the inference thread between batches, a few agents at a time, so a
forecast never waits long for them.

**Bounds.** At most so many agents' forecasts are pending over all sessions; of more, the oldest
are given up (outcome ``evicted``). What a session has pending when it closes is scored over the
steps that came. Nothing is kept in the store: what is pending in a process goes with it, and a
session that moves to another replica leaves steps behind that are not known here.

Use from one event loop.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from trajectron_model.evaluation import live
from trajectron_service import logs
from trajectron_service.messages import AgentForecast, Forecast
from trajectron_service.metrics import AccuracyMetrics
from trajectron_service.stores import SessionKey
from trajectron_service.timebase import Observation
from trajectron_service.watching.budget import Budget
from trajectron_service.watching.pending import Pending, mixture_of, places_of, rows_of

# Agents drawn or scored in one go: some milliseconds.
AGENTS_AT_ONCE = 8
# An agent whose last observation is this much older than the newest frame was not in it.
_OLD_S = 1e-6

# Draws the forecasts of some agents with modes, on the inference thread.
Draw = Callable[[tuple[str, ...]], Sequence[AgentForecast]]
# Runs a call on the inference thread, between batches.
RunAlone = Callable[[Callable[[], None]], Awaitable[None]]

log = logs.get(__name__)


def _random(_: Pending) -> np.random.Generator:
    return np.random.default_rng()


@dataclass(frozen=True)
class WatchLimits:
    """How much is watched.

    Attributes:
        share: of inference time that watching may take; see ``Budget``.
        pending: agents whose forecasts may wait for their future.
        agents_at_once: drawn or scored in one go.
    """

    share: float
    pending: int
    agents_at_once: int = AGENTS_AT_ONCE


@dataclass(eq=False)
class _Session:
    """What is known of a session that has forecasts pending."""

    version: int
    newest: Observation
    pending: list[Pending] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Work:
    """Something for the inference thread: the mixture is drawn, or the forecast scored."""

    kind: Literal["draw", "score"]
    pending: Pending
    draw: Draw | None = None


class LiveAccuracy:
    """Told about forecasts, frames and ends of sessions; tells the metrics what they scored.

    Args:
        limits: how much is watched.
        metrics: where scores and outcomes go.
        run_alone: see ``RunAlone``.
        horizons: the steps that are judged, by model.
        random: the generator of the draws that rank the truth of one forecast.
    """

    def __init__(
        self,
        limits: WatchLimits,
        metrics: AccuracyMetrics,
        run_alone: RunAlone,
        horizons: Callable[[str], int],
        random: Callable[[Pending], np.random.Generator] = _random,
    ) -> None:
        self._limits = limits
        self._metrics = metrics
        self._run_alone = run_alone
        self._horizons = horizons
        self._random = random
        self._budget = Budget(limits.share)
        self._sessions: dict[SessionKey, _Session] = {}
        # All that waits for its future, oldest first.
        self._waiting: OrderedDict[Pending, SessionKey] = OrderedDict()
        self._agents = 0
        self._work: asyncio.Queue[_Work] = asyncio.Queue()
        self._worker: asyncio.Task[None] | None = None

    @property
    def pending_agents(self) -> int:
        """Agents whose forecasts wait for their future, or to be drawn or scored."""
        return self._agents

    @property
    def budget(self) -> Budget:
        """What may be spent."""
        return self._budget

    def inferred(self, seconds: float) -> None:
        """A batch took so long on the inference thread."""
        self._budget.earn(seconds)

    def frame(self, key: SessionKey, version: int, seen: Observation) -> None:
        """A session accepted a frame, its ``version``-th."""
        session = self._sessions.get(key)
        if session is None:
            return
        start = time.perf_counter()
        if version <= session.version or seen.time_s <= session.newest.time_s:
            # Another session under the same name, opened where this process did not see it.
            self.closed(key)
            return
        places = places_of(seen)
        for pending in session.pending:
            pending.advance(session.newest, seen, places)
            if pending.complete:
                self._finish(pending)
        session.pending = [one for one in session.pending if not one.complete]
        session.version, session.newest = version, seen
        if not session.pending:
            del self._sessions[key]
        self._spend(time.perf_counter() - start)

    def forecast(
        self,
        key: SessionKey,
        version: int,
        seen: Observation,
        forecast: Forecast,
        draw: Draw | None,
    ) -> None:
        """A session was given a forecast from ``seen``, its newest frame.

        Args:
            key: of the session.
            version: of the session at that frame.
            seen: the frame.
            forecast: as the client gets it.
            draw: gives forecasts of some of its agents with modes; None when the state that it
                came from is gone, so that one without modes cannot be scored.
        """
        start = time.perf_counter()
        for agents in self._pieces(seen, forecast):
            drawn = any(agent.mean is None or agent.covariance is None for agent in agents)
            possible = draw is not None or not drawn
            reserved_s = self._budget.reserve(len(agents), draw=drawn) if possible else None
            if reserved_s is None:
                self._metrics.agents.labels("skipped").inc(len(agents))
                continue
            pending = self._hold(key, version, seen, forecast, agents, reserved_s)
            if drawn:
                self._enqueue(_Work("draw", pending, draw))
            else:
                pending.mixture = mixture_of(agents, pending.horizon)
        self._spend(time.perf_counter() - start)

    def closed(self, key: SessionKey) -> None:
        """A session has ended: what it has pending is scored over the steps that came."""
        session = self._sessions.pop(key, None)
        for pending in session.pending if session else ():
            self._finish(pending)

    async def settled(self) -> None:
        """Returns when nothing waits to be drawn or scored."""
        await self._work.join()

    async def close(self) -> None:
        """Gives up everything that is pending."""
        if self._worker is not None:
            self._worker.cancel()
            await asyncio.gather(self._worker, return_exceptions=True)

    def _pieces(self, seen: Observation, forecast: Forecast) -> list[list[AgentForecast]]:
        """The agents that are judged, in the order of the frame, a few at a time."""
        order = {agent: row for row, agent in enumerate(seen.ids)}
        oldest_s = forecast.reference_time - _OLD_S
        judged = [
            agent
            for agent in forecast.agents
            if agent.last_observed_time >= oldest_s and agent.id in order
        ]
        judged.sort(key=lambda agent: order[agent.id])
        size = self._limits.agents_at_once
        return [judged[first : first + size] for first in range(0, len(judged), size)]

    def _hold(
        self,
        key: SessionKey,
        version: int,
        seen: Observation,
        forecast: Forecast,
        agents: Sequence[AgentForecast],
        reserved_s: float,
    ) -> Pending:
        offsets = forecast.time_offsets_s
        pending = Pending(
            model=forecast.model,
            reference_time_s=forecast.reference_time,
            dt_s=offsets[0],
            horizon=min(len(offsets), self._horizons(forecast.model)),
            ids=tuple(agent.id for agent in agents),
            types=tuple(agent.type for agent in agents),
            reserved_s=reserved_s,
        )
        session = self._sessions.setdefault(key, _Session(version, seen))
        session.pending.append(pending)
        self._waiting[pending] = key
        self._count(len(agents))
        while self._agents > self._limits.pending and self._waiting:
            oldest = next(iter(self._waiting))
            self._forget(oldest)
            self._drop(oldest, evicted=len(oldest.ids))
        return pending

    def _forget(self, pending: Pending) -> None:
        """Takes it out of those that wait for their future, where it is one."""
        key = self._waiting.pop(pending, None)
        if key is None:
            return
        session = self._sessions[key]
        session.pending.remove(pending)
        if not session.pending:
            del self._sessions[key]

    def _finish(self, pending: Pending) -> None:
        """No more of its future comes: scores it, after its mixture was drawn."""
        del self._waiting[pending]
        if pending.known.any():
            self._enqueue(_Work("score", pending))
        else:
            self._drop(pending, unseen=len(pending.ids))

    def _drop(self, pending: Pending, **agents: int) -> None:
        """Lets it go, for good; what became of how many agents goes into the metrics."""
        pending.mixture, pending.dropped = None, True
        self._budget.release(pending.reserved_s)
        self._count(-len(pending.ids))
        for outcome, count in agents.items():
            self._metrics.agents.labels(outcome).inc(count)

    def _enqueue(self, work: _Work) -> None:
        self._work.put_nowait(work)
        if self._worker is None or self._worker.done():
            self._worker = asyncio.create_task(self._do_all(), name="live-accuracy")

    async def _do_all(self) -> None:
        """Draws and scores what is queued, in order, until nothing is."""
        while not self._work.empty():
            work = self._work.get_nowait()
            try:
                if not work.pending.dropped:
                    await self._do(work)
            finally:
                self._work.task_done()

    async def _do(self, work: _Work) -> None:
        pending, took = work.pending, _Took()

        def call() -> None:
            with took:
                self._draw(pending, work.draw) if work.draw else self._score(pending)

        try:
            await self._run_alone(call)
        except Exception:
            # Watching is no reason to fail anybody; the metric and the log tell.
            log.exception("a forecast could not be watched", model=pending.model, part=work.kind)
            # It may have been given up for its age while it was being drawn.
            if not pending.dropped:
                self._forget(pending)
                self._drop(pending, failed=len(pending.ids))
        else:
            self._budget.note(work.kind, len(pending.ids), took.seconds)
            if work.kind == "score":
                scored = int(pending.known.sum())
                self._drop(pending, scored=scored, unseen=len(pending.ids) - scored)
        self._spend(took.seconds)

    def _draw(self, pending: Pending, draw: Draw) -> None:
        """On the inference thread."""
        if not pending.dropped:
            pending.mixture = mixture_of(draw(pending.ids), pending.horizon)

    def _score(self, pending: Pending) -> None:
        """On the inference thread."""
        if pending.mixture is None:
            raise RuntimeError("the forecast was not drawn")
        known = pending.known
        scores = live.score(
            rows_of(pending.mixture, known), pending.truth[known], self._random(pending)
        )
        types = np.array(pending.types)[known]
        for kind in sorted(set(types.tolist())):
            self._metrics.note(pending.model, kind, scores.only(types == kind))

    def _count(self, agents: int) -> None:
        self._agents += agents
        self._metrics.pending.set(self._agents)

    def _spend(self, seconds: float) -> None:
        self._budget.spend(seconds)
        self._metrics.seconds.inc(seconds)


class _Took:
    """How long a block ran, in seconds."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._start = 0.0

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.seconds = time.perf_counter() - self._start
