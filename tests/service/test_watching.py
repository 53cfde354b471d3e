"""Live accuracy: the service's scores of its own forecasts are those of the offline protocol."""

from __future__ import annotations

from itertools import islice
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.service.building import (
    DT_S,
    Clock,
    Loaded,
    application,
    config,
    observation,
    predict,
    walk,
)

from benchmarks import watching as benchmark
from trajectron_model import registry
from trajectron_model.data.eth_ucy import EthUcy
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window
from trajectron_model.evaluation import judging, live, protocols
from trajectron_model.evaluation.metrics import mean_over_known
from trajectron_model.predictor import PositionMixture, TrajectronPredictor
from trajectron_model.simulation import Scenario, simulate
from trajectron_model.trajectron import Trajectron
from trajectron_service.application import Application
from trajectron_service.engine import Engine
from trajectron_service.forecaster import FrameRequest
from trajectron_service.messages import (
    Agent,
    ForecastMode,
    ForecastOptions,
    Frame,
    SessionConfig,
)
from trajectron_service.stores import SessionKey
from trajectron_service.watching.accuracy import LiveAccuracy
from trajectron_service.watching.budget import Budget
from trajectron_service.watching.pending import Pending, places_of

HORIZON = 12
SEED = 3
ASK = ForecastOptions(num_samples=1, horizon=HORIZON, seed=1)
# Lets every forecast in.
ALL: dict[str, Any] = {"live_accuracy_budget": 1000.0}


def watching(app: Application) -> LiveAccuracy:
    assert app._accuracy is not None
    return app._accuracy


def value(app: Application, name: str, **labels: object) -> float:
    """A sample of the registry, 0 where there is none yet."""
    found = app._metrics.registry.get_sample_value(
        f"trajectron_accuracy_{name}", {key: str(label) for key, label in labels.items()}
    )
    return found or 0.0


def outcomes(app: Application) -> dict[str, int]:
    """Agents by what became of their forecasts, those that are not none."""
    names = ("scored", "unseen", "skipped", "evicted", "failed")
    counts = {name: int(value(app, "agents_total", outcome=name)) for name in names}
    return {name: count for name, count in counts.items() if count}


def crowd(steps: int, agents: int, seed: int = 0) -> Recording:
    """A simulated crowd as a recording; who leaves and who comes is among it."""
    frames = list(islice(simulate(Scenario.CROSSING, agents, seed=seed), steps))
    ids = sorted({agent for one in frames for agent in one.ids}, key=int)
    rows = [
        (t, ids.index(a), p)
        for t, f in enumerate(frames)
        for a, p in zip(f.ids, f.positions, strict=True)
    ]
    return Recording.from_rows(
        name="crowd",
        dt_s=DT_S,
        start_time_s=0.0,
        ids=ids,
        types=["pedestrian"] * len(ids),
        step=np.array([row[0] for row in rows]),
        agent=np.array([row[1] for row in rows]),
        position=np.array([row[2] for row in rows]),
    )


def frame_of(recording: Recording, step: int) -> Frame:
    scene = recording.frame(step)
    places = scene.positions.tolist()
    agents = zip(scene.ids, scene.types, places, strict=True)
    return Frame(scene.time_s, tuple(Agent(i, t, x, y) for i, t, (x, y) in agents))


async def replay(app: Application, recording: Recording, options: ForecastOptions) -> None:
    """Streams a recording through a session, a forecast after every frame."""
    await app.create_session("replay", SessionConfig())
    for step in range(recording.num_steps):
        await app.observe("replay", (frame_of(recording, step),), None)
        await app.predict_session("replay", options, None)
    await app.delete_session("replay")
    await watching(app).settled()


def same_draws(app: Application, recording: Recording) -> None:
    """Ranks the truth among the very draws that the offline protocol takes."""

    def random(pending: Pending) -> np.random.Generator:
        now = round((pending.reference_time_s - recording.start_time_s) / DT_S)
        window = Window(recording, 0, now + 1, HORIZON, np.empty(0, dtype=np.int64))
        return judging._generator(window, SEED)

    watching(app)._random = random


def columns_of(network: Trajectron, recording: Recording) -> dict[str, NDArray[np.float64]]:
    """What the offline ``streaming`` protocol says of the same model on the same recording."""
    windows = protocols.streaming(recording)
    scores = judging.judge(
        TrajectronPredictor(network, "offline"), windows, judging.Judgement(1, 0, SEED)
    )
    return dict(scores.columns)


