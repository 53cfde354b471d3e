"""The dynamic spatiotemporal graph as data: edges by proximity, their ages, their modulation.

An undirected edge joins two observed agents within the radius of their types (paper,
section 4, "Graphical Representation"). It is stored as two directed rows, since each end
receives its own influence.

**Modulation.** M is defined by ages: while an edge is present, A(age); after it has gone,
the level that it had times R(steps since). The paper's equation for training prints a
convolution, M = min(A*E + R*E, 1), which disagrees with the paper's own counters for any
filter that ramps; here training scans the edge mask with the same counters
(``scan_ages``) and so agrees with the online update (``update``) for every pattern.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from trajectron_model.config import ModelConfig

Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]


class Graph(NamedTuple):
    """Directed edges of a scene, present and fading, sorted by (receiver, sender)."""

    receiver: Int64  # [E] node row
    sender: Int64  # [E] node row
    age: Int64  # [E] steps present in this appearance, from 1; frozen once gone
    gone: Int64  # [E] steps since it went; 0 while present


EMPTY_GRAPH = Graph(*(np.empty(0, dtype=np.int64) for _ in Graph._fields))


def radius_table(config: ModelConfig) -> NDArray[np.float64]:
    """The radius of each pair of types, ``[types, types]`` metres, symmetric."""
    names = config.node_types
    return np.array([[config.radius_between_m(a, b) for b in names] for a in names])


def find_edges(
    positions: NDArray[np.float64],
    present: Bool,
    node_type: Int64,
    scene: Int64,
    radii: NDArray[np.float64],
) -> tuple[Int64, Int64]:
    """Directed edges between present nodes of one scene within their types' radius.

    By k-d tree: the cost grows with the nodes and the edges, not with N^2.

    Args:
        positions: [N, 2] metres, finite where present.
        present: [N] observed at this step.
        node_type: [N] type indices.
        scene: [N] index of the scene; nodes of different scenes never meet.
        radii: [types, types] metres.

    Returns:
        receiver [E] and sender [E], sorted by (receiver, sender).
    """
    rows = np.flatnonzero(present)
    if rows.size < 2:
        return EMPTY_GRAPH.receiver, EMPTY_GRAPH.sender
    reach = float(radii.max())
    where = positions[rows]
    if scene[rows[0]] != scene[rows[-1]]:
        # A third coordinate keeps scenes further apart than any radius.
        height = scene[rows].astype(np.float64) * (3.0 * reach)
        where = np.concatenate([where, height[:, None]], axis=1)
    pairs = cKDTree(where).query_pairs(reach, output_type="ndarray")
    first, second = rows[pairs[:, 0]], rows[pairs[:, 1]]
    if radii.size > 1:
        distance = np.linalg.norm(positions[first] - positions[second], axis=1)
        near = distance <= radii[node_type[first], node_type[second]]
        first, second = first[near], second[near]
    receiver = np.concatenate([first, second])
    sender = np.concatenate([second, first])
    order = np.argsort(receiver * positions.shape[0] + sender, kind="stable")
    return receiver[order], sender[order]


def update(graph: Graph, receiver: Int64, sender: Int64, nodes: int, fade_steps: int) -> Graph:
    """One step of the counters: ages of present edges grow, those of gone edges fade.

    Args:
        graph: before the step, over the same node rows.
        receiver, sender: [E'] edges present now, sorted (``find_edges``).
        nodes: number of node rows.
        fade_steps: length of the removal filter; a gone edge is kept that long.
    """
    before = graph.receiver * nodes + graph.sender
    now = receiver * nodes + sender
    at = np.searchsorted(before, now)
    known = np.zeros(now.size, dtype=bool)
    inside = at < before.size
    known[inside] = before[at[inside]] == now[inside]
    age = np.ones(now.size, dtype=np.int64)
    # An edge that comes back while it fades is a new appearance: its age starts at 1.
    lasting = known.copy()
    lasting[known] = graph.gone[at[known]] == 0
    age[lasting] += graph.age[at[lasting]]
    gone = np.zeros(now.size, dtype=np.int64)
    if fade_steps == 0:
        return Graph(receiver, sender, age, gone)
    fading = np.ones(before.size, dtype=bool)
    fading[at[known]] = False
    fading &= graph.gone < fade_steps
    merged = Graph(
        np.concatenate([receiver, graph.receiver[fading]]),
        np.concatenate([sender, graph.sender[fading]]),
        np.concatenate([age, graph.age[fading]]),
        np.concatenate([gone, graph.gone[fading] + 1]),
    )
    order = np.argsort(merged.receiver * nodes + merged.sender, kind="stable")
    return Graph(*(column[order] for column in merged))


def scan_ages(mask: Bool) -> tuple[Int64, Int64]:
    """Ages of edges over a whole history in one scan; the batched form of ``update``.

    Args:
        mask: [T, E] whether each edge is present at each step.

    Returns:
        age [T, E] and gone [T, E]: as in ``Graph``, both 0 before the first appearance.
    """
    age = np.zeros(mask.shape, dtype=np.int64)
    gone = np.zeros(mask.shape, dtype=np.int64)
    last_age = np.zeros(mask.shape[1], dtype=np.int64)
    last_gone = np.zeros(mask.shape[1], dtype=np.int64)
    for t, present in enumerate(mask):
        continues = present & (last_gone == 0)
        last_age = np.where(present, np.where(continues, last_age + 1, 1), last_age)
        last_gone = np.where(present, 0, np.where(last_age > 0, last_gone + 1, 0))
        age[t], gone[t] = last_age, last_gone
    return age, gone


def modulation(age: Int64, gone: Int64, config: ModelConfig) -> NDArray[np.float32]:
    """M of each edge from its counters, in [0, 1], of the arguments' shape.

    While present A(age); after it has gone A(age when it went) R(steps since). Zero where
    the age is zero (an edge that has not been).
    """
    addition = np.array((0.0, *config.addition_filter), dtype=np.float32)
    removal = np.array((1.0, *config.removal_filter, 0.0), dtype=np.float32)
    level = addition[np.minimum(age, addition.size - 1)]
    share = removal[np.minimum(gone, removal.size - 1)]
    factor: NDArray[np.float32] = level * share
    return factor


def influence(graph: Graph, factors: NDArray[np.float32], node_type: Int64, kinds: int) -> Tensor:
    """min(sum of M over neighbours, 1) for each node and edge type (paper, edge modulation).

    Args:
        graph: over the same rows as ``node_type``.
        factors: [E] the modulation of each edge.
        node_type: [N] type indices.
        kinds: K.

    Returns:
        [N, K] float32.
    """
    key = graph.receiver * kinds + node_type[graph.sender]
    total = np.bincount(key, weights=factors, minlength=node_type.size * kinds)
    return torch.from_numpy(np.minimum(total, 1.0).astype(np.float32)).reshape(-1, kinds)
