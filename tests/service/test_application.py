"""The use cases over a real network: one path, clear refusals, nothing lost, nothing shared."""

from __future__ import annotations

import asyncio
import dataclasses
import math
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from tests.service.building import (
    DT_S,
    QUICK,
    Clock,
    Loaded,
    application,
    config,
    frame,
    observe_all,
    predict,
    same_forecast,
    turns,
    walk,
)

from trajectron_model.trajectron import Trajectron
from trajectron_service.application import Application
from trajectron_service.engine import Engine
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.messages import (
    Agent,
    ForecastMode,
    ForecastOptions,
    Frame,
    Outcome,
    UnknownTypes,
)
from trajectron_service.scenes import SceneJob, SceneResult
from trajectron_service.stores.memory import MemoryStore


def fields(refusal: pytest.ExceptionInfo[ServiceError]) -> list[str]:
    return [violation.field for violation in refusal.value.violations]


def kind(refusal: pytest.ExceptionInfo[ServiceError]) -> ErrorKind:
    return refusal.value.kind


@pytest.mark.parametrize("mode", list(ForecastMode))
@pytest.mark.parametrize("interval_s", [None, 0.1, 0.15])
async def test_a_stateless_forecast_is_the_sessions(
    app: Application, mode: ForecastMode, interval_s: float | None
) -> None:
    frames = walk(range(9), dt_s=interval_s or DT_S)
    options = dataclasses.replace(QUICK, mode=mode)
    stateless = await predict(app, frames, options, frame_interval_s=interval_s)
    await app.create_session("s", config(frame_interval_s=interval_s))
    await observe_all(app, "s", frames)
    session = await app.predict_session("s", options, None)
    assert same_forecast(stateless, session, 1e-5)
    assert session.reference_time == frames[-1].time


async def test_a_seed_is_repeatable_and_drawn_and_told_when_there_is_none(app: Application) -> None:
    frames = walk(range(4))
    first, again = await predict(app, frames), await predict(app, frames)
    assert same_forecast(first, again)
    other = await predict(app, frames, dataclasses.replace(QUICK, seed=8))
    assert not same_forecast(first, other)
    drawn = await predict(app, frames, dataclasses.replace(QUICK, seed=None))
    assert drawn.seed == 11
    repeated = await predict(app, frames, dataclasses.replace(QUICK, seed=11))
    assert same_forecast(drawn, repeated)


async def test_many_requests_at_once_answer_as_each_alone(app: Application) -> None:
    scenes = [walk(range(k, k + 3 + k % 3), ("a", "b", "c")[: 1 + k % 3]) for k in range(8)]
    alone = [await predict(app, one) for one in scenes]
    together = await asyncio.gather(*(predict(app, one) for one in scenes))
    for a, b in zip(alone, together, strict=True):
        assert same_forecast(a, b, 1e-4)


async def test_a_forecast_says_what_it_is(app: Application) -> None:
    forecast = await predict(app, walk(range(5)), ForecastOptions(seed=1, num_samples=2))
    assert (forecast.model, forecast.model_hash) == ("small", "0" * 64)
    assert forecast.time_offsets_s == pytest.approx([DT_S * (h + 1) for h in range(12)])
    ann = forecast.agents[0]
    assert ann.samples is not None
    assert ann.sample_modes is not None
    assert (ann.samples.shape, ann.sample_modes.shape) == ((2, 12, 2), (2,))
    assert ann.mode_probabilities.sum() == pytest.approx(1.0, abs=1e-5)
    assert (ann.mean, ann.covariance) == (None, None)


async def test_modes_come_with_gmm_or_when_asked_for(app: Application) -> None:
    frames = walk(range(3))
    gmm = await predict(app, frames, dataclasses.replace(QUICK, mode=ForecastMode.GMM))
    both = await predict(app, frames, dataclasses.replace(QUICK, include_modes=True))
    for agent in (*gmm.agents, *both.agents):
        assert agent.mean is not None
        assert agent.mean.shape == (25, 4, 2)
    assert all(agent.samples is None for agent in gmm.agents)


