"""How much time watching may take: a share of the time that inference takes, earned as it goes."""

from __future__ import annotations

from typing import Literal

# Earned at most so far ahead: a quiet hour must not be followed by seconds of scoring.
_MOST_S = 0.25
# Before anything has been measured: the cost of scoring one agent's forecast.
_FIRST_GUESS_S = 0.002
_FIRST_S = 0.01
# Of the newest measurement in the running means of the costs.
_WEIGHT = 0.2


class Budget:
    """Seconds earned, spent, and set aside for forecasts that are still to be scored.

    Work is let in while something is left and paid for afterwards, so a large forecast is as
    likely to be let in as a small one, and the share holds on average.

    Args:
        share: of inference time that may be spent, greater than 0; far more than 1 lets all in.
    """

    def __init__(self, share: float) -> None:
        self._share = share
        # The very first forecasts are let in, so that costs become known.
        self._left_s = _FIRST_S * max(1.0, share)
        self._cost_s = {"draw": _FIRST_GUESS_S, "score": _FIRST_GUESS_S}

    @property
    def left_s(self) -> float:
        """What may be spent now; negative after more was spent than expected."""
        return self._left_s

    def earn(self, inference_s: float) -> None:
        """Inference took so long."""
        most_s = _MOST_S * max(1.0, self._share)
        self._left_s = min(self._left_s + self._share * inference_s, most_s)

    def reserve(self, agents: int, *, draw: bool) -> float | None:
        """Sets aside what scoring will cost, in seconds; None when nothing is left.

        Args:
            agents: whose forecasts would be scored.
            draw: whether their mixture has to be drawn first.
        """
        if self._left_s <= 0.0:
            return None
        cost_s = agents * (self._cost_s["score"] + (self._cost_s["draw"] if draw else 0.0))
        self._left_s -= cost_s
        return cost_s

    def release(self, reserved_s: float) -> None:
        """Gives back what was set aside: the work was done, and paid by ``spend``, or dropped."""
        self._left_s += reserved_s

    def spend(self, seconds: float) -> None:
        """Pays for work done."""
        self._left_s -= seconds

    def note(self, kind: Literal["draw", "score"], agents: int, seconds: float) -> None:
        """Drawing the mixtures of some agents, or scoring them, took so long."""
        self._cost_s[kind] += _WEIGHT * (seconds / max(1, agents) - self._cost_s[kind])
