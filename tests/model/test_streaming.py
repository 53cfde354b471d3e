"""Online is offline folded: one frame at a time equals the whole history; scenes stack."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest
import safetensors.numpy
import torch

from trajectron_model.config import EdgeRadius, ModelConfig, NodeType
from trajectron_model.history import History, find_edges
from trajectron_model.state import SceneFrame, SceneState, stack
from trajectron_model.trajectron import Trajectron

SceneMaker = Callable[..., list[SceneFrame]]
Fold = Callable[[Trajectron, list[SceneFrame]], SceneState]

MIXED = ("pedestrian", "vehicle", "obstacle")


def as_history(frames: list[SceneFrame], config: ModelConfig) -> tuple[History, list[str]]:
    ids = sorted({agent for frame in frames for agent in frame.ids})
    position = np.full((len(frames), len(ids), 2), 777.0)
    present = np.zeros((len(frames), len(ids)), dtype=bool)
    kind = np.zeros(len(ids), dtype=np.int64)
    for t, frame in enumerate(frames):
        rows = [ids.index(agent) for agent in frame.ids]
        position[t, rows] = frame.positions
        present[t, rows] = True
        kind[rows] = [config.type_index(name) for name in frame.types]
    return History(position, present, kind, np.zeros(len(ids), dtype=np.int64)), ids


def encoding(network: Trajectron, state: SceneState) -> torch.Tensor:
    with torch.inference_mode():
        return network.encoding(state.encoder, state.influence, state.node_type)


def assert_same(one: SceneState, other: SceneState, tolerance: float = 1e-5) -> None:
    assert one.ids == other.ids and one.time_s == other.time_s
    for a, b in zip((*one.motion, *one.encoder), (*other.motion, *other.encoder), strict=True):
        torch.testing.assert_close(a, b, atol=tolerance, rtol=tolerance)
    for counter, expected in zip(one.graph, other.graph, strict=True):
        np.testing.assert_array_equal(counter, expected)
    torch.testing.assert_close(one.influence, other.influence)


@pytest.mark.parametrize("seed", range(4))
def test_streaming_equals_the_whole_history_pass(
    model: Trajectron, mixed_model: Trajectron, crowd: SceneMaker, fold: Fold, seed: int
) -> None:
    for network, types in ((model, ("pedestrian",)), (mixed_model, MIXED)):
        frames = crowd(steps=14, seed=seed, types=types)
        state = fold(network, frames)
        past, ids = as_history(frames, network.config)
        with torch.no_grad():
            whole = network.encode(past, np.arange(len(ids)))
        order = [ids.index(agent) for agent in state.ids]
        found = encoding(network, state)
        torch.testing.assert_close(found, whole.encoding[order], atol=1e-5, rtol=0.0)
        torch.testing.assert_close(
            state.motion.velocity, whole.motion.velocity[order], atol=1e-5, rtol=0.0
        )
        # The crowd must have exercised what is claimed.
        edges = find_edges(past, network.config).mask
        made_or_broken = np.diff(edges.astype(int), axis=0) != 0
        assert not past.present.all() and made_or_broken.sum() > 20


@pytest.mark.parametrize("features", ["heading", "world"])
def test_streaming_equals_it_for_other_inputs_and_radii_too(
    crowd: SceneMaker, fold: Fold, features: Literal["heading", "world"]
) -> None:
    torch.manual_seed(2)
    types = (NodeType("pedestrian"), NodeType("vehicle"), NodeType("obstacle", 0.0))
    radii = (EdgeRadius("pedestrian", "vehicle", 5.0), EdgeRadius("vehicle", "vehicle", 1.0))
    network = Trajectron(ModelConfig(types=types, features=features, radii=radii)).eval()
    frames = crowd(types=MIXED)
    state = fold(network, frames)
    past, ids = as_history(frames, network.config)
    with torch.no_grad():
        whole = network.encode(past, np.arange(len(ids))).encoding
    order = [ids.index(agent) for agent in state.ids]
    torch.testing.assert_close(encoding(network, state), whole[order], atol=1e-5, rtol=0.0)


def test_encoding_some_nodes_equals_encoding_all(
    mixed_model: Trajectron, crowd: SceneMaker
) -> None:
    past, ids = as_history(crowd(types=MIXED), mixed_model.config)
    some = np.array([1, 4, 7])
    with torch.no_grad():
        every = mixed_model.encode(past, np.arange(len(ids))).encoding
        few = mixed_model.encode(past, some).encoding
    torch.testing.assert_close(few, every[some], atol=1e-6, rtol=0.0)


def test_scenes_stepped_in_one_batch_are_as_alone(
    mixed_model: Trajectron, crowd: SceneMaker, fold: Fold
) -> None:
    scenes = [crowd(agents=agents, seed=agents, types=MIXED) for agents in (1, 5, 12, 3)]
    scenes[1][3] = scenes[1][3]._replace(ids=(), types=(), positions=np.empty((0, 2)))
    states = [mixed_model.initial_state() for _ in scenes]
    for at_once in zip(*scenes, strict=True):
        states = mixed_model.step(states, at_once)
    for state, frames in zip(states, scenes, strict=True):
        assert_same(state, fold(mixed_model, frames))


def test_the_same_agent_ids_in_two_scenes_do_not_meet(
    model: Trajectron, crowd: SceneMaker, fold: Fold
) -> None:
    frames = crowd(seed=1)
    moved = [f._replace(positions=f.positions + np.array([0.1, 0.0])) for f in frames]
    states = [model.initial_state()] * 2
    for pair in zip(frames, moved, strict=True):
        states = model.step(states, pair)
    assert_same(states[0], fold(model, frames))


def test_step_leaves_its_arguments_alone(model: Trajectron, crowd: SceneMaker, fold: Fold) -> None:
    frames = crowd()
    state = fold(model, frames[:-1])
    before = state.to_bytes()
    first = model.step([state], frames[-1:])[0]
    again = model.step([state], frames[-1:])[0]
    assert state.to_bytes() == before
    assert first.to_bytes() == again.to_bytes() != before


def test_an_empty_frame_keeps_agents_and_ends_edges(
    model: Trajectron, crowd: SceneMaker, fold: Fold
) -> None:
    state = fold(model, crowd(missing=0.0))
    assert state.edges()
    (after,) = model.step([state], [SceneFrame(99.0, (), (), np.empty((0, 2)))])
    assert after.ids == state.ids and not after.edges() and after.time_s == 99.0
    assert (after.last_seen_s == state.last_seen_s).all()
    torch.testing.assert_close(after.encoder.node_h, state.encoder.node_h, atol=0.0, rtol=0.0)


def test_an_agent_that_was_missing_moves_by_the_time_elapsed(model: Trajectron) -> None:
    state = model.initial_state()
    for time_s, x in ((0.0, 0.0), (0.4, 0.4), (1.6, 3.4)):
        frame = SceneFrame(time_s, ("a",), ("pedestrian",), np.array([[x, 0.0]]))
        (state,) = model.step([state], [frame])
        (state,) = model.step([state], [SceneFrame(time_s + 0.1, (), (), np.empty((0, 2)))])
    torch.testing.assert_close(state.motion.velocity, torch.tensor([[3.0 / 1.2, 0.0]]))
    assert state.observations.tolist() == [3]


def test_an_agent_that_changes_its_type_starts_anew(mixed_model: Trajectron) -> None:
    state = mixed_model.initial_state()
    for time_s, kind in ((0.0, "pedestrian"), (0.4, "pedestrian"), (0.8, "vehicle")):
        frame = SceneFrame(time_s, ("a",), (kind,), np.array([[time_s, 0.0]]))
        (state,) = mixed_model.step([state], [frame])
    assert state.ids == ("a",) and state.observations.tolist() == [1]
    assert state.node_type.tolist() == [1]


def test_an_unknown_type_is_refused_by_name(model: Trajectron) -> None:
    frame = SceneFrame(0.0, ("a",), ("dog",), np.zeros((1, 2)))
    with pytest.raises(ValueError, match=r"unknown agent type 'dog'.*pedestrian"):
        model.step([model.initial_state()], [frame])


def test_a_state_survives_its_bytes(mixed_model: Trajectron, crowd: SceneMaker, fold: Fold) -> None:
    frames = crowd(types=MIXED)
    state = fold(mixed_model, frames[:-1])
    copy = SceneState.from_bytes(state.to_bytes())
    assert copy.to_bytes() == state.to_bytes()
    next_of = [mixed_model.step([s], frames[-1:])[0] for s in (state, copy)]
    assert next_of[0].to_bytes() == next_of[1].to_bytes()
    empty = mixed_model.initial_state()
    assert SceneState.from_bytes(empty.to_bytes()).ids == ()


@pytest.mark.parametrize("damage", [b"", b"not a state", b"\x00" * 64])
def test_bytes_that_are_no_state_are_refused(damage: bytes) -> None:
    with pytest.raises(ValueError, match="no scene state"):
        SceneState.from_bytes(damage)


def test_truncated_bytes_are_refused(model: Trajectron, crowd: SceneMaker, fold: Fold) -> None:
    data = fold(model, crowd()).to_bytes()
    with pytest.raises(ValueError, match="no scene state"):
        SceneState.from_bytes(data[:-100])


@pytest.mark.parametrize("head", ["[]", "null", '{"format": 1, "ids": 3, "time_s": 0}'])
def test_a_head_that_is_none_is_refused(model: Trajectron, head: str) -> None:
    arrays = safetensors.numpy.load(model.initial_state().to_bytes())
    arrays["head"] = np.frombuffer(head.encode(), dtype=np.uint8)
    with pytest.raises(ValueError, match="no scene state"):
        SceneState.from_bytes(safetensors.numpy.save(arrays))


def test_more_ids_than_rows_are_refused(model: Trajectron, crowd: SceneMaker, fold: Fold) -> None:
    state = fold(model, crowd())
    longer = state._replace(ids=(*state.ids, "one more"))
    with pytest.raises(ValueError, match="unequal length"):
        SceneState.from_bytes(longer.to_bytes())


@pytest.mark.parametrize("places", [[[0.0, 0.0], [np.nan, 1.0]], [[0.0, 0.0], [np.inf, 1.0]]])
def test_places_that_are_not_finite_are_refused(
    model: Trajectron, places: list[list[float]]
) -> None:
    frame = SceneFrame(0.0, ("a", "b"), ("pedestrian",) * 2, np.array(places))
    with pytest.raises(ValueError, match="finite"):
        model.step([model.initial_state()], [frame])


def test_an_id_twice_in_a_frame_is_refused(model: Trajectron) -> None:
    frame = SceneFrame(0.0, ("a", "a"), ("pedestrian",) * 2, np.zeros((2, 2)))
    with pytest.raises(ValueError, match="distinct"):
        model.step([model.initial_state()], [frame])


def test_dropping_agents_keeps_what_is_between_the_others(
    model: Trajectron, crowd: SceneMaker, fold: Fold
) -> None:
    state = fold(model, crowd(missing=0.0))
    kept = state.keep(["3", "7", "5"])
    assert set(kept.ids) == {"3", "5", "7"}
    assert {e.receiver_id for e in kept.edges()} <= set(kept.ids)
    expected = {e for e in state.edges() if {e.receiver_id, e.sender_id} <= set(kept.ids)}
    assert set(kept.edges()) == expected
    rows = [state.ids.index(agent) for agent in kept.ids]
    torch.testing.assert_close(kept.encoder.edge_h, state.encoder.edge_h[rows])
    assert state.keep(state.ids) is state


def test_a_dropped_agent_influences_nobody_any_more(
    mixed_model: Trajectron, crowd: SceneMaker, fold: Fold
) -> None:
    frames = crowd(types=MIXED, missing=0.0)
    state = fold(mixed_model, frames)
    receiver = state.edges()[0].receiver_id
    alone = state.keep([receiver])
    assert state.influence[state.ids.index(receiver)].sum() > 0.0
    assert alone.influence.tolist() == [[0.0, 0.0, 0.0]]


def test_stacking_keeps_every_edge_in_its_scene(
    model: Trajectron, crowd: SceneMaker, fold: Fold
) -> None:
    states = [fold(model, crowd(seed=s, prefix=f"{s}-", missing=0.1)) for s in (0, 1)]
    both = stack(states)
    assert sorted(both.edges()) == sorted(states[0].edges() + states[1].edges())


def test_inputs_are_causal(model: Trajectron, crowd: SceneMaker) -> None:
    """The encoding at a step is the same whatever comes after it."""
    frames = crowd(steps=10, missing=0.0)
    past, ids = as_history(frames, model.config)
    rows = np.arange(len(ids))
    early = History(past.position[:7], past.present[:7], past.node_type, past.scene)
    changed = past.position.copy()
    changed[7:] += 5.0
    with torch.no_grad():
        expected = model.encode(early, rows).encoding
        state = model.initial_state()
        for t, frame in enumerate(frames):
            order = [ids.index(agent) for agent in frame.ids]
            moved = frame._replace(positions=changed[t, order])
            (state,) = model.step([state], [moved])
            if t == 6:
                found = encoding(model, state)
    at_six = [ids.index(agent) for agent in state.ids]
    torch.testing.assert_close(found, expected[at_six], atol=1e-5, rtol=0.0)