async def test_agents_can_be_chosen_and_their_order_is_kept(app: Application) -> None:
    options = dataclasses.replace(QUICK, agents=("cat", "ann"))
    everyone = await predict(app, walk(range(4)))
    some = await predict(app, walk(range(4)), options)
    assert [a.id for a in some.agents] == ["cat", "ann"]
    chosen = {a.id: a for a in everyone.agents}
    for agent in some.agents:
        whole = chosen[agent.id].samples
        assert agent.samples is not None and whole is not None
        # Equal but for rounding, which may follow the number of rows in a product.
        np.testing.assert_allclose(agent.samples, whole, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"num_samples": 0}, "num_samples"),
        ({"num_samples": 2001}, "num_samples"),
        ({"horizon": 0}, "horizon"),
        ({"horizon": 61}, "horizon"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**63}, "seed"),
        ({"agents": ("ann", "bob", "ann")}, "agents[2]"),
    ],
)
async def test_options_out_of_bounds_name_their_field(
    app: Application, changes: dict[str, Any], field: str
) -> None:
    options = dataclasses.replace(QUICK, **changes)
    await app.create_session("s", config())
    await observe_all(app, "s", walk(range(2)))
    for call in (predict(app, walk(range(2)), options), app.predict_session("s", options, None)):
        with pytest.raises(ServiceError) as refusal:
            await call
        assert kind(refusal) is ErrorKind.INVALID_ARGUMENT
        assert fields(refusal) == [field]


async def test_an_agent_that_is_not_there_is_named(app: Application) -> None:
    options = dataclasses.replace(QUICK, agents=("ann", "zoe"))
    with pytest.raises(ServiceError) as refusal:
        await predict(app, walk(range(2)), options)
    assert (kind(refusal), fields(refusal)) == (ErrorKind.UNKNOWN_AGENT, ["agents[1]"])


async def test_too_much_at_once_is_too_large(network: Trajectron) -> None:
    app = application(network, max_forecast_points=3 * 20 * 12)
    await predict(app, walk(range(2)), ForecastOptions(num_samples=20))
    for options in (ForecastOptions(num_samples=21), ForecastOptions(mode=ForecastMode.GMM)):
        with pytest.raises(ServiceError) as refusal:
            await predict(app, walk(range(2)), options)
        assert kind(refusal) is ErrorKind.TOO_LARGE
        assert "may ask for 720" in refusal.value.message
    await app.close()


@pytest.mark.parametrize(
    ("bad", "field", "expected"),
    [
        (Frame(0.4, (Agent("a", "pedestrian", 0.0, 0.0), Agent("b", "pedestrian", math.nan, 0.0))),
         "frames[1].agents[1].x", ErrorKind.INVALID_ARGUMENT),
        (Frame(0.4, (Agent("a", "bird", 0.0, 0.0),)),
         "frames[1].agents[0].type", ErrorKind.INVALID_ARGUMENT),
        (Frame(0.0, ()), "frames[1].time", ErrorKind.FRAME_CONFLICT),
        (Frame(-0.4, ()), "frames[1].time", ErrorKind.FRAME_OUT_OF_ORDER),
        (Frame(None, ()), "frames[1].time", ErrorKind.INVALID_ARGUMENT),
    ],
)  # fmt: skip
async def test_a_refused_frame_of_a_stateless_request_is_named(
    app: Application, bad: Frame, field: str, expected: ErrorKind
) -> None:
    first = frame(0.0, ann=(0.0, 0.0))
    with pytest.raises(ServiceError) as refusal:
        await predict(app, [first, bad, frame(0.8, ann=(1.0, 0.0))])
    assert (kind(refusal), fields(refusal)) == (expected, [field])
    assert refusal.value.message.startswith(f"{field} ")


async def test_frames_are_required_and_limited(network: Trajectron) -> None:
    app = application(network, max_frames_per_request=3)
    for frames in ([], walk(range(4))):
        with pytest.raises(ServiceError) as refusal:
            await predict(app, frames)
        assert (kind(refusal), fields(refusal)) == (ErrorKind.INVALID_ARGUMENT, ["frames"])
    await app.close()


