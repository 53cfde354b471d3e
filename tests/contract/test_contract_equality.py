"""The transports give one answer: the same forecast to float32, the same session."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any

import numpy as np
import pytest
from tests.contract.drivers import Driver
from tests.contract.scenes import walking

pytestmark = pytest.mark.asyncio(loop_scope="session")

# Positions of a few metres in float32; over JSON they travel as doubles.
FLOAT32_M = 1e-5


def assert_same(one: Any, other: Any) -> None:
    """Equal in every field, numbers to float32."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name, value in one.items():
            assert_same(value, other[name])
    elif isinstance(one, np.ndarray):
        np.testing.assert_allclose(one, other, atol=FLOAT32_M, rtol=1e-5)
    elif isinstance(one, list):
        assert len(one) == len(other)
        for left, right in zip(one, other, strict=True):
            assert_same(left, right)
    elif isinstance(one, float):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-9)
    else:
        assert one == other


@pytest.mark.parametrize("mode", ["full", "z_best", "gmm"])
@pytest.mark.parametrize("include_modes", [None, True, False])
async def test_stateless_forecasts_are_the_same(
    drivers: tuple[Driver, Driver], mode: str, include_modes: bool | None
) -> None:
    options = {"mode": mode, "num_samples": 7, "horizon": 9, "seed": 11}
    if include_modes is not None:
        options["include_modes"] = include_modes
    one, other = [await driver.predict(walking(6), **options) for driver in drivers]
    assert_same(one, other)


async def test_stratified_forecasts_are_the_same(drivers: tuple[Driver, Driver]) -> None:
    options = {"num_samples": 7, "horizon": 9, "seed": 11, "sampling": "stratified"}
    one, other = [await driver.predict(walking(6), **options) for driver in drivers]
    assert_same(one, other)


async def test_defaults_are_the_same(drivers: tuple[Driver, Driver]) -> None:
    one, other = [await driver.predict(walking(), seed=1) for driver in drivers]
    assert_same(one, other)


async def test_a_session_is_the_same_from_both_sides(drivers: tuple[Driver, Driver]) -> None:
    http, grpc = drivers
    created = await http.create_session("shared", agent_timeout_s=3.5, frame_interval_s=0.2)
    try:
        frames = walking(4)
        await http.observe("shared", frames[:1])
        await grpc.observe("shared", frames[1:2])
        await http.observe("shared", frames[2:])
        one, other = [await driver.get_session("shared") for driver in drivers]
        created_at = [datetime.fromisoformat(seen.pop("create_time")) for seen in (one, other)]
        assert abs(created_at[0] - created_at[1]) < timedelta(milliseconds=1)
        # Looking at a session keeps it open: the later look sees it expire no earlier.
        expires_at = [datetime.fromisoformat(seen.pop("expire_time")) for seen in (one, other)]
        assert created_at[0] < expires_at[0] <= expires_at[1]
        assert_same(one, other)
        assert one["version"] == 4
        assert one["agent_timeout_s"] == created["agent_timeout_s"] == 3.5
        predicted = [
            await driver.predict_session("shared", num_samples=3, seed=2) for driver in drivers
        ]
        assert_same(*predicted)
    finally:
        await grpc.delete_session("shared")


async def test_a_session_forecasts_what_its_history_forecasts(
    drivers: tuple[Driver, Driver],
) -> None:
    for driver in drivers:
        await driver.create_session("history")
        try:
            await driver.observe("history", walking(5))
            options = {"mode": "gmm", "horizon": 8}
            kept = await driver.predict_session("history", **options)
            stateless = await driver.predict(walking(5), **options)
        finally:
            await driver.delete_session("history")
        for one, other in zip(kept["agents"], stateless["agents"], strict=True):
            np.testing.assert_allclose(one["mean"], other["mean"], atol=1e-4)


async def test_models_are_the_same(drivers: tuple[Driver, Driver]) -> None:
    one, other = [await driver.list_models() for driver in drivers]
    assert_same(one, other)
