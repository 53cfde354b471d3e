"""How late the event loop is: what blocks it makes everybody wait."""

from __future__ import annotations

import asyncio
import time

from prometheus_client import Histogram

# Often enough that a block counts for nearly all of its length, seldom enough to cost nothing.
PERIOD_S = 0.02


async def measure_lag(lag: Histogram) -> None:
    """Notes how much later than due each of many short sleeps ends, until cancelled."""
    while True:
        due = time.monotonic() + PERIOD_S
        await asyncio.sleep(PERIOD_S)
        lag.observe(max(0.0, time.monotonic() - due))