async def test_one_refused_frame_among_several_leaves_the_others(app: Application) -> None:
    await app.create_session("s", config())
    good = walk(range(4))
    bad = frame(0.6, ann=(math.inf, 0.0))
    results = await app.observe("s", (good[0], good[1], bad, good[1], good[0], good[2]), None)
    assert [one.outcome for one in results] == [
        Outcome.ACCEPTED,
        Outcome.ACCEPTED,
        Outcome.INVALID,
        Outcome.DUPLICATE,
        Outcome.OUT_OF_ORDER,
        Outcome.ACCEPTED,
    ]
    assert [one.version for one in results] == [1, 2, 2, 2, 2, 3]
    assert (results[2].field, results[4].field) == ("agents[0].x", "time")
    forecast = await app.predict_session("s", QUICK, None)
    assert same_forecast(forecast, await predict(app, good[:3]), 1e-5)


@pytest.mark.parametrize(
    ("bad", "expected", "field"),
    [
        (frame(0.4, ann=(9.0, 9.0)), ErrorKind.FRAME_CONFLICT, "frames[0].time"),
        (frame(0.2), ErrorKind.FRAME_OUT_OF_ORDER, "frames[0].time"),
        (frame(0.8, ann=(math.nan, 0.0)), ErrorKind.INVALID_ARGUMENT, "frames[0].agents[0].x"),
        (frame(0.8, ann=(900.0, 0.0)), ErrorKind.INVALID_ARGUMENT, "frames[0].agents[0]"),
    ],
)
async def test_a_single_refused_frame_raises_and_the_state_is_untouched(
    app: Application, bad: Frame, expected: ErrorKind, field: str
) -> None:
    await app.create_session("s", config())
    await observe_all(app, "s", walk(range(2)))
    before = await app.predict_session("s", QUICK, None), await app.get_session("s")
    with pytest.raises(ServiceError) as refusal:
        await app.observe("s", (bad,), None)
    assert (kind(refusal), fields(refusal)) == (expected, [field])
    after = await app.predict_session("s", QUICK, None), await app.get_session("s")
    assert same_forecast(before[0], after[0])
    assert before[1] == after[1]


async def test_a_repeated_frame_changes_nothing(app: Application) -> None:
    await app.create_session("s", config())
    await observe_all(app, "s", walk(range(2)))
    (result,) = await app.observe("s", (walk([1])[0],), None)
    assert (result.outcome, result.version) == (Outcome.DUPLICATE, 2)


async def test_empty_frames_are_observed_and_forecast(app: Application) -> None:
    assert (await predict(app, [Frame(0.0, ()), Frame(0.4, ())])).agents == ()
    await app.create_session("s", config())
    await app.observe("s", (Frame(0.0, ()),), None)
    assert (await app.predict_session("s", QUICK, None)).agents == ()


async def test_nothing_can_be_forecast_before_the_first_frame(app: Application) -> None:
    await app.create_session("s", config())
    with pytest.raises(ServiceError) as refusal:
        await app.predict_session("s", QUICK, None)
    assert kind(refusal) is ErrorKind.NO_FRAMES


async def test_a_missing_agent_is_forecast_until_its_timeout(app: Application) -> None:
    await app.create_session("s", config(agent_timeout_s=1.0))
    await observe_all(app, "s", walk(range(3)))
    await observe_all(app, "s", walk([3, 4], ("ann",)))
    forecast = await app.predict_session("s", QUICK, None)
    seen = {agent.id: agent.last_observed_time for agent in forecast.agents}
    assert seen == {"ann": pytest.approx(1.6), "bob": pytest.approx(0.8), "cat": pytest.approx(0.8)}
    await observe_all(app, "s", walk([5], ("ann",)))
    forecast = await app.predict_session("s", QUICK, None)
    assert [agent.id for agent in forecast.agents] == ["ann"]
    (back,) = await app.observe("s", tuple(walk([6], ("ann", "bob"))), None)
    assert (back.outcome, back.gap_agents) == (Outcome.ACCEPTED_WITH_GAPS, ("bob",))


