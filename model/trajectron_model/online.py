"""Packed scenes stepped and forecast online: by kernels where they can, else by torch.

There is one model and one step: the kernel computes what ``Trajectron.step`` does, on the
records of ``packed``; a test streams recordings through both and compares.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from trajectron_model import graph, packed
from trajectron_model.config import ModelConfig
from trajectron_model.forecast import ForecastRequest, SceneForecast, forecast_rows
from trajectron_model.kernels import stepping
from trajectron_model.kernels.loading import Kernels
from trajectron_model.kernels.packing import PackedWeights, library_for
from trajectron_model.packed import Layout, PackedScene, pack, unpack, without
from trajectron_model.state import SceneFrame, SceneState
from trajectron_model.trajectron import Trajectron


@torch.inference_mode()
def step(
    model: Trajectron, scenes: Sequence[PackedScene], frames: Sequence[SceneFrame]
) -> list[PackedScene]:
    """Folds one frame into each scene; see ``Trajectron.step``, which raises what this does.

    Raises:
        ValueError: an agent type that the model does not know, an id twice in a frame, a
            position that is not finite.
    """
    if not scenes:
        return []
    first = model.node_model(0).history.node.weight_ih
    library = library_for(first) if model.config.features == "heading" else None
    if library is None:
        layout = Layout.of(model.config)
        stepped = model.step([state_of(model, scene) for scene in scenes], frames)
        return [pack(state, layout) for state in stepped]
    weights = _WEIGHTS.of(model, library)
    admitted = [
        _admit(scene, frame, model.config, weights.layout)
        for scene, frame in zip(scenes, frames, strict=True)
    ]
    rows = stepping.SceneRows(
        nodes=[scene.nodes for scene, _ in admitted],
        edges=[scene.edges for scene, _ in admitted],
        observed=[observed for _, observed in admitted],
        positions=[frame.positions for frame in frames],
        times_s=[frame.time_s for frame in frames],
        layout=weights.layout,
    )
    after = stepping.step(library, weights, rows)
    return [
        PackedScene(scene.ids, nodes, edges, frame.time_s)
        for (scene, _), frame, (nodes, edges) in zip(admitted, frames, after, strict=True)
    ]


def state_of(model: Trajectron, scene: PackedScene) -> SceneState:
    """The scene as tensors, where the model's weights are."""
    return unpack(scene, model.config, model.device)


def forecast(
    model: Trajectron, scenes: Sequence[PackedScene], requests: Sequence[ForecastRequest]
) -> list[SceneForecast]:
    """``Trajectron.forecast`` of packed scenes."""
    return forecast_rows(model, packed.rows_of(scenes, model.config, model.device), requests)


def _admit(
    scene: PackedScene, frame: SceneFrame, config: ModelConfig, layout: Layout
) -> tuple[PackedScene, Sequence[int]]:
    """The scene with a record for each agent of the frame, and the frame's rows in it.

    As ``state.admit``: an agent that comes back under another type starts anew.
    """
    if len(config.types) == 1:
        only = config.types[0].name
        types = [0 if name == only else config.type_index(name) for name in frame.types]
    else:
        types = [config.type_index(name) for name in frame.types]
        held = dict(zip(scene.ids, scene.types(layout), strict=True))
        wanted = zip(frame.ids, types, strict=True)
        changed = frozenset(name for name, kind in wanted if held.get(name, kind) != kind)
        scene = without(scene, changed, config) if changed else scene
    if frame.ids == scene.ids:
        return scene, range(len(frame.ids))
    row_of = {name: row for row, name in enumerate(scene.ids)}
    new: list[bytes] = []
    for name, kind in zip(frame.ids, types, strict=True):
        if name not in row_of:
            row_of[name] = len(row_of)
            new.append(layout.blank(kind))
    if new:
        nodes = b"".join((scene.nodes, *new))
        scene = PackedScene(tuple(row_of), nodes, scene.edges, scene.time_s)
    return scene, [row_of[name] for name in frame.ids]


def _encoder_weights(model: Trajectron) -> tuple[Tensor, ...]:
    cells = [
        cell
        for kind in range(len(model.nodes))
        for cell in (model.node_model(kind).history.node, *model.node_model(kind).history.edges)
    ]
    return tuple(w for c in cells for w in (c.weight_ih, c.weight_hh, c.bias_ih, c.bias_hh))


def _pack_weights(model: Trajectron, _library: Kernels) -> stepping.StepWeights:
    encoders = [model.node_model(kind).history for kind in range(len(model.nodes))]
    return stepping.pack_weights(model.config, encoders, graph.radius_table(model.config))


_WEIGHTS = PackedWeights(_encoder_weights, _pack_weights)
