"""Edges by proximity, their ages, and the modulation that ages define."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trajectron_model import graph
from trajectron_model.config import EdgeRadius, ModelConfig, NodeType

CONFIG = ModelConfig(addition_filter=(0.25, 0.5, 0.75, 1.0), removal_filter=(0.5, 0.1))


def fold(mask: np.ndarray, config: ModelConfig) -> np.ndarray:
    """M [T, E] by the online counters, for edges (0 <- 1), (0 <- 2), ..."""
    steps, edges = mask.shape
    online = graph.EMPTY_GRAPH
    factors = np.zeros((steps, edges), dtype=np.float32)
    for t in range(steps):
        sender = 1 + np.flatnonzero(mask[t])
        receiver = np.zeros_like(sender)
        online = graph.update(online, receiver, sender, edges + 1, len(config.removal_filter))
        factors[t, online.sender - 1] = graph.modulation(online.age, online.gone, config)
    return factors


def influence(edges: graph.Graph, node_type: np.ndarray, config: ModelConfig) -> torch.Tensor:
    factors = graph.modulation(edges.age, edges.gone, config)
    return graph.influence(edges, factors, node_type, len(config.types))


def test_an_edge_ramps_up_from_its_first_step_and_then_holds() -> None:
    mask = np.ones((6, 1), dtype=bool)
    assert fold(mask, CONFIG)[:, 0].tolist() == [0.25, 0.5, 0.75, 1.0, 1.0, 1.0]


def test_a_gone_edge_fades_from_the_level_it_had() -> None:
    mask = np.array([[1], [1], [0], [0], [0], [0]], dtype=bool)
    # Two steps: 0.5. Then 0.5 * R = 0.25, 0.05, and nothing.
    np.testing.assert_allclose(fold(mask, CONFIG)[:, 0], [0.25, 0.5, 0.25, 0.05, 0, 0], atol=1e-7)


def test_an_edge_that_comes_back_while_fading_starts_over() -> None:
    mask = np.array([[1], [1], [0], [1], [1]], dtype=bool)
    np.testing.assert_allclose(fold(mask, CONFIG)[:, 0], [0.25, 0.5, 0.25, 0.25, 0.5], atol=1e-7)


def test_by_default_a_gone_edge_counts_no_more() -> None:
    mask = np.array([[1], [1], [0]], dtype=bool)
    assert fold(mask, ModelConfig())[:, 0].tolist() == [0.25, 0.5, 0.0]


@given(
    hnp.arrays(bool, st.tuples(st.integers(1, 24), st.integers(1, 5))),
    st.lists(st.sampled_from([0.0, 0.2, 0.5, 1.0]), max_size=4),
    st.lists(st.sampled_from([0.1, 0.4, 0.9]), max_size=5),
)
def test_counters_online_and_the_scan_in_training_give_the_same_modulation(
    mask: np.ndarray, removal: list[float], addition: list[float]
) -> None:
    config = ModelConfig(addition_filter=(*addition, 1.0), removal_filter=tuple(removal))
    scanned = graph.modulation(*graph.scan_ages(mask), config)
    np.testing.assert_array_equal(fold(mask, config), scanned)


def test_several_edges_of_one_type_sum_and_are_clipped_at_one() -> None:
    config = ModelConfig(types=(NodeType("pedestrian"), NodeType("vehicle")))
    node_type = np.array([0, 0, 0, 1])
    # Node 0 hears two pedestrians at M = 0.25 and 0.5, and a vehicle at M = 1.
    edges = graph.Graph(
        np.array([0, 0, 0]), np.array([1, 2, 3]), np.array([1, 2, 9]), np.array([0, 0, 0])
    )
    assert influence(edges, node_type, config)[0].tolist() == [0.75, 1.0]
    older = edges._replace(age=np.array([3, 3, 9]))
    assert influence(older, node_type, config)[0].tolist() == [1.0, 1.0]
    assert influence(older, node_type, config)[1:].abs().sum() == 0.0


def test_a_fading_edge_still_counts_in_the_sum() -> None:
    edges = graph.Graph(*(np.array([v]) for v in (0, 1, 4, 1)))
    assert influence(edges, np.zeros(2, dtype=np.int64), CONFIG)[0, 0] == 0.5


@pytest.mark.parametrize("far_m", [0.0, 1e6])
def test_edges_are_those_of_all_pairs_within_the_radius_of_their_types(far_m: float) -> None:
    config = ModelConfig(
        types=(NodeType("pedestrian"), NodeType("vehicle")),
        radius_m=1.5,
        radii=(EdgeRadius("pedestrian", "vehicle", 3.0),),
    )
    random = np.random.default_rng(5)
    nodes = 60
    position = random.uniform(0.0, 12.0, (nodes, 2)) + far_m
    present = random.random(nodes) < 0.8
    kind = random.integers(0, 2, nodes)
    scene = np.sort(random.integers(0, 3, nodes))
    radii = graph.radius_table(config)
    receiver, sender = graph.find_edges(position, present, kind, scene, radii)
    expected = [
        (i, j)
        for i in range(nodes)
        for j in range(nodes)
        if i != j
        and present[i]
        and present[j]
        and scene[i] == scene[j]
        and np.hypot(*(position[i] - position[j])) <= radii[kind[i], kind[j]]
    ]
    assert list(zip(receiver, sender, strict=True)) == expected
    assert len(expected) > 20


def test_a_scene_of_none_or_one_has_no_edges() -> None:
    for present in ([False, False], [True, False]):
        found = graph.find_edges(
            np.zeros((2, 2)),
            np.array(present),
            np.zeros(2, dtype=np.int64),
            np.zeros(2, dtype=np.int64),
            np.array([[3.0]]),
        )
        assert [column.size for column in found] == [0, 0]