async def test_agents_of_unknown_types_are_told_when_ignored(app: Application) -> None:
    await app.create_session("s", config(unknown_types=UnknownTypes.IGNORE))
    mixed = Frame(0.0, (Agent("a", "pedestrian", 0.0, 0.0), Agent("b", "tram", 1.0, 1.0)))
    (result,) = await app.observe("s", (mixed,), None)
    assert (result.outcome, result.ignored_agents) == (Outcome.ACCEPTED, ("b",))
    mapped = await predict(
        app, [mixed], unknown_types=UnknownTypes.MAP, type_map={"tram": "pedestrian"}
    )
    assert [agent.type for agent in mapped.agents] == ["pedestrian", "pedestrian"]


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"frame_interval_s": 0.0}, "frame_interval_s"),
        ({"frame_interval_s": math.nan}, "frame_interval_s"),
        ({"agent_timeout_s": -1.0}, "agent_timeout_s"),
        ({"agent_timeout_s": 0.3}, "agent_timeout_s"),
        ({"agent_timeout_s": 1e9}, "agent_timeout_s"),
        ({"idle_timeout_s": math.inf}, "idle_timeout_s"),
        ({"type_map": {"car": "boat"}}, 'type_map["car"]'),
    ],
)
async def test_a_bad_configuration_names_its_field(
    app: Application, changes: dict[str, Any], field: str
) -> None:
    with pytest.raises(ServiceError) as refusal:
        await app.create_session("s", config(**changes))
    assert (kind(refusal), fields(refusal)) == (ErrorKind.INVALID_ARGUMENT, [field])


@pytest.mark.parametrize("name", ["a b", "ä", "x" * 129, "a/b", "a\n"])
async def test_session_ids_are_plain(app: Application, name: str) -> None:
    with pytest.raises(ServiceError) as refusal:
        await app.create_session(name, config())
    assert (kind(refusal), fields(refusal)) == (ErrorKind.INVALID_ARGUMENT, ["session_id"])


async def test_an_unknown_model_is_told_which_there_are(app: Application) -> None:
    for call in (
        predict(app, walk(range(2)), model="large"),
        app.create_session("s", config(model="large")),
    ):
        with pytest.raises(ServiceError) as refusal:
            await call
        assert kind(refusal) is ErrorKind.UNKNOWN_MODEL
        assert '"small"' in refusal.value.message


async def test_a_session_tells_how_it_was_resolved(app: Application) -> None:
    info = await app.create_session(None, config(frame_interval_s=5.0))
    assert len(info.id) == 24
    assert info.config.model == "small"
    assert info.config.agent_timeout_s == 10.0  # two intervals: one late frame drops nobody
    assert info.config.idle_timeout_s == 600.0
    assert info.expires_at == info.created_at + 600.0


async def test_get_shows_the_graph_at_the_newest_frame(app: Application) -> None:
    await app.create_session("s", config())
    assert (await app.get_session("s"))[1].nodes == ()
    await observe_all(app, "s", walk(range(3)))
    info, graph = await app.get_session("s")
    assert (info.version, info.agent_count) == (3, 3)
    assert [(n.id, n.observations) for n in graph.nodes] == [("ann", 3), ("bob", 3), ("cat", 3)]
    assert {(e.receiver_id, e.sender_id, e.age_steps, e.modulation) for e in graph.edges} >= {
        ("ann", "bob", 3, 0.75),
        ("bob", "ann", 3, 0.75),
    }


async def test_sessions_are_listed_page_by_page(app: Application) -> None:
    for name in ("c", "a", "b"):
        await app.create_session(name, config())
    first, token = await app.list_sessions(2, "")
    rest, end = await app.list_sessions(2, token)
    assert ([s.id for s in first], [s.id for s in rest], end) == (["a", "b"], ["c"], "")
    for size, text, field in (
        (0, "", "page_size"),
        (1001, "", "page_size"),
        (5, "§", "page_token"),
    ):
        with pytest.raises(ServiceError) as refusal:
            await app.list_sessions(size, text)
        assert fields(refusal) == [field]


async def test_millions_of_metres_from_the_origin_a_forecast_is_the_same(app: Application) -> None:
    near = walk(range(6))
    far = [
        Frame(
            one.time,
            tuple(
                dataclasses.replace(a, x=a.x + 4e6, y=a.y - 5e6)
                for a in one.agents
                if a.x is not None and a.y is not None
            ),
        )
        for one in near
    ]
    here, there = await predict(app, near), await predict(app, far)
    for a, b in zip(here.agents, there.agents, strict=True):
        assert a.samples == pytest.approx(b.samples, abs=1e-3)
        assert (b.x, b.y) == (a.x + 4e6, a.y - 5e6)


