"""Noise at 10 Hz: what a session of four chains forecasts is what one at 2.5 Hz does."""

from __future__ import annotations

import asyncio

import numpy as np

from benchmarks.ten_hertz import judge, observed
from trajectron_model.data.eth_ucy import EthUcy
from trajectron_model.evaluation import protocols


def test_frames_between_two_steps_lie_on_a_straight_line(eth_ucy: EthUcy) -> None:
    window = protocols.windows("sgan", eth_ucy.test("zara1"))[0]
    ids, fine = observed(window)
    assert set(window.ids) <= set(ids) and fine.shape == (29, len(ids), 2)
    judged = [ids.index(name) for name in window.ids]
    steps = fine[::4, judged].swapaxes(0, 1)
    np.testing.assert_allclose(steps, window.history())
    np.testing.assert_allclose(fine[2, judged], (steps[:, 0] + steps[:, 1]) / 2)


def test_a_session_at_ten_hertz_forecasts_as_one_at_the_models_rate(eth_ucy: EthUcy) -> None:
    windows = protocols.windows("sgan", eth_ucy.test("zara1"))[:1]
    slow, fast = (asyncio.run(judge("zara1", windows, 0.05, rate)) for rate in (1, 4))
    clean = asyncio.run(judge("zara1", windows, 0.0, 4))
    # Samples are keyed by the session's version, which counts frames: all else is equal.
    np.testing.assert_allclose(fast[2:], slow[2:], atol=1e-5)
    assert (np.abs(fast[2:4] - clean[2:4]) > 1e-3).all()