def assert_same_as_offline(
    app: Application,
    model: str,
    columns: dict[str, NDArray[np.float64]],
) -> None:
    kind: dict[str, object] = {"model": model, "type": "pedestrian"}
    agents = len(columns["ade_mean"])
    assert outcomes(app)["scored"] == agents > 50
    for point in ("mean", "mode"):
        for name in ("ade", "fde"):
            labels = kind | {"point": point}
            assert value(app, f"{name}_meters_count", **labels) == agents
            mean = value(app, f"{name}_meters_sum", **labels) / agents
            assert mean == pytest.approx(columns[f"{name}_{point}"].mean(), rel=1e-5)
    for step in range(1, HORIZON + 1):
        labels = kind | {"step": step}
        count = value(app, "steps_total", **labels)
        assert count == (~np.isnan(columns["distance_mean"][:, step - 1])).sum()
        means = {
            f"distance_{point}": value(app, "displacement_meters_total", point=point, **labels)
            for point in ("mean", "mode")
        }
        means["nll_mixture"] = value(app, "nll_nats_total", sign="positive", **labels)
        means["nll_mixture"] -= value(app, "nll_nats_total", sign="negative", **labels)
        for region in (50, 80, 90, 95):
            means[f"coverage_{region}"] = value(app, "covered_total", region=region, **labels)
        for name, total in means.items():
            expected = mean_over_known(columns[name], axis=0)[step - 1]
            assert total / count == pytest.approx(expected, rel=1e-5, abs=1e-5), (name, step)


@pytest.mark.parametrize("mode", [ForecastMode.FULL, ForecastMode.GMM])
async def test_scores_of_a_replayed_crowd_are_those_of_the_streaming_protocol(
    network: Trajectron, mode: ForecastMode
) -> None:
    recording = crowd(steps=28, agents=7)
    app = application(network, **ALL)
    same_draws(app, recording)
    await replay(app, recording, ForecastOptions(mode, num_samples=1, horizon=HORIZON, seed=1))
    assert_same_as_offline(app, "small", columns_of(network, recording))
    assert watching(app).pending_agents == 0
    assert not watching(app)._sessions and not watching(app)._waiting
    await app.close()


async def test_scores_of_a_bundled_model_on_zara1_are_those_of_the_streaming_protocol(
    eth_ucy: EthUcy,
) -> None:
    (whole,) = eth_ucy.test("zara1")
    recording = whole.between(60, 105)
    loaded = registry.load("eth_ucy-without-zara1")
    app = application(loaded.model, engine=Engine([loaded]), **ALL)
    watching(app)._limits = type(watching(app)._limits)(1000.0, 10_000, agents_at_once=100)
    same_draws(app, recording)
    await replay(app, recording, ASK)
    assert_same_as_offline(app, loaded.name, columns_of(loaded.model, recording))
    await app.close()


async def test_forecasts_of_a_stream_of_several_frames_at_a_time_are_scored(
    network: Trajectron,
) -> None:
    app = application(network, **ALL)
    await app.create_session("s", SessionConfig())
    frames = walk(range(20))
    gmm = ForecastOptions(ForecastMode.GMM, horizon=4)
    key = SessionKey("default", "s")
    for first in range(0, 20, 5):
        requests = [FrameRequest(one, gmm) for one in frames[first : first + 5]]
        await app._fold(key, requests, None)
    await watching(app).settled()
    # The last four forecasts still wait for steps of their future.
    assert outcomes(app) == {"scored": 16 * 3}
    assert watching(app).pending_agents == 4 * 3
    await app.close()


async def watched(app: Application, before: int = 4, **options: Any) -> None:
    """Opens a session ``s``, shows it some frames of three people, and asks for a forecast."""
    await app.create_session("s", config(agent_timeout_s=30.0))
    for one in walk(range(before)):
        await app.observe("s", (one,), None)
    await app.predict_session("s", ForecastOptions(num_samples=1, horizon=4, **options), None)


async def test_a_refused_frame_scores_nothing(network: Trajectron) -> None:
    app = application(network, **ALL)
    await watched(app)
    (late,) = walk([2])
    results = await app.observe("s", (late, late), None)
    assert all(result.refused for result in results)
    await app.observe("s", tuple(walk([4, 4])), None)  # and one that is repeated, once
    assert watching(app).pending_agents == 3
    for step in (5, 6, 7):
        await app.observe("s", tuple(walk([step])), None)
    await watching(app).settled()
    assert outcomes(app) == {"scored": 3}
    assert value(app, "steps_total", model="small", type="pedestrian", step=4) == 3
    await app.close()


