"""Streams under interruption, beside the same streams without: for ``crash`` and ``handover``.

Sessions stream frames and keep every reply. Afterwards the same frames go to other sessions, which
nobody interrupts, and the replies are compared, forecast by forecast.
"""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

import trajectron_client as tc

SEED = 7
# Alone in its batch, a forecast is the same to the last bit; see DESIGN.md on determinism.
ALONE = {"max_batch_points": "1"}
_DT_S = 0.4
_PACE_S = 0.04
_TOLERANCE_M = 1e-4
_PATIENCE_S = 120.0


@dataclass
class Walk:
    """One session's stream: its frames, its replies in order, and what went wrong."""

    number: int
    session_id: str
    replies: list[tc.StreamReply] = field(default_factory=list)
    reconnects: int = 0
    fault: BaseException | None = None

    def frame(self, step: int) -> tc.Frame:
        """Three people who walk past each other; steps and walks alike give the same."""
        t = step * _DT_S
        agents = [
            tc.Agent(
                f"{self.number}-{row}",
                "pedestrian",
                1.1 * t + row + self.number,
                0.8 * row + 0.3 * math.sin(t + row + self.number),
            )
            for row in range(3)
        ]
        return tc.Frame(t, agents)

    def stream(self, targets: Sequence[str], frames: Iterator[tc.Frame]) -> None:
        """Streams frames until they end; every reply is kept."""
        with tc.Client(targets) as client:
            stream = client.stream(
                frames, session_id=self.session_id, mode="full", num_samples=3, seed=SEED
            )
            try:
                self.replies.extend(stream)
            finally:
                self.reconnects = stream.reconnects


class Load:
    """Walks that stream at once, each in a thread, until they are told to stop."""

    def __init__(self, targets: Sequence[str], sessions: int) -> None:
        self.walks = [Walk(number, f"walk-{number}") for number in range(sessions)]
        self._targets = targets
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=self._run, args=(walk,), daemon=True) for walk in self.walks
        ]

    def start(self) -> None:
        """Begins."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Ends the frames, and waits for the last replies."""
        self._stop.set()
        for thread in self._threads:
            thread.join(_PATIENCE_S)
        for walk in self.walks:
            if walk.fault is not None:
                raise walk.fault

    def moves_on(self) -> None:
        """Returns once every walk has had another reply."""
        before = [len(walk.replies) for walk in self.walks]
        until = time.monotonic() + _PATIENCE_S
        while any(len(w.replies) <= n for w, n in zip(self.walks, before, strict=True)):
            for walk in self.walks:
                if walk.fault is not None:
                    raise walk.fault
            if time.monotonic() > until:
                raise RuntimeError(f"streams stand still at {before}")
            time.sleep(0.01)

    def acknowledged(self) -> list[int]:
        """The replies that each walk has had so far."""
        return [len(walk.replies) for walk in self.walks]

    def _run(self, walk: Walk) -> None:
        try:
            walk.stream(self._targets, self._frames(walk))
        except BaseException as error:  # noqa: BLE001  raised where the load is watched
            walk.fault = error

    def _frames(self, walk: Walk) -> Iterator[tc.Frame]:
        step = 0
        while not self._stop.is_set():
            yield walk.frame(step)
            step += 1
            time.sleep(_PACE_S)


@dataclass(frozen=True)
class Comparison:
    """Interrupted streams beside uninterrupted ones; lengths in metres."""

    sessions: int
    frames: int
    lost: int
    twice: int
    answered_again: int
    reconnects: int
    forecasts: int
    forecasts_passed_over: int
    identical: int
    beyond_tolerance: int
    largest_difference_m: float

    @property
    def exact(self) -> bool:
        """Whether nothing was lost or doubled and every forecast is the same to the last bit."""
        return self.whole and self.identical == self.forecasts

    @property
    def whole(self) -> bool:
        """Whether nothing was lost or doubled, and forecasts keep the rule of determinism."""
        within = self.beyond_tolerance * 10_000 <= self.forecasts * 3
        return self.lost == self.twice == 0 and self.forecasts > 0 and within


def check_stored(target: str, walks: Sequence[Walk], acknowledged: Sequence[int]) -> None:
    """Raises where a session has fewer frames than were acknowledged, or one twice."""
    with tc.Client(target) as client:
        for walk, least in zip(walks, acknowledged, strict=True):
            info = client.get_session(walk.session_id).info
            if (info.last_sequence or 0) < least:
                raise RuntimeError(f"{walk.session_id}: {least} acknowledged, {info} is there")
            if info.version != (info.last_sequence or 0):
                raise RuntimeError(f"{walk.session_id}: {info} counts other frames than were sent")


def compare(walks: Sequence[Walk], target: str) -> Comparison:
    """Sends the same frames again, to sessions that nobody interrupts, and compares the replies.

    Args:
        walks: what was interrupted; ended by now.
        target: a replica that has their sessions, and runs on undisturbed.
    """
    lost = twice = again = forecasts = passed = identical = beyond = 0
    largest = 0.0
    with tc.Client(target) as client:
        for walk in walks:
            version = client.get_session(walk.session_id).info.version
            sent = len(walk.replies)
            numbers = [reply.sequence for reply in walk.replies]
            lost += max(0, sent - version) + len(set(range(1, sent + 1)) - set(numbers))
            twice += max(0, version - sent) + sent - len(set(numbers))
            other = Walk(walk.number, f"undisturbed-{walk.number}")
            other.stream((target,), (other.frame(step) for step in range(sent)))
            if other.reconnects:
                raise RuntimeError("the run to compare with was interrupted itself")
            for reply, wanted in zip(walk.replies, other.replies, strict=True):
                again += reply.result.outcome is tc.Outcome.DUPLICATE
                if reply.forecast is None:
                    passed += 1
                    continue
                assert wanted.forecast is not None  # asked for, and nothing came between
                differs_m = difference_m(reply.forecast, wanted.forecast)
                forecasts += 1
                identical += differs_m == 0.0
                beyond += differs_m > _TOLERANCE_M
                largest = max(largest, differs_m)
    return Comparison(
        sessions=len(walks),
        frames=sum(len(walk.replies) for walk in walks),
        lost=lost,
        twice=twice,
        answered_again=again,
        reconnects=sum(walk.reconnects for walk in walks),
        forecasts=forecasts,
        forecasts_passed_over=passed,
        identical=identical,
        beyond_tolerance=beyond,
        largest_difference_m=largest,
    )


def difference_m(first: tc.Forecast, second: tc.Forecast) -> float:
    """The largest difference between the samples of two forecasts, or of their probabilities."""
    if [agent.id for agent in first] != [agent.id for agent in second]:
        return math.inf
    largest = 0.0
    for one, other in zip(first, second, strict=True):
        for name in ("samples", "mode_probabilities"):
            a, b = getattr(one, name), getattr(other, name)
            largest = max(largest, float(np.abs(a - b).max()))
    return largest


def middle(seconds: Sequence[float]) -> float:
    """The median, in seconds, for a report."""
    return round(statistics.median(seconds), 3) if seconds else 0.0
