"""Packed scenes stepped by the kernel say what ``Trajectron.step`` says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from trajectron_model import online, packed
from trajectron_model.config import EdgeRadius, ModelConfig, NodeType
from trajectron_model.kernels import kernels
from trajectron_model.packed import EDGE, Layout, PackedScene, blank_scene
from trajectron_model.state import SceneFrame, SceneState
from trajectron_model.trajectron import Trajectron

needs_kernels = pytest.mark.skipif(kernels() is None, reason="kernels are not compiled")
MIXED = ModelConfig(
    types=(NodeType("pedestrian"), NodeType("car", 40.0, 8.0), NodeType("post", 0.0)),
    radii=(EdgeRadius("pedestrian", "car", 6.0), EdgeRadius("car", "car", 12.0)),
    removal_filter=(0.5, 0.25),
)


def network(config: ModelConfig) -> Trajectron:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        model = Trajectron(config)
    with torch.no_grad():
        for weight in model.parameters():
            weight.mul_(2.0)
    return model.eval().requires_grad_(False)


def recording(
    config: ModelConfig, steps: int, agents: int, seed: int, spread_m: float = 8.0
) -> list[SceneFrame]:
    """People who come and go, stand and walk, near each other and far; edges flicker."""
    random = np.random.default_rng(seed)
    place = random.uniform(0.0, spread_m, (agents, 2)) + 1e5
    velocity = random.normal(0.0, 1.0, (agents, 2)) * random.integers(0, 2, (agents, 1))
    types = random.integers(0, len(config.types), agents)
    frames = []
    for t in range(steps):
        here = random.permutation(np.flatnonzero(random.random(agents) < 0.8))
        frames.append(
            SceneFrame(
                0.4 * t + random.uniform(0.0, 0.05),
                tuple(f"a{i}" for i in here),
                tuple(config.node_types[types[i]] for i in here),
                place[here] + 0.4 * t * velocity[here] + random.normal(0.0, 0.05, (len(here), 2)),
            )
        )
    return frames


def assert_same(scene: PackedScene, state: SceneState, model: Trajectron) -> None:
    """Equal to 1e-5, ids, types and counters exactly."""
    given_ = online.state_of(model, scene)
    assert given_.ids == state.ids
    assert given_.time_s == state.time_s
    assert [e[:4] for e in given_.edges()] == [e[:4] for e in state.edges()]
    np.testing.assert_array_equal(given_.node_type.numpy(), state.node_type.numpy())
    np.testing.assert_allclose(given_.modulation, state.modulation, atol=1e-6)
    np.testing.assert_allclose(given_.influence.numpy(), state.influence.numpy(), atol=1e-6)
    for columns, wanted in ((given_.motion, state.motion), (given_.encoder, state.encoder)):
        for name, column in columns._asdict().items():
            other = getattr(wanted, name)
            np.testing.assert_allclose(column.numpy(), other.numpy(), atol=1e-5, err_msg=name)


@needs_kernels
@pytest.mark.parametrize(
    "config",
    # Sizes that fill neither vectors nor blocks of them.
    [ModelConfig(), MIXED, ModelConfig(history_size=13, edge_size=3)],
    ids=["one type", "three types", "odd sizes"],
)
@pytest.mark.parametrize("agents", [1, 7, 90])
def test_streamed_by_the_kernel_a_recording_is_the_fold_of_steps(
    config: ModelConfig, agents: int
) -> None:
    model = network(config)
    scene, state = blank_scene(), model.initial_state()
    for frame in recording(config, 16, agents, seed=agents):
        (scene,) = online.step(model, [scene], [frame])
        (state,) = model.step([state], [frame])
        assert_same(scene, state, model)
    assert scene.edge_count > 0 or agents == 1


@needs_kernels
def test_agents_that_are_dropped_leave_no_trace() -> None:
    model = network(MIXED)
    scene, state = blank_scene(), model.initial_state()
    for t, frame in enumerate(recording(MIXED, 14, 12, seed=5)):
        gone = frozenset(scene.ids[::3]) if t % 4 == 3 else frozenset[str]()
        scene = packed.without(scene, gone, MIXED)
        state = state.keep([name for name in state.ids if name not in gone])
        assert_same(scene, state, model)
        (scene,) = online.step(model, [scene], [frame])
        (state,) = model.step([state], [frame])
        assert_same(scene, state, model)


@needs_kernels
def test_an_agent_under_another_type_starts_anew() -> None:
    model = network(MIXED)
    scene, state = blank_scene(), model.initial_state()
    for t in range(6):
        kind = "car" if t == 3 else "pedestrian"
        places = np.array([[0.4 * t, 0.0], [0.4 * t, 1.0]])
        frame = SceneFrame(0.4 * t, ("ann", "bob"), (kind, "pedestrian"), places)
        (scene,) = online.step(model, [scene], [frame])
        (state,) = model.step([state], [frame])
        assert_same(scene, state, model)


@needs_kernels
def test_scenes_stepped_together_are_those_stepped_alone_bit_for_bit() -> None:
    model = network(ModelConfig())
    films = [recording(ModelConfig(), 6, agents, seed=agents) for agents in (3, 1, 60, 8)]
    together = [blank_scene() for _ in films]
    alone = list(together)
    for t in range(6):
        frames = [film[t] for film in films]
        together = online.step(model, together, frames)
        alone = [online.step(model, [s], [f])[0] for s, f in zip(alone, frames, strict=True)]
        assert together == alone


@needs_kernels
def test_a_crowd_in_one_spot_has_all_its_edges() -> None:
    """More edges than the first guess has room for, and more neighbours than are sorted."""
    model = network(ModelConfig())
    crowd = recording(ModelConfig(), 2, 120, seed=1, spread_m=2.0)
    scene, state = blank_scene(), model.initial_state()
    for frame in crowd:
        (scene,) = online.step(model, [scene], [frame])
        (state,) = model.step([state], [frame])
    assert scene.edge_count > 8000
    given_, wanted = online.state_of(model, scene), state
    assert given_.edges() == wanted.edges()
    # Sums of a hundred neighbours: the kernel adds them up in double precision.
    np.testing.assert_allclose(given_.encoder.edge_h, wanted.encoder.edge_h, atol=1e-4)


@needs_kernels
def test_edges_hold_to_the_radius_wherever_the_scene_lies() -> None:
    model = network(ModelConfig())
    random = np.random.default_rng(0)
    for origin in (0.0, -1e6, 1e9):
        places = random.uniform(-20.0, 20.0, (200, 2)) + origin
        ids = tuple(str(i) for i in range(200))
        frame = SceneFrame(0.0, ids, ("pedestrian",) * 200, places)
        (scene,) = online.step(model, [blank_scene()], [frame])
        distance = np.linalg.norm(places[:, None] - places[None], axis=2)
        joined = np.argwhere((distance <= 3.0) & ~np.eye(200, dtype=bool))
        edges = np.frombuffer(scene.edges, dtype=EDGE)
        np.testing.assert_array_equal(np.c_[edges["receiver"], edges["sender"]], joined)


def test_without_kernels_packed_scenes_are_stepped_by_torch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = network(MIXED)
    monkeypatch.setattr(online, "library_for", lambda _module: None)
    scene, state = blank_scene(), model.initial_state()
    for frame in recording(MIXED, 5, 9, seed=2):
        (scene,) = online.step(model, [scene], [frame])
        (state,) = model.step([state], [frame])
    assert scene == packed.pack(state, Layout.of(MIXED))


def test_the_papers_inputs_are_stepped_by_torch() -> None:
    model = network(ModelConfig(features="world"))
    scene, state = blank_scene(), model.initial_state()
    for frame in recording(model.config, 4, 5, seed=4):
        (scene,) = online.step(model, [scene], [frame])
        (state,) = model.step([state], [frame])
    assert_same(scene, state, model)


@pytest.mark.parametrize("fault", ["twice", "nan", "type"])
def test_a_frame_that_cannot_be_is_refused(fault: str) -> None:
    model = network(ModelConfig())
    ids = ("ann", "ann") if fault == "twice" else ("ann", "bob")
    kinds = ("pedestrian", "tram" if fault == "type" else "pedestrian")
    places = np.array([[0.0, 0.0], [np.nan if fault == "nan" else 1.0, 0.0]])
    with pytest.raises(ValueError, match=r"distinct|finite|tram"):
        online.step(model, [blank_scene()], [SceneFrame(0.0, ids, kinds, places)])


def scene_of(config: ModelConfig, agents: int = 9) -> tuple[PackedScene, Trajectron]:
    model = network(config)
    scene = blank_scene()
    for frame in recording(config, 5, agents, seed=8):
        (scene,) = online.step(model, [scene], [frame])
    return scene, model


@pytest.mark.parametrize("config", [ModelConfig(), MIXED], ids=["one type", "three types"])
def test_bytes_come_back_bit_for_bit(config: ModelConfig) -> None:
    scene, model = scene_of(config)
    layout = Layout.of(config)
    again = PackedScene.from_bytes(scene.to_bytes(layout), layout)
    assert again == scene
    assert packed.pack(online.state_of(model, scene), layout) == scene
    empty = blank_scene()
    assert PackedScene.from_bytes(empty.to_bytes(layout), layout) == empty


def test_a_scene_takes_little_room() -> None:
    scene, _ = scene_of(ModelConfig(), agents=40)
    size = len(scene.to_bytes(Layout.of(ModelConfig())))
    assert size < 1024 * len(scene.ids)


def test_a_scene_of_other_sizes_is_refused() -> None:
    scene, _ = scene_of(MIXED)
    data = scene.to_bytes(Layout.of(MIXED))
    with pytest.raises(ValueError, match="another model"):
        PackedScene.from_bytes(data, Layout.of(ModelConfig()))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_bytes_are_refused_or_safe_to_step(data: st.DataObject) -> None:
    """Whatever is read steps without a number that leads outside of its scene."""
    scene, model = _SCENE
    layout = Layout.of(MIXED)
    damaged = bytearray(scene.to_bytes(layout))
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, 3))
    try:
        read = PackedScene.from_bytes(bytes(damaged[: len(damaged) - cut]), layout)
    except ValueError as error:
        assert "packed scene" in str(error)  # noqa: PT017 - either is right
        return
    (after,) = online.step(model, [read], [frame_of(read.ids)])
    assert set(read.ids) <= set(after.ids)


def frame_of(ids: Sequence[str]) -> SceneFrame:
    places = np.arange(2.0 * len(ids)).reshape(-1, 2)
    return SceneFrame(2.0, tuple(ids), ("pedestrian",) * len(ids), places)


_SCENE = scene_of(MIXED)
