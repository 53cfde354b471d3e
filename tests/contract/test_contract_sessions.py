"""What holds of sessions over both transports: life cycle, frames, untouched state."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest
from tests.contract.drivers import CODES, Driver, RefusalError
from tests.contract.scenes import DT_S, Json, agent, frame, walking
from tests.contract.servers import MAX_SESSIONS

pytestmark = pytest.mark.asyncio(loop_scope="session")


@asynccontextmanager
async def session(
    driver: Driver, frames: list[Json] | None = None, **config: Any
) -> AsyncIterator[str]:
    """A session with some history, closed at the end."""
    created = await driver.create_session(**config)
    try:
        if frames:
            await driver.observe(created["id"], frames)
        yield created["id"]
    finally:
        await driver.delete_session(created["id"])


@asynccontextmanager
async def refused(driver: Driver, kind: str) -> AsyncIterator[pytest.ExceptionInfo[RefusalError]]:
    """The block is refused, as this kind and with this transport's code for it."""
    with pytest.raises(RefusalError) as caught:
        yield caught
    assert caught.value.kind == kind
    assert caught.value.code == CODES[kind][driver.name]


async def picture(driver: Driver, session_id: str) -> Json:
    """Everything of a session that a refused frame must leave as it is."""
    state = await driver.get_session(session_id)
    del state["expire_time"]
    return state


async def test_a_session_is_created_shown_listed_and_deleted(driver: Driver) -> None:
    created = await driver.create_session("life", agent_timeout_s=3.0)
    assert created["id"] == "life"
    assert (created["version"], created["agent_count"]) == (0, 0)
    assert created["last_frame_time"] is None
    assert created["last_sequence"] is None
    assert created["agent_timeout_s"] == 3.0
    assert created["dt_s"] == created["frame_interval_s"] == DT_S
    [default] = [model for model in await driver.list_models() if model["is_default"]]
    assert created["model"] == default["name"]
    assert created["create_time"] < created["expire_time"]
    shown = await driver.get_session("life")
    assert shown["graph"] == {"nodes": [], "edges": []}
    assert "life" in [one["id"] for one in (await driver.list_sessions())["sessions"]]
    await driver.delete_session("life")
    async with refused(driver, "UNKNOWN_SESSION"):
        await driver.get_session("life")


async def test_ids_are_assigned_when_none_is_chosen(driver: Driver) -> None:
    async with session(driver) as one, session(driver) as other:
        assert one != other


async def test_an_id_is_taken_once(driver: Driver) -> None:
    async with session(driver, walking(2), session_id="taken"):
        before = await picture(driver, "taken")
        async with refused(driver, "SESSION_EXISTS"):
            await driver.create_session("taken")
        assert await picture(driver, "taken") == before


@pytest.mark.parametrize("bad", ["a b", "x" * 129, "ü"])
async def test_ids_of_sessions_have_few_letters(driver: Driver, bad: str) -> None:
    async with refused(driver, "INVALID_ARGUMENT") as refusal:
        await driver.create_session(bad)
    assert refusal.value.fields == ("session_id",)