async def test_a_parked_session_forecasts_as_before_bit_for_bit(network: Trajectron) -> None:
    clock = Clock()
    app = application(network, clock=clock)
    await app.create_session("s", config(frame_interval_s=0.1))
    await observe_all(app, "s", walk(range(7), dt_s=0.1))
    before, graph = await app.predict_session("s", QUICK, None), await app.get_session("s")
    clock.now += 60.0
    assert await app._sessions.park() == 1
    after = await app.predict_session("s", QUICK, None)
    assert same_forecast(before, after)
    assert (await app.get_session("s"))[1] == graph[1]
    await app.close()


async def test_with_a_durable_store_another_process_goes_on_as_if_nothing_had_happened(
    network: Trajectron,
) -> None:
    store, clock, frames = MemoryStore(durable=True), Clock(), walk(range(8))
    first = application(network, store=store, clock=clock)
    await first.create_session("s", config())
    await observe_all(first, "s", frames[:5])
    # Killed here: nothing but the store is left.
    second = application(network, store=store, clock=clock)
    await observe_all(second, "s", frames[5:])
    forecast = await second.predict_session("s", QUICK, None)
    assert same_forecast(forecast, await predict(first, frames), 1e-5)
    # Had the first lived on, it would have lost the race and read what the second wrote.
    (result,) = await first.observe("s", tuple(walk([8])), None)
    assert result.version == 9
    await first.close()
    await second.close()


async def test_a_session_does_not_go_on_with_other_weights(network: Trajectron) -> None:
    store, clock = MemoryStore(durable=True), Clock()
    first = application(network, store=store, clock=clock)
    await first.create_session("s", config())
    await observe_all(first, "s", walk(range(2)))
    other = Engine([Loaded(network, sha256="1" * 64)])
    second = application(network, store=store, clock=clock, engine=other)
    for call in (
        second.observe("s", tuple(walk([2])), None),
        second.predict_session("s", QUICK, None),
        second.get_session("s"),
    ):
        with pytest.raises(ServiceError) as refusal:
            await call
        assert kind(refusal) is ErrorKind.UNKNOWN_MODEL
    await first.close()
    await second.close()


async def test_a_long_history_leaves_others_their_turn(network: Trajectron) -> None:
    app = application(network, max_frames_per_request=5000)
    crowd = [f"a{k}" for k in range(200)]
    long = asyncio.create_task(predict(app, walk(range(100), crowd)))
    others = 0
    while not app._batcher.waiting and not long.done():
        others += 1
        await asyncio.sleep(0)
    # 20,000 agents are checked, at most some 2,000 in one turn of the loop.
    assert others >= 9
    long.cancel()
    await app.close()


class Faulty(Engine):
    """An engine that fails, or waits, as told."""

    def __init__(self, network: Trajectron) -> None:
        super().__init__([Loaded(network)])
        self.fail_above: int | None = None
        self.go = threading.Event()
        self.go.set()
        self.entered = threading.Event()

    def run(self, jobs: Sequence[SceneJob]) -> list[SceneResult]:
        self.entered.set()
        assert self.go.wait(5.0)
        if self.fail_above is not None:
            for job in jobs:
                if sum(len(step.frame.ids) for step in job.steps) > self.fail_above:
                    raise RuntimeError("out of memory")
        return super().run(jobs)


async def test_a_fault_of_the_engine_leaves_the_session_as_it_was(network: Trajectron) -> None:
    engine = Faulty(network)
    app = application(network, engine=engine)
    await app.create_session("s", config())
    await observe_all(app, "s", walk(range(2)))
    before = await app.predict_session("s", QUICK, None)
    engine.fail_above = 0
    with pytest.raises(ServiceError) as refusal:
        await app.observe("s", tuple(walk([2])), None)
    assert kind(refusal) is ErrorKind.INTERNAL
    assert "memory" not in refusal.value.message
    assert same_forecast(before, await app.predict_session("s", QUICK, None))
    engine.fail_above = None
    (result,) = await app.observe("s", tuple(walk([2])), None)
    assert (result.outcome, result.version) == (Outcome.ACCEPTED, 3)
    await app.close()