async def test_steps_in_a_silence_are_not_known_and_nobody_is_extrapolated(
    network: Trajectron,
) -> None:
    app = application(network, **ALL)
    await watched(app)  # newest frame at step 3
    for step in (4, 7):
        await app.observe("s", tuple(walk([step])), None)
    await watching(app).settled()
    counts = [
        value(app, "steps_total", model="small", type="pedestrian", step=h) for h in range(1, 5)
    ]
    assert counts == [3, 0, 0, 3]
    await app.close()


async def test_an_agent_that_leaves_is_scored_over_the_steps_that_it_stayed(
    network: Trajectron,
) -> None:
    app = application(network, **ALL)
    await watched(app)
    for step in range(4, 8):
        here = ("ann", "bob", "cat") if step == 4 else ("ann",)
        await app.observe("s", tuple(walk([step], here)), None)
    await watching(app).settled()
    assert outcomes(app) == {"scored": 3}
    counts = [
        value(app, "steps_total", model="small", type="pedestrian", step=h) for h in range(1, 5)
    ]
    assert counts == [3, 1, 1, 1]
    await app.close()


async def test_agents_of_whom_nothing_more_is_seen_are_counted_as_unseen(
    network: Trajectron,
) -> None:
    app = application(network, **ALL)
    await watched(app)
    for step in range(4, 8):
        await app.observe("s", tuple(walk([step], ("ann",))), None)
    await watching(app).settled()
    assert outcomes(app) == {"scored": 1, "unseen": 2}
    await app.close()


async def test_a_session_that_expires_is_scored_over_what_came(network: Trajectron) -> None:
    clock = Clock()
    app = application(network, clock=clock, **ALL)
    await watched(app)
    await app.observe("s", tuple(walk([4])), None)
    clock.now += 1e6
    await app._sessions.reap()
    await watching(app).settled()
    assert outcomes(app) == {"scored": 3}
    assert watching(app).pending_agents == 0
    await app.close()


async def test_a_new_session_under_an_old_name_is_not_taken_for_the_future_of_the_old_one(
    network: Trajectron,
) -> None:
    app = application(network, **ALL)
    await watched(app, before=4)
    # As though another replica had closed it, and opened it anew.
    app._sessions._on_close = lambda _: None
    await app.delete_session("s")
    await app.create_session("s", SessionConfig())
    for step in range(30, 36):
        await app.observe("s", tuple(walk([step])), None)
    await watching(app).settled()
    assert outcomes(app) == {"unseen": 3}
    await app.close()


async def test_no_more_forecasts_wait_than_allowed_and_the_oldest_are_given_up(
    network: Trajectron,
) -> None:
    app = application(network, live_accuracy_pending=10, **ALL)
    for name in map(str, range(9)):
        await app.create_session(name, SessionConfig())
        for one in walk(range(2)):
            await app.observe(name, (one,), None)
        await app.predict_session(name, ASK, None)
        assert watching(app).pending_agents <= 10
    await watching(app).settled()
    assert outcomes(app) == {"evicted": 18}
    assert len(watching(app)._sessions) == 3
    assert {pending.ids for pending in watching(app)._waiting} == {("ann", "bob", "cat")}
    await app.close()


async def test_an_agent_that_is_only_carried_on_is_not_judged(network: Trajectron) -> None:
    app = application(network, **ALL)
    await app.create_session("s", SessionConfig())
    for step in range(3):
        here = ("ann", "bob", "cat") if step < 2 else ("ann", "cat")
        await app.observe("s", tuple(walk([step], here)), None)
    forecast = await app.predict_session("s", ASK, None)
    assert [agent.id for agent in forecast.agents] == ["ann", "bob", "cat"]
    assert watching(app).pending_agents == 2
    await app.close()


async def test_stateless_forecasts_and_sessions_when_switched_off_are_not_watched(
    network: Trajectron,
) -> None:
    app = application(network, **ALL)
    await predict(app, walk(range(4)))
    assert watching(app).pending_agents == 0
    await app.close()
    off = application(network, live_accuracy=False)
    await watched(off)
    assert off._accuracy is None
    await off.close()