@pytest.mark.parametrize("name", ["agent_timeout_s", "idle_timeout_s", "frame_interval_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, 1e8])
async def test_spans_of_a_session_have_bounds(driver: Driver, name: str, value: float) -> None:
    async with refused(driver, "INVALID_ARGUMENT") as refusal:
        await driver.create_session(None, **{name: value})
    assert name.removesuffix("_s") in refusal.value.fields[0]


async def test_a_session_of_an_unknown_model_is_not_found(driver: Driver) -> None:
    async with refused(driver, "UNKNOWN_MODEL"):
        await driver.create_session(model="no-such-model")


async def test_an_unknown_session_is_not_found_by_any_call(driver: Driver) -> None:
    for call in (
        driver.get_session("nowhere"),
        driver.delete_session("nowhere"),
        driver.observe("nowhere", walking(1)),
        driver.predict_session("nowhere"),
    ):
        async with refused(driver, "UNKNOWN_SESSION") as refusal:
            await call
        assert "nowhere" in refusal.value.message


async def test_sessions_are_listed_in_pages_in_order(driver: Driver) -> None:
    names = [f"page-{k}" for k in range(5)]
    for name in names:
        await driver.create_session(name)
    try:
        seen: list[str] = []
        token = ""
        while True:
            page = await driver.list_sessions(2, token)
            assert len(page["sessions"]) <= 2
            seen += [one["id"] for one in page["sessions"]]
            token = page["next_page_token"]
            if not token:
                break
        assert [name for name in seen if name.startswith("page-")] == names
        assert seen == sorted(seen)
    finally:
        for name in names:
            await driver.delete_session(name)


@pytest.mark.parametrize("size", [0, 1001])
async def test_the_size_of_a_page_has_bounds(driver: Driver, size: int) -> None:
    async with refused(driver, "INVALID_ARGUMENT") as refusal:
        await driver.list_sessions(size)
    assert refusal.value.fields == ("page_size",)


async def test_a_forged_page_token_is_refused_or_empty_but_no_fault(driver: Driver) -> None:
    try:
        await driver.list_sessions(2, "\x00nonsense")
    except RefusalError as refusal:
        assert refusal.kind == "INVALID_ARGUMENT"  # noqa: PT017  either answer is right


async def test_frames_grow_the_graph(driver: Driver) -> None:
    async with session(driver) as opened:
        results = await driver.observe(opened, walking(3, agents=3))
        assert [one["outcome"] for one in results] == ["accepted"] * 3
        assert [one["version"] for one in results] == [1, 2, 3]
        state = await driver.get_session(opened)
        assert (state["version"], state["agent_count"]) == (3, 3)
        assert state["last_frame_time"] == pytest.approx(2 * DT_S)
        assert [node["id"] for node in state["graph"]["nodes"]] == ["0", "1", "2"]
        for number, node in enumerate(state["graph"]["nodes"]):
            assert (node["x"], node["y"]) == (1.0, float(number))
            assert node["observations"] == 3
        edges = {(edge["receiver_id"], edge["sender_id"]) for edge in state["graph"]["edges"]}
        assert edges == {(a, b) for a in "012" for b in "012" if a != b}
        for edge in state["graph"]["edges"]:
            assert edge["gone_steps"] == 0
            assert 0.0 < edge["modulation"] <= 1.0


async def test_a_forecast_starts_at_the_newest_frame(driver: Driver) -> None:
    async with session(driver, walking(3)) as opened:
        forecast = await driver.predict_session(opened, num_samples=2, seed=1)
        assert forecast["reference_time"] == pytest.approx(2 * DT_S)
        again = await driver.predict_session(opened, num_samples=2, seed=1)
        for one, other in zip(forecast["agents"], again["agents"], strict=True):
            assert one["samples"] == pytest.approx(other["samples"], abs=1e-4)


async def test_before_the_first_frame_there_is_no_forecast(driver: Driver) -> None:
    async with session(driver) as opened, refused(driver, "NO_FRAMES"):
        await driver.predict_session(opened)


async def test_frames_without_agents_are_observations(driver: Driver) -> None:
    async with session(driver, [frame(0.0)]) as opened:
        assert (await driver.predict_session(opened))["agents"] == []
        [result] = await driver.observe(opened, [frame(DT_S, agent())])
        assert result["outcome"] == "accepted"
        [result] = await driver.observe(opened, [frame(2 * DT_S)])
        assert result["outcome"] == "accepted"
        [carried] = (await driver.predict_session(opened))["agents"]
        assert carried["last_observed_time"] == pytest.approx(DT_S)


async def test_a_repeated_frame_changes_nothing(driver: Driver) -> None:
    frames = walking(3)
    async with session(driver, frames) as opened:
        before = await picture(driver, opened)
        [result] = await driver.observe(opened, frames[-1:])
        assert (result["outcome"], result["version"]) == ("duplicate", 3)
        assert await picture(driver, opened) == before


def _without(name: str) -> Json:
    bad = agent()
    del bad[name]
    return bad


NEXT = 3 * DT_S
REFUSED_FRAMES = {
    "conflict": ("FRAME_CONFLICT", frame(2 * DT_S, agent("0", 1.1)), None),
    "out of order": ("FRAME_OUT_OF_ORDER", frame(0.9 * DT_S, agent("0")), None),
    "nan": ("INVALID_ARGUMENT", frame(NEXT, agent("0", math.nan)), "agents[0].x"),
    "inf": ("INVALID_ARGUMENT", frame(NEXT, agent("8"), agent("9", 0.0, -math.inf)), "agents[1].y"),
    "nan time": ("INVALID_ARGUMENT", frame(math.nan, agent("0")), "time"),
    "no time": ("INVALID_ARGUMENT", {"agents": []}, "time"),
    "no x": ("INVALID_ARGUMENT", frame(NEXT, _without("x")), "agents[0].x"),
    "no id": ("INVALID_ARGUMENT", frame(NEXT, _without("id")), "agents[0].id"),
    "no type": ("INVALID_ARGUMENT", frame(NEXT, _without("type")), "agents[0].type"),
    "type": ("INVALID_ARGUMENT", frame(NEXT, agent("8", kind="dragon")), "agents[0].type"),
    "twice": ("INVALID_ARGUMENT", frame(NEXT, agent("8"), agent("8")), "agents[1].id"),
    "speed": ("INVALID_ARGUMENT", frame(NEXT, agent("0", 500.0)), "agents[0]"),
    "crowd": (
        "INVALID_ARGUMENT",
        frame(NEXT, *(agent(f"c{k}", float(k)) for k in range(10_000))),
        "agents",
    ),
}


@pytest.mark.parametrize("case", REFUSED_FRAMES)
async def test_a_refused_frame_leaves_the_session_as_it_was(driver: Driver, case: str) -> None:
    kind, bad, field = REFUSED_FRAMES[case]
    async with session(driver, walking(3)) as opened:
        before = await picture(driver, opened)
        async with refused(driver, kind) as refusal:
            await driver.observe(opened, [bad])
        if field is not None:
            assert [name.removeprefix("frames[0].") for name in refusal.value.fields] == [field]
        assert await picture(driver, opened) == before
        [result] = await driver.observe(opened, [walking(4)[-1]])
        assert (result["outcome"], result["version"]) == ("accepted", 4)


@pytest.mark.parametrize("case", REFUSED_FRAMES)
async def test_among_several_frames_a_refused_one_leaves_the_others(
    driver: Driver, case: str
) -> None:
    kind, bad, field = REFUSED_FRAMES[case]
    good = walking(4)
    async with session(driver, good[:3]) as opened, session(driver, good) as other:
        results = await driver.observe(opened, [bad, good[3]])
        outcome = kind.removeprefix("FRAME_").lower().removesuffix("_argument")
        assert [one["outcome"] for one in results] == [outcome, "accepted"]
        assert [one["version"] for one in results] == [3, 4]
        assert results[0]["message"]
        if field is not None:
            assert results[0]["field"].endswith(field)
        states = [await driver.get_session(one) for one in (opened, other)]
        assert states[0]["graph"] == states[1]["graph"]
        predicted = [await driver.predict_session(one, mode="gmm") for one in (opened, other)]
        for one, same in zip(predicted[0]["agents"], predicted[1]["agents"], strict=True):
            np.testing.assert_allclose(one["mean"], same["mean"], atol=1e-4)


async def test_observing_no_frame_is_refused(driver: Driver) -> None:
    async with session(driver) as opened:
        async with refused(driver, "INVALID_ARGUMENT") as refusal:
            await driver.observe(opened, [])
        assert refusal.value.fields == ("frames",)


async def test_unknown_types_follow_the_policy_of_the_session(driver: Driver) -> None:
    mixed = frame(0.0, agent("1"), agent("2", 2.0, kind="cyclist"))
    async with session(driver, unknown_types="ignore") as opened:
        [result] = await driver.observe(opened, [mixed])
        assert (result["outcome"], result["ignored_agents"]) == ("accepted", ["2"])
        assert (await driver.get_session(opened))["agent_count"] == 1
    type_map = {"cyclist": "pedestrian"}
    async with session(driver, unknown_types="map", type_map=type_map) as opened:
        [result] = await driver.observe(opened, [mixed])
        assert (result["outcome"], result["ignored_agents"]) == ("accepted", [])
        nodes = (await driver.get_session(opened))["graph"]["nodes"]
        assert [node["type"] for node in nodes] == ["pedestrian", "pedestrian"]


async def test_times_are_told_as_they_were_sent(driver: Driver) -> None:
    async with session(driver, walking(2)) as opened, refused(driver, "FRAME_OUT_OF_ORDER") as late:
        await driver.observe(opened, [frame(0.1, agent("0"))])
    assert "is 0.1, before the newest frame's 0.4;" in late.value.message


@pytest.mark.parametrize("names", [[f"t{k}" for k in range(101)], ["x" * 129], [""]])
async def test_a_type_map_has_bounds(driver: Driver, names: list[str]) -> None:
    type_map = dict.fromkeys(names, "pedestrian")
    async with refused(driver, "INVALID_ARGUMENT") as refusal:
        await driver.create_session(unknown_types="map", type_map=type_map)
    assert refusal.value.fields == ("type_map",)
    async with refused(driver, "INVALID_ARGUMENT") as refusal:
        await driver.predict(walking(2), unknown_types="map", type_map=type_map)
    assert refusal.value.fields == ("type_map",)


async def test_a_type_map_within_its_bounds_is_kept_whole(driver: Driver) -> None:
    type_map = dict.fromkeys([*(f"t{k}" for k in range(99)), "x" * 128], "pedestrian")
    async with session(driver, unknown_types="map", type_map=type_map) as opened:
        assert (await driver.get_session(opened))["type_map"] == type_map


async def test_an_agent_back_after_the_timeout_starts_anew(driver: Driver) -> None:
    async with session(driver, agent_timeout_s=2 * DT_S) as opened:
        await driver.observe(opened, walking(3, agents=1))
        for step in range(3, 7):
            await driver.observe(opened, [frame(step * DT_S, agent("other", 9.0))])
        [result] = await driver.observe(
            opened, [frame(7 * DT_S, agent("0", 3.5), agent("other", 9.0))]
        )
        assert (result["outcome"], result["gap_agents"]) == ("accepted_with_gaps", ["0"])
        nodes = {node["id"]: node for node in (await driver.get_session(opened))["graph"]["nodes"]}
        assert nodes["0"]["observations"] == 1
        assert nodes["other"]["observations"] == 5


async def test_a_missing_agent_is_carried_on_and_says_so(driver: Driver) -> None:
    async with session(driver, walking(4, agents=2), agent_timeout_s=10 * DT_S) as opened:
        await driver.observe(opened, [frame(4 * DT_S, agent("0", 2.0))])
        forecast = await driver.predict_session(opened, num_samples=2)
        last = {one["id"]: one["last_observed_time"] for one in forecast["agents"]}
        assert last == pytest.approx({"0": 4 * DT_S, "1": 3 * DT_S})


@pytest.mark.parametrize(
    ("name", "value"), [("num_samples", 0), ("num_samples", 5000), ("horizon", 0), ("horizon", 99)]
)
async def test_options_have_bounds(driver: Driver, name: str, value: int) -> None:
    async with session(driver, walking(2)) as opened:
        before = await picture(driver, opened)
        async with refused(driver, "INVALID_ARGUMENT") as refusal:
            await driver.predict_session(opened, **{name: value})
        assert refusal.value.fields[0].rpartition(".")[2] == name
        assert await picture(driver, opened) == before


async def test_an_unknown_agent_is_not_found(driver: Driver) -> None:
    async with session(driver, walking(2)) as opened:
        async with refused(driver, "UNKNOWN_AGENT") as refusal:
            await driver.predict_session(opened, agents=["nobody"])
        assert "nobody" in refusal.value.message


async def test_there_is_a_cap_on_sessions(driver: Driver) -> None:
    opened: list[str] = []
    try:
        async with refused(driver, "TOO_MANY_SESSIONS") as refusal:
            for _ in range(100):
                opened.append((await driver.create_session())["id"])  # noqa: PERF401  until refused
        assert refusal.value.retry_after_s is not None
        assert refusal.value.retry_after_s > 0
        assert len(opened) <= MAX_SESSIONS
    finally:
        for name in opened:
            await driver.delete_session(name)
    async with session(driver, walking(1)) as one:
        assert (await driver.get_session(one))["version"] == 1


async def test_a_session_reads_frames_faster_than_the_model_steps(driver: Driver) -> None:
    async with session(driver, frame_interval_s=0.1) as opened:
        frames = [frame(0.1 * k, agent("1", 0.125 * k)) for k in range(13)]
        results = await driver.observe(opened, frames)
        assert {one["outcome"] for one in results} == {"accepted"}
        forecast = await driver.predict_session(opened, mode="gmm")
        assert forecast["reference_time"] == pytest.approx(1.2)
        assert forecast["time_offsets_s"][0] == pytest.approx(DT_S)
        [one] = forecast["agents"]
        assert (one["x"], one["last_observed_time"]) == pytest.approx((1.5, 1.2))


async def test_a_client_is_told_what_became_of_its_session(driver: Driver) -> None:
    await driver.create_session("told-deleted")
    await driver.delete_session("told-deleted")
    await driver.create_session("told-idle", idle_timeout_s=0.05)
    await asyncio.sleep(0.1)
    for name, words in (("told-deleted", "was deleted at 2"), ("told-idle", "want of use at 2")):
        with pytest.raises(RefusalError) as caught:
            await driver.get_session(name)
        assert caught.value.kind == "UNKNOWN_SESSION"
        assert words in caught.value.message


async def test_a_crowd_in_one_spot_is_refused_and_changes_nothing(driver: Driver) -> None:
    async with session(driver, walking(3)) as name:
        before = await picture(driver, name)
        spot = frame(3 * DT_S, *(agent(f"a{k}", 0.0) for k in range(800)))
        async with refused(driver, "INVALID_ARGUMENT") as caught:
            await driver.observe(name, [spot])
        assert caught.value.fields == ("frames[0].agents",)
        assert "639200 edges" in caught.value.message
        assert await picture(driver, name) == before