async def test_one_request_that_breaks_the_engine_does_not_break_its_neighbours(
    network: Trajectron,
) -> None:
    engine = Faulty(network)
    app = application(network, engine=engine)
    engine.fail_above = 3
    few, many = walk([0]), walk([0], ("a", "b", "c", "d"))
    results = await asyncio.gather(
        predict(app, few), predict(app, many), predict(app, few), return_exceptions=True
    )
    assert [isinstance(one, ServiceError) for one in results] == [False, True, False]
    await app.close()


async def test_overload_is_refused_at_once_and_deadlines_are_kept(network: Trajectron) -> None:
    engine = Faulty(network)
    app = application(network, engine=engine, queue_size=1)
    engine.go.clear()
    engine.entered.clear()
    running = asyncio.create_task(predict(app, walk(range(2))))
    await asyncio.to_thread(engine.entered.wait, 5.0)
    waiting = asyncio.create_task(predict(app, walk(range(2)), deadline=time.monotonic() + 0.02))
    await turns()
    with pytest.raises(ServiceError) as refusal:
        await predict(app, walk(range(2)))
    assert kind(refusal) is ErrorKind.OVERLOADED
    assert refusal.value.retry_after_s
    with pytest.raises(ServiceError) as late:
        await waiting
    assert kind(late) is ErrorKind.DEADLINE_EXCEEDED
    engine.go.set()
    assert (await running).agents
    await app.close()


async def test_a_deadline_counts_for_waiting_in_line_too(network: Trajectron) -> None:
    engine = Faulty(network)
    app = application(network, engine=engine)
    await app.create_session("s", config())
    engine.go.clear()
    engine.entered.clear()
    first = asyncio.create_task(app.observe("s", tuple(walk([0])), None))
    await asyncio.to_thread(engine.entered.wait, 5.0)
    with pytest.raises(ServiceError) as late:
        await app.observe("s", tuple(walk([1])), time.monotonic() + 0.02)
    assert kind(late) is ErrorKind.DEADLINE_EXCEEDED
    engine.go.set()
    assert (await first)[0].version == 1
    assert (await app.observe("s", tuple(walk([1])), None))[0].version == 2
    await app.close()


async def test_draining_refuses_new_work_and_finishes_what_is_in_hand(network: Trajectron) -> None:
    engine = Faulty(network)
    app = application(network, engine=engine)
    await app.start()
    readiness = [app.ready]
    engine.go.clear()
    engine.entered.clear()
    in_hand = asyncio.create_task(predict(app, walk(range(2))))
    await asyncio.to_thread(engine.entered.wait, 5.0)
    app.begin_drain()
    readiness.append(app.ready)
    assert readiness == [True, False]
    with pytest.raises(ServiceError) as refusal:
        await predict(app, walk(range(2)))
    assert kind(refusal) is ErrorKind.DRAINING
    drained = asyncio.create_task(app.drained())
    await turns()
    assert not drained.done()
    engine.go.set()
    await drained
    assert (await in_hand).agents
    await app.close()
    await asyncio.wait_for(app.drained(), 1.0)


async def test_the_housekeeping_ends_with_the_application(network: Trajectron) -> None:
    app = application(network)
    await app.start()
    keeper = app._housekeeper
    assert keeper is not None
    await app.close()
    assert keeper.done()


async def test_what_is_measured(app: Application) -> None:
    await app.create_session("secret-name", config())
    await observe_all(app, "secret-name", walk(range(3)))
    await predict(app, walk(range(2)))
    with pytest.raises(ServiceError):
        await app.observe("secret-name", (walk([0])[0],), None)
    value = app._metrics.registry.get_sample_value
    assert value("trajectron_frames_total", {"outcome": "accepted"}) == 5.0
    assert value("trajectron_refusals_total", {"kind": "FRAME_OUT_OF_ORDER"}) == 1.0
    assert (value("trajectron_sessions"), value("trajectron_agents")) == (1.0, 3.0)
    assert (value("trajectron_edges") or 0.0) > 0.0
    assert value("trajectron_batch_jobs_sum") == 4.0
    assert value("trajectron_stage_duration_seconds_count", {"stage": "queue"}) == 4.0
    labels = {"model": "small", "hash": "0" * 64, "default": "true"}
    assert value("trajectron_model_info", labels) == 1.0
    assert b"secret-name" not in app._metrics.render()