async def test_a_forecast_that_cannot_be_drawn_fails_nobody(
    network: Trajectron, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = application(network, **ALL)
    await app.create_session("s", SessionConfig())
    for one in walk(range(3)):
        await app.observe("s", (one,), None)
    run = app._engine.run

    def fails(jobs: Any) -> Any:
        if any(task.include_modes for job in jobs for task in job.forecasts):
            raise RuntimeError("no memory")
        return run(jobs)

    monkeypatch.setattr(app._engine, "run", fails)
    await app.predict_session("s", ASK, None)
    await watching(app).settled()
    for step in range(3, 20):
        await app.observe("s", tuple(walk([step])), None)
    await watching(app).settled()
    assert outcomes(app) == {"failed": 3}
    assert watching(app).pending_agents == 0
    await app.close()


async def test_a_forecast_given_up_while_it_is_drawn_is_counted_once(network: Trajectron) -> None:
    app = application(network, live_accuracy_pending=3, **ALL)
    watched_by = watching(app)
    await app.create_session("s", SessionConfig())
    for one in walk(range(3)):
        await app.observe("s", (one,), None)
    run_alone, count = watched_by._run_alone, 0

    async def gives_up_and_fails(call: Any) -> None:
        nonlocal count
        count += 1
        if count > 1:
            return await run_alone(call)
        await app.predict_session("s", ASK, None)
        raise RuntimeError("no memory")

    watched_by._run_alone = gives_up_and_fails
    await app.predict_session("s", ASK, None)
    await watched_by.settled()
    assert outcomes(app) == {"evicted": 3}
    assert watched_by.pending_agents == 3
    await app.close()


async def test_the_benchmark_scores_a_share_and_says_what_it_cost(network: Trajectron) -> None:
    engine = Engine([Loaded(network)])
    result = await benchmark.compare(
        engine, ForecastMode.FULL, agents=2, rounds=1, frames=15, budget=0.5
    )
    assert 0.0 < result.scored < 1.0
    assert 0.0 < result.share < 1.0


def pending(horizon: int = 3) -> Pending:
    return Pending("m", 10.0, DT_S, horizon, ("ann",), ("pedestrian",), 0.0)


def test_truth_between_two_frames_is_interpolated() -> None:
    one, before = pending(), observation(10.0, ann=(0.0, 0.0))
    for time_s in (10.3, 10.6, 10.9, 11.2):
        after = observation(time_s, ann=(10.0 * (time_s - 10.0), 1.0))
        one.advance(before, after, places_of(after))
        before = after
    assert one.complete
    np.testing.assert_allclose(one.truth[0, :, 0], [4.0, 8.0, 12.0], atol=1e-9)


def test_one_who_comes_back_as_another_type_is_another_agent() -> None:
    one = pending()
    seen = observation(10.4, ann=(1.0, 1.0))
    other = type(seen)(seen.time_s, seen.ids, ("cyclist",), seen.positions)
    one.advance(observation(10.0, ann=(0.0, 0.0)), other, places_of(other))
    assert one.reached == 1 and not one.known.any()


def test_the_budget_holds_on_average_whatever_pieces_cost() -> None:
    random = np.random.default_rng(0)
    budget, spent, inference = Budget(0.05), 0.0, 0.0
    waiting: list[float] = []
    for _ in range(20_000):
        inference += 0.004
        budget.earn(0.004)
        reserved = budget.reserve(int(random.integers(1, 9)), draw=True)
        if reserved is not None:
            waiting.append(reserved)
        if len(waiting) > 5:  # paid after others were let in, at more than the first guess
            budget.release(waiting.pop(0))
            cost = float(random.exponential(0.05))
            budget.spend(cost)
            budget.note("score", 5, cost)
            spent += cost
    assert 0.045 < spent / inference < 0.051


def test_an_impossible_position_counts_as_a_thousand_nats_and_no_more() -> None:
    mixture = PositionMixture(
        np.ones((1, 1)), np.zeros((1, 1, 1, 2)), np.array([[[[1e-6, 0, 1e-6]]]])
    )
    scores = live.score(mixture, np.array([[[500.0, 0.0]]]), np.random.default_rng(0))
    assert scores.nll_mixture.tolist() == [[live.NLL_BOUND]]
    assert scores.distance_mean_m.tolist() == [[500.0]]
    assert scores.covered.ravel().tolist() == [0.0] * 4
