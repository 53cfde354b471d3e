"""How long work takes, learned from how long it took.

A piece of work is a vector of amounts, one for each kind (``Work``). A batch takes a fixed time
and, for each kind, its amount times that kind's seconds. After each batch the estimates are
multiplied, each by the share it had in the prediction, towards what was measured: they stay
positive, need no units of their own, and follow a machine that gets slower or faster.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple


class Work(NamedTuple):
    """Amounts of each kind: jobs, encoder steps of agents, sampled positions, modes' positions."""

    jobs: float = 0.0
    steps: float = 0.0
    samples: float = 0.0
    modes: float = 0.0


# Seconds of a batch and of one of each kind, before anything is measured: a quick machine's, so
# that nobody is refused for a guess.
_FIRST_BATCH_S = 2e-4
_FIRST_S = Work(jobs=5e-5, steps=5e-6, samples=3e-7, modes=1e-6)
# How far one batch moves the estimates (an exponent), and the most that it may be off.
_LEARNING = 0.2
_MOST_OFF = 4.0
# What an estimate loses when it alone has refused work: else a wrong one could never be corrected.
_DOUBT = 0.9


class Pace:
    """The seconds of a batch and of each kind of work."""

    def __init__(self) -> None:
        self._batch_s = _FIRST_BATCH_S
        self._each_s: tuple[float, ...] = _FIRST_S

    @property
    def batch_s(self) -> float:
        """The fixed time of a batch."""
        return self._batch_s

    def seconds(self, work: Work) -> float:
        """The time of work that shares its batch's fixed time with others."""
        return sum(amount * each for amount, each in zip(work, self._each_s, strict=True))

    def learn(self, done: Iterable[Work], took_s: float) -> None:
        """Takes note that one batch of this work took so long."""
        total = [sum(column) for column in zip(*done, strict=True)]
        parts = [amount * each for amount, each in zip(total, self._each_s, strict=True)]
        expected_s = self._batch_s + sum(parts)
        off = min(max(took_s / expected_s, 1.0 / _MOST_OFF), _MOST_OFF)
        self._batch_s *= off ** (_LEARNING * self._batch_s / expected_s)
        self._each_s = tuple(
            each * off ** (_LEARNING * part / expected_s)
            for each, part in zip(self._each_s, parts, strict=True)
        )

    def doubt(self, work: Work) -> None:
        """Lowers what alone stood against a piece of work: it may be wrong."""
        self._batch_s *= _DOUBT
        self._each_s = tuple(
            each * _DOUBT if amount else each
            for amount, each in zip(work, self._each_s, strict=True)
        )
