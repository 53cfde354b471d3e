"""What holds of stateless predictions over both transports."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from tests.contract.drivers import CODES, Driver, RefusalError
from tests.contract.scenes import DT_S, agent, frame, walking

from trajectron_model import kernels
from trajectron_model.config import MODE_PROBABILITY_FLOOR

pytestmark = pytest.mark.asyncio(loop_scope="session")


async def refusal_of(driver: Driver, frames: list[dict[str, Any]], **fields: Any) -> RefusalError:
    """How a prediction is refused; the service goes on answering."""
    with pytest.raises(RefusalError) as caught:
        await driver.predict(frames, **fields)
    assert caught.value.code == CODES[caught.value.kind][driver.name]
    assert (await driver.predict(walking(), num_samples=1))["agents"]
    return caught.value


async def test_a_forecast_says_everything_about_itself(driver: Driver) -> None:
    frames = walking(frames=4, agents=2)
    forecast = await driver.predict(
        frames, mode="full", num_samples=5, horizon=12, seed=7, include_modes=True
    )
    [model] = [model for model in await driver.list_models() if model["is_default"]]
    assert (forecast["model"], forecast["model_hash"]) == (model["name"], model["hash"])
    assert (forecast["mode"], forecast["seed"]) == ("full", 7)
    assert forecast["reference_time"] == frames[-1]["time"]
    assert forecast["time_offsets_s"] == pytest.approx([DT_S * k for k in range(1, 13)])
    assert forecast["sample_semantics"] == "independent_agents"
    for sent, shown in zip(frames[-1]["agents"], forecast["agents"], strict=True):
        assert (shown["id"], shown["type"]) == (sent["id"], "pedestrian")
        assert (shown["x"], shown["y"]) == (sent["x"], sent["y"])
        assert shown["last_observed_time"] == frames[-1]["time"]
        assert shown["observations"] == 4
        assert shown["heading_known"]
        modes = model["latent_values"]
        assert shown["mode_probabilities"].shape == (modes,)
        assert shown["mode_probabilities"].sum() == pytest.approx(1.0, abs=1e-5)
        assert shown["mean"].shape == (modes, 12, 2)
        assert shown["covariance"].shape == (modes, 12, 3)
        assert shown["samples"].shape == (5, 12, 2)
        assert len(shown["sample_modes"]) == 5
        assert all(0 <= mode < modes for mode in shown["sample_modes"])


async def test_positions_are_absolute_where_they_are_shown(driver: Driver) -> None:
    far = (6.9e5, 5.3e6)
    here = await driver.predict(walking(), num_samples=3, seed=1)
    there = await driver.predict(walking(origin=far), num_samples=3, seed=1)
    for near, moved in zip(here["agents"], there["agents"], strict=True):
        assert moved["samples"] - np.array(far) == pytest.approx(near["samples"], abs=1e-3)


async def test_gmm_has_modes_and_no_samples(driver: Driver) -> None:
    forecast = await driver.predict(walking(), mode="gmm", horizon=6)
    assert forecast["mode_probability_floor"] == MODE_PROBABILITY_FLOOR
    sampled = await driver.predict(walking(), num_samples=1, include_modes=True)
    assert sampled["mode_probability_floor"] == 0.0
    for shown in forecast["agents"]:
        assert shown["mean"].shape[1:] == (6, 2)
        assert shown["samples"] is None
        assert shown["sample_modes"] is None
        xx, xy, yy = np.moveaxis(shown["covariance"], -1, 0)
        assert (xx > 0).all()
        assert (xx * yy - xy**2 > 0).all()


async def test_z_best_samples_the_most_probable_mode_only(driver: Driver) -> None:
    forecast = await driver.predict(walking(), mode="z_best", num_samples=8)
    for shown in forecast["agents"]:
        assert set(shown["sample_modes"]) == {int(shown["mode_probabilities"].argmax())}


async def test_stratified_samples_are_as_many_of_each_mode_as_its_probability_says(
    driver: Driver,
) -> None:
    """To within one; 200 independent ones miss that for almost every agent."""
    forecast = await driver.predict(walking(), num_samples=200, seed=3, sampling="stratified")
    assert forecast["sample_semantics"] == "independent_agents_stratified"
    for shown in forecast["agents"]:
        drawn = np.bincount(shown["sample_modes"], minlength=len(shown["mode_probabilities"]))
        assert np.abs(drawn - 200 * shown["mode_probabilities"]).max() < 1.0 + 1e-3


async def test_independent_samples_are_what_comes_unasked(driver: Driver) -> None:
    unasked, asked, stratified = [
        await driver.predict(walking(), num_samples=20, seed=3, **options)
        for options in ({}, {"sampling": "iid"}, {"sampling": "stratified"})
    ]
    assert asked["sample_semantics"] == unasked["sample_semantics"] == "independent_agents"
    for one, same, other in zip(
        unasked["agents"], asked["agents"], stratified["agents"], strict=True
    ):
        assert (one["samples"] == same["samples"]).all()
        assert (one["samples"] != other["samples"]).any()


async def test_stratified_samples_keep_their_seed_in_any_company(driver: Driver) -> None:
    options: dict[str, Any] = {"num_samples": 20, "seed": 3, "sampling": "stratified"}
    everyone = await driver.predict(walking(), **options)
    last = everyone["agents"][-1]
    alone = await driver.predict(walking(), agents=[last["id"]], **options)
    assert alone["agents"][0]["samples"] == pytest.approx(last["samples"], abs=1e-4)


async def test_the_same_seed_gives_the_same_samples_and_another_gives_others(
    driver: Driver,
) -> None:
    one, again, other = [
        (await driver.predict(walking(), num_samples=4, seed=seed))["agents"][0]["samples"]
        for seed in (3, 3, 4)
    ]
    assert one == pytest.approx(again, abs=1e-4)
    assert np.abs(one - other).max() > 1e-3


async def test_a_seed_is_drawn_and_told_when_none_is_given(driver: Driver) -> None:
    drawn = await driver.predict(walking(), num_samples=4)
    again = await driver.predict(walking(), num_samples=4, seed=drawn["seed"])
    assert again["agents"][0]["samples"] == pytest.approx(drawn["agents"][0]["samples"], abs=1e-4)
    assert (await driver.predict(walking(), num_samples=4))["seed"] != drawn["seed"]


async def test_only_the_agents_asked_for_come_back_in_that_order(driver: Driver) -> None:
    everyone = await driver.predict(walking(agents=4), num_samples=2, seed=5)
    some = await driver.predict(walking(agents=4), num_samples=2, seed=5, agents=["3", "0"])
    assert [shown["id"] for shown in some["agents"]] == ["3", "0"]
    for shown in some["agents"]:
        whole = everyone["agents"][int(shown["id"])]
        assert shown["samples"] == pytest.approx(whole["samples"], abs=1e-4)


async def test_an_agent_seen_once_has_a_forecast_without_a_heading(driver: Driver) -> None:
    forecast = await driver.predict([frame(0.0, agent())], num_samples=2)
    [only] = forecast["agents"]
    assert only["observations"] == 1
    assert not only["heading_known"]
    assert np.isfinite(only["samples"]).all()


async def test_a_scene_without_agents_has_a_forecast_without_agents(driver: Driver) -> None:
    forecast = await driver.predict([frame(0.0), frame(DT_S)])
    assert forecast["agents"] == []
    assert forecast["reference_time"] == DT_S


async def test_unix_times_and_negative_times_are_times(driver: Driver) -> None:
    for start in (1.7e9, -3.0):
        frames = [{**one, "time": start + one["time"]} for one in walking()]
        assert (await driver.predict(frames))["reference_time"] == frames[-1]["time"]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", ["x", "y"])
async def test_positions_must_be_finite(driver: Driver, axis: str, value: float) -> None:
    frames = walking()
    frames[2]["agents"][1][axis] = value
    refusal = await refusal_of(driver, frames)
    assert refusal.fields == (f"frames[2].agents[1].{axis}",)
    assert f"frames[2].agents[1].{axis}" in refusal.message


@pytest.mark.parametrize("value", [math.nan, math.inf])
async def test_times_must_be_finite(driver: Driver, value: float) -> None:
    frames = walking()
    frames[1]["time"] = value
    assert (await refusal_of(driver, frames)).fields == ("frames[1].time",)


@pytest.mark.parametrize("missing", ["id", "type", "x", "y"])
async def test_every_field_of_an_agent_is_required(driver: Driver, missing: str) -> None:
    frames = walking()
    del frames[0]["agents"][2][missing]
    assert (await refusal_of(driver, frames)).fields == (f"frames[0].agents[2].{missing}",)


async def test_the_time_of_a_frame_is_required(driver: Driver) -> None:
    frames = walking()
    del frames[3]["time"]
    assert (await refusal_of(driver, frames)).fields == ("frames[3].time",)


async def test_at_least_one_frame_is_required(driver: Driver) -> None:
    assert (await refusal_of(driver, [])).fields == ("frames",)


async def test_ids_are_unique_in_a_frame(driver: Driver) -> None:
    frames = walking()
    frames[1]["agents"][2]["id"] = "0"
    assert (await refusal_of(driver, frames)).fields == ("frames[1].agents[2].id",)


@pytest.mark.parametrize("bad", ["", "x" * 129])
async def test_ids_have_1_to_128_characters(driver: Driver, bad: str) -> None:
    frames = walking()
    frames[0]["agents"][0]["id"] = bad
    assert (await refusal_of(driver, frames)).fields == ("frames[0].agents[0].id",)


async def test_an_id_as_long_as_a_book_is_refused_in_a_few_words(driver: Driver) -> None:
    frames = walking()
    frames[0]["agents"][0]["id"] = "x" * 100_000
    refusal = await refusal_of(driver, frames)
    assert len(refusal.message) < 1000


async def test_ids_of_any_script_come_back_as_sent(driver: Driver) -> None:
    names = ["Zoë", "歩行者", "🚶", "a b/c"]
    forecast = await driver.predict(
        [frame(0.0, *(agent(name, float(k)) for k, name in enumerate(names)))], num_samples=1
    )
    assert [one["id"] for one in forecast["agents"]] == names


async def test_an_unknown_type_is_refused_unless_told_otherwise(driver: Driver) -> None:
    frames = [frame(0.0, agent("1"), agent("2", 3.0, kind="unicycle"))]
    assert (await refusal_of(driver, frames)).fields == ("frames[0].agents[1].type",)
    assert (await refusal_of(driver, frames, unknown_types="reject")).fields


async def test_an_unknown_type_can_be_ignored(driver: Driver) -> None:
    frames = [frame(0.0, agent("1"), agent("2", 3.0, kind="unicycle"))]
    forecast = await driver.predict(frames, unknown_types="ignore")
    assert [one["id"] for one in forecast["agents"]] == ["1"]


async def test_an_unknown_type_can_be_mapped(driver: Driver) -> None:
    frames = [frame(0.0, agent("1"), agent("2", 3.0, kind="unicycle"))]
    forecast = await driver.predict(
        frames, unknown_types="map", type_map={"unicycle": "pedestrian"}
    )
    assert [one["type"] for one in forecast["agents"]] == ["pedestrian", "pedestrian"]
    refusal = await refusal_of(driver, frames, unknown_types="map", type_map={"x": "pedestrian"})
    assert refusal.fields == ("frames[0].agents[1].type",)


async def test_time_does_not_go_backwards_within_a_history(driver: Driver) -> None:
    frames = walking()
    frames[2]["time"] = -1.0
    refusal = await refusal_of(driver, frames)
    assert refusal.kind == "FRAME_OUT_OF_ORDER"
    assert refusal.fields == ("frames[2].time",)


@pytest.mark.parametrize(
    ("name", "value"),
    [("num_samples", 0), ("num_samples", 2001), ("horizon", 0), ("horizon", 61),
     ("num_samples", 2**32 - 1), ("horizon", 2**32 - 1), ("seed", 2**63)],
)  # fmt: skip
async def test_options_have_bounds(driver: Driver, name: str, value: int) -> None:
    refusal = await refusal_of(driver, walking(), **{name: value})
    assert refusal.fields[0].rpartition(".")[2] == name


@pytest.mark.parametrize(("num_samples", "horizon"), [(2000, 6), (10, 60)])
async def test_the_largest_options_are_served(
    driver: Driver, num_samples: int, horizon: int
) -> None:
    forecast = await driver.predict(
        walking(agents=1), num_samples=num_samples, horizon=horizon, seed=2**63 - 1
    )
    assert forecast["agents"][0]["samples"].shape == (num_samples, horizon, 2)
    assert forecast["seed"] == 2**63 - 1


async def test_a_frame_of_10000_agents_is_refused_and_says_what_fits(driver: Driver) -> None:
    crowd = [agent(str(k), float(k % 100), float(k // 100)) for k in range(10_000)]
    refusal = await refusal_of(driver, [frame(0.0, *crowd)])
    assert refusal.fields == ("frames[0].agents",)
    assert "2000" in refusal.message


async def test_a_forecast_too_large_to_hold_is_refused(driver: Driver) -> None:
    crowd = [agent(str(k), float(k % 40), float(k // 40)) for k in range(1000)]
    refusal = await refusal_of(driver, [frame(0.0, *crowd)], num_samples=2000, horizon=60)
    assert refusal.kind == "TOO_LARGE"


async def test_an_unknown_model_is_not_found(driver: Driver) -> None:
    refusal = await refusal_of(driver, walking(), model="no-such-model")
    assert refusal.kind == "UNKNOWN_MODEL"
    assert "no-such-model" in refusal.message


async def test_an_unknown_agent_is_not_found(driver: Driver) -> None:
    refusal = await refusal_of(driver, walking(), agents=["0", "nobody"])
    assert refusal.kind == "UNKNOWN_AGENT"
    assert "nobody" in refusal.message


async def test_models_can_be_asked_for_by_name(driver: Driver) -> None:
    for model in await driver.list_models():
        forecast = await driver.predict(walking(), model=model["name"], num_samples=1)
        assert forecast["model"] == model["name"]


async def test_models_say_what_computes_them(driver: Driver) -> None:
    assert {model["kernels"] for model in await driver.list_models()} == {kernels.in_use()}
