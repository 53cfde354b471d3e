"""The engine on a real network: online is offline folded, batches change nothing, time holds."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.service.building import Loaded, mixed_network, observation

from trajectron_model import checkpoint, online
from trajectron_model.config import MAX_HORIZON, ModelConfig
from trajectron_model.forecast import ForecastRequest
from trajectron_model.packed import Layout, PackedScene, blank_scene
from trajectron_model.state import SceneFrame
from trajectron_model.trajectron import Trajectron
from trajectron_service import engine as engines
from trajectron_service.engine import Engine, pack, unpack
from trajectron_service.messages import AgentForecast, ForecastMode, Sampling
from trajectron_service.scenes import ForecastTask, SceneJob, SceneResult, State
from trajectron_service.settings import Settings, SettingsError
from trajectron_service.timebase import Grid, Observation, Step, Timeline, advance, head

DT_S = 0.4


@pytest.fixture(scope="module")
def engine(network: Trajectron) -> Engine:
    return Engine([Loaded(network)])


def crowd(times: Iterable[float], seed: int = 0, missing: float = 0.2) -> list[Observation]:
    """People in a small square who come and go; places depend on time alone."""
    random = np.random.default_rng(seed)
    start, velocity = random.uniform(0, 6, (8, 2)), random.normal(0, 1, (8, 2))
    frames = []
    for t in times:
        here = [i for i in range(8) if random.random() >= missing]
        places = {f"p{i}": tuple(start[i] + t * velocity[i]) for i in here}
        frames.append(observation(float(t), **places))
    return frames


def job_of(
    frames: Sequence[Observation], interval_s: float | None = None, **changes: Any
) -> tuple[SceneJob, Timeline]:
    """All frames of a new scene as one job, its last states kept."""
    timeline = Timeline(Grid.of(DT_S, interval_s, 1e6))
    steps: list[Step] = []
    for one in frames:
        taken = advance(timeline, one)
        timeline = taken.timeline
        steps.extend(taken.steps)
    keep = tuple(state.serial for state in timeline.committed)
    return dataclasses.replace(SceneJob("small", (), (), tuple(steps), keep), **changes), timeline


def task(timeline: Timeline, **changes: Any) -> ForecastTask:
    asked = ForecastTask(head(timeline), ForecastMode.FULL, 5, 6, 3, 9, None, True, Sampling.IID)
    return dataclasses.replace(asked, **changes)


def by_hand(network: Trajectron, frames: Sequence[Observation]) -> PackedScene:
    scene = blank_scene()
    for one in frames:
        frame = SceneFrame(one.time_s, one.ids, one.types, one.positions)
        (scene,) = online.step(network, [scene], [frame])
    return scene


def newest(result: SceneResult) -> PackedScene:
    return cast("PackedScene", result.states[-1])


def test_a_recording_at_the_models_rate_is_the_models_own_fold(
    engine: Engine, network: Trajectron
) -> None:
    frames = crowd(np.arange(15) * DT_S)
    job, _ = job_of(frames)
    (result,) = engine.run([job])
    assert newest(result) == by_hand(network, frames)


def test_a_recording_at_four_times_the_rate_is_the_fold_of_every_fourth_frame(
    engine: Engine, network: Trajectron
) -> None:
    frames = crowd(np.arange(30) * 0.1)
    job, _ = job_of(frames, interval_s=0.1)
    (result,) = engine.run([job])
    wanted, given = by_hand(network, frames[29 % 4 :: 4]), newest(result)
    assert given.ids == wanted.ids
    assert given.time_s == wanted.time_s
    assert given.edges == wanted.edges
    # Not bit for bit without kernels: here the four chains were stepped as one batch.
    states = [online.state_of(network, scene) for scene in (given, wanted)]
    for a, b in zip(*(state.encoder for state in states), strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), atol=1e-6)


def test_frame_by_frame_or_all_at_once_is_the_same(engine: Engine, network: Trajectron) -> None:
    frames = crowd(np.arange(12) * 0.1)
    job, _ = job_of(frames, interval_s=0.1)
    (at_once,) = engine.run([job])
    timeline = Timeline(Grid.of(DT_S, 0.1, 1e6))
    states: tuple[State, ...] = ()
    for one in frames:
        taken = advance(timeline, one)
        serials = tuple(state.serial for state in timeline.committed)
        timeline = taken.timeline
        keep = tuple(state.serial for state in timeline.committed)
        (result,) = engine.run([SceneJob("small", serials, states, taken.steps, keep)])
        states = result.states
    assert newest(result).ids == newest(at_once).ids
    both = [online.state_of(network, newest(one)) for one in (result, at_once)]
    for a, b in zip(*(state.encoder for state in both), strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), atol=1e-6)


def close(first: Sequence[AgentForecast], second: Sequence[AgentForecast], atol: float) -> None:
    assert [a.id for a in first] == [a.id for a in second]
    for a, b in zip(first, second, strict=True):
        assert (a.x, a.y, a.observations) == (b.x, b.y, b.observations)
        for name in ("mean", "covariance", "samples", "mode_probabilities"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=atol)


def test_what_else_is_in_the_batch_changes_nothing(engine: Engine) -> None:
    jobs = []
    for seed, count in enumerate((3, 9, 15)):
        job, timeline = job_of(crowd(np.arange(count) * DT_S, seed))
        jobs.append(dataclasses.replace(job, forecasts=(task(timeline, horizon=4 + seed),)))
    together = engine.run(jobs)
    alone = [engine.run([job])[0] for job in jobs]
    for a, b in zip(together, alone, strict=True):
        close(a.forecasts[0], b.forecasts[0], 1e-4)


def test_a_provisional_step_starts_the_forecast_at_the_newest_frame_and_is_not_kept(
    engine: Engine, network: Trajectron
) -> None:
    frames = crowd([0.0, 0.4, 0.8, 1.1], missing=0.0)
    job, timeline = job_of(frames)
    (result,) = engine.run([dataclasses.replace(job, forecasts=(task(timeline),))])
    assert newest(result).time_s == 0.8
    state = online.state_of(network, by_hand(network, frames))
    (wanted,) = network.forecast(
        [state], [ForecastRequest("full", 5, 6, 3, 9, None, include_modes=True)]
    )
    assert wanted.samples is not None
    given = result.forecasts[0]
    assert [a.last_observed_time for a in given] == [1.1] * 8
    for row, agent in enumerate(given):
        assert agent.samples is not None
        np.testing.assert_allclose(agent.samples, wanted.samples[row], atol=1e-6)


def away(engine: Engine, last_s: float, horizon: int) -> tuple[AgentForecast, PackedScene, float]:
    """The forecast of Ann, who was not in the frames after 0.8 s."""
    both = [observation(t, ann=(t, 0.0), bob=(9.0, t)) for t in (0.0, 0.4, 0.8)]
    times = np.arange(1.2, last_s + 1e-9, 0.4).tolist()
    frames = both + [observation(t, bob=(9.0, t)) for t in times]
    if frames[-1].time_s < last_s - 1e-9:
        frames.append(observation(last_s, bob=(9.0, last_s)))
    job, timeline = job_of(frames)
    asked = task(timeline, horizon=horizon, agents=("bob", "ann"))
    (result,) = engine.run([dataclasses.replace(job, forecasts=(asked,))])
    bob, ann = result.forecasts[0]
    assert bob.id == "bob"
    assert bob.last_observed_time == pytest.approx(last_s)
    return ann, newest(result), last_s


def of_ann(network: Trajectron, scene: PackedScene, horizon: int) -> NDArray[np.float32]:
    request = ForecastRequest("full", 5, horizon, 3, 9, ("ann",), include_modes=True)
    (drawn,) = network.forecast([online.state_of(network, scene)], [request])
    assert drawn.samples is not None
    offsets: NDArray[np.float32] = drawn.samples[0]
    return offsets


def test_a_missing_agents_forecast_holds_at_everybodys_times(
    engine: Engine, network: Trajectron
) -> None:
    ann, state, _ = away(engine, last_s=1.6, horizon=6)
    assert ann.last_observed_time == pytest.approx(0.8)
    assert ann.x == pytest.approx(0.8)
    # Two steps away: what the model says of steps 3 to 8 after she was seen.
    assert ann.samples is not None
    np.testing.assert_allclose(ann.samples, of_ann(network, state, 8)[:, 2:], atol=1e-6)


def test_a_time_away_of_half_steps_is_interpolated(engine: Engine, network: Trajectron) -> None:
    ann, state, _ = away(engine, last_s=1.4, horizon=6)
    longer = of_ann(network, state, 8)
    assert ann.samples is not None
    wanted = 0.5 * longer[:, 1:7] + 0.5 * longer[:, 2:8]
    np.testing.assert_allclose(ann.samples, wanted, atol=1e-5)


def test_beyond_the_longest_horizon_the_last_change_is_held(
    engine: Engine, network: Trajectron
) -> None:
    ann, state, _ = away(engine, last_s=1.6, horizon=MAX_HORIZON)
    longest = of_ann(network, state, MAX_HORIZON)
    assert ann.samples is not None
    assert ann.samples.shape == (5, MAX_HORIZON, 2)
    np.testing.assert_allclose(ann.samples[:, :-2], longest[:, 2:], atol=1e-4)
    change = longest[:, -1] - longest[:, -2]
    np.testing.assert_allclose(ann.samples[:, -1], longest[:, -1] + 2 * change, atol=1e-4)


def test_agents_that_cannot_move_are_forecast_only_when_asked_for() -> None:
    engine = Engine([Loaded(mixed_network())])
    places = np.array([[0.0, 0.0], [1.0, 0.0]])
    scene = Observation(0.0, ("p", "o"), ("pedestrian", "obstacle"), places)
    job, timeline = job_of([scene])
    asked = (task(timeline), task(timeline, agents=("o",)))
    (result,) = engine.run([dataclasses.replace(job, forecasts=asked)])
    everyone, obstacle = result.forecasts
    assert [a.id for a in everyone] == ["p"]
    assert obstacle[0].samples is not None
    assert not obstacle[0].samples.any()


def test_an_empty_scene_has_an_empty_forecast(engine: Engine) -> None:
    job, timeline = job_of([observation(0.0)])
    (result,) = engine.run([dataclasses.replace(job, forecasts=(task(timeline),))])
    assert result.forecasts == ((),)


def test_packed_states_come_back_bit_for_bit(engine: Engine) -> None:
    job, _ = job_of(crowd(np.arange(9) * 0.1), interval_s=0.1, pack=True)
    (result,) = engine.run([job])
    assert result.packed is not None
    layout = Layout.of(ModelConfig())
    again = unpack(result.packed, layout)
    assert again == tuple(cast("PackedScene", state) for state in result.states)
    assert pack(again, layout) == result.packed
    (woken,) = engine.run([SceneJob("small", job.keep, result.packed, keep=job.keep)])
    assert newest(woken) == newest(result)


@pytest.mark.parametrize("cut", [-1, 4, 20])
def test_damaged_states_are_refused(engine: Engine, cut: int) -> None:
    job, _ = job_of(crowd([0.0]), pack=True)
    (result,) = engine.run([job])
    assert result.packed is not None
    with pytest.raises(ValueError, match=r"state|scene"):
        unpack(result.packed[:cut], Layout.of(ModelConfig()))


def test_a_long_history_does_not_keep_every_state(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, timeline = job_of(crowd(np.arange(60) * DT_S))
    tables: list[dict[int, PackedScene]] = []
    original = engines._table

    def noting(one: SceneJob, model: Trajectron) -> dict[int, PackedScene]:
        tables.append(original(one, model))
        return tables[-1]

    monkeypatch.setattr(engines, "_table", noting)
    engine.run([dataclasses.replace(job, forecasts=(task(timeline),))])
    assert set(tables[0]) == set(job.keep)


def test_models_are_loaded_by_name_or_path_the_default_first(
    network: Trajectron, tmp_path: Path
) -> None:
    for name in ("one", "two"):
        checkpoint.save(tmp_path / name, network, {"task": name})
    paths = tuple(str(tmp_path / name) for name in ("one", "two"))
    loaded = engines.load(Settings(models=paths, default_model=paths[1]))
    assert loaded.default_model == "two"
    assert set(loaded.models) == {"one", "two"}
    info = loaded.models["two"].info
    assert (info.is_default, info.provenance, info.dt_s) == (True, {"task": "two"}, DT_S)
    loaded.warm_up()


def test_a_model_that_cannot_be_loaded_is_an_error_of_the_settings(
    network: Trajectron, tmp_path: Path
) -> None:
    with pytest.raises(SettingsError, match="nowhere"):
        engines.load(Settings(models=(str(tmp_path / "nowhere"),)))
    (tmp_path / "sub").mkdir()
    for folder in (tmp_path, tmp_path / "sub"):
        checkpoint.save(folder / "same", network, {})
    twice = (str(tmp_path / "same"), str(tmp_path / "sub" / "same"))
    with pytest.raises(SettingsError, match="2 models are called 'same'"):
        engines.load(Settings(models=twice))
