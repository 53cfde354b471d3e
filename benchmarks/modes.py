"""Behaviour modes by latent value: which future each value of z stands for, in real scenes.

Scenes are chosen by a rule that looks at the observed past alone, so no scene is picked for its
picture: of all pairs of walkers faster than 0.5 m/s whose headings differ by at least 60 degrees,
the pair that would pass closest within the horizon if both walked straight on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, sgan_windows
from trajectron_model.evaluation import figures
from trajectron_model.forecast import ForecastRequest, SceneForecast
from trajectron_model.trajectron import Trajectron

Float = NDArray[np.float64]

SAMPLES = 40
RULE = (
    "of all pairs of walkers faster than 0.5 m/s whose headings differ by at least 60 degrees, the "
    "pair that would pass closest within 4.8 s if both walked straight on"
)
_SLOWEST_MPS = 0.5
_LEAST_TURN = math.radians(60.0)
_COLOURS = ("#0077BB", "#EE7733", "#009988", "#CC3311", "#AA4499")
_OTHER, _INK, _FAINT = "#B0B0B0", "#222222", "#8A8A8A"
_PANEL_IN = 3.3
_MARGIN_M = 0.7


@dataclass(frozen=True)
class Scene:
    """A pair of walkers in a window.

    Attributes:
        window: with both among its judged agents.
        pair: their places in the window's order.
    """

    window: Window
    pair: tuple[int, int]


def choose(recordings: Sequence[Recording]) -> Scene | None:
    """The scene that the rule gives; None where no pair of walkers meets it."""
    best: tuple[float, Scene] | None = None
    for recording in recordings:
        for window in sgan_windows(recording):
            found = _closest_pair(window)
            if found is not None and (best is None or found[0] < best[0]):
                best = found[0], Scene(window, found[1])
    return None if best is None else best[1]


def _closest_pair(window: Window) -> tuple[float, tuple[int, int]] | None:
    """The least distance that a pair of the window would pass at, metres; and the pair."""
    history = window.history()  # [A, T, 2]
    dt_s = window.recording.dt_s
    now, velocity = history[:, -1], (history[:, -1] - history[:, -2]) / dt_s  # [A, 2]
    speed = np.hypot(*velocity.T)
    first, second = np.triu_indices(len(now), k=1)
    fast = (speed[first] > _SLOWEST_MPS) & (speed[second] > _SLOWEST_MPS)
    first, second = first[fast], second[fast]
    if not len(first):
        return None
    dot = np.einsum("pi,pi->p", velocity[first], velocity[second])
    turn = np.arccos(np.clip(dot / (speed[first] * speed[second]), -1.0, 1.0))
    offset, closing = now[first] - now[second], velocity[first] - velocity[second]
    square = np.einsum("pi,pi->p", closing, closing)
    when = -np.einsum("pi,pi->p", offset, closing) / np.maximum(square, np.finfo(float).tiny)
    meet = (turn >= _LEAST_TURN) & (when > 0.0) & (when <= window.horizon * dt_s)
    if not meet.any():
        return None
    gap = np.hypot(*(offset + when[:, None] * closing).T)
    at = int(np.where(meet, gap, np.inf).argmin())
    return float(gap[at]), (int(first[at]), int(second[at]))


def draw(scenes: Mapping[str, tuple[Scene, Trajectron]], seed: int = 0) -> str:
    """All scenes as one SVG document, one panel each, with the samples coloured by latent value.

    Args:
        scenes: by title, with the model to forecast each.
        seed: of the samples.
    """
    columns = min(3, max(1, len(scenes)))
    rows = -(-len(scenes) // columns)
    with figures.look():
        figure = figures.blank(columns * _PANEL_IN, rows * (_PANEL_IN + 0.55))
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for one in axes[len(scenes) :]:
            one.remove()
        for one, (title, (scene, model)) in zip(axes, scenes.items(), strict=False):
            _draw_scene(one, scene, _forecast(model, scene.window, seed), title)
    return figures.svg(figure)


def _forecast(model: Trajectron, window: Window, seed: int) -> SceneForecast:
    state = model.initial_state()
    request = ForecastRequest(
        num_samples=SAMPLES,
        horizon=window.horizon,
        seed=seed,
        step=window.now,
        agents=window.ids,
        include_modes=True,
    )
    with torch.inference_mode():
        for frame in window.frames():
            (state,) = model.step([state], [frame])
        (forecast,) = model.forecast([state], [request])
    return forecast


def _draw_scene(axes: Axes, scene: Scene, forecast: SceneForecast, title: str) -> None:
    assert forecast.samples is not None and forecast.sample_modes is not None
    assert forecast.mean is not None
    pair = list(scene.pair)
    share = forecast.mode_probabilities[pair].mean(axis=0)  # [Z]
    likely = np.argsort(-share)[: len(_COLOURS)].tolist()
    colours = dict(zip(likely, _COLOURS, strict=False))
    history, future = scene.window.history(), scene.window.future()  # [A, T, 2], [A, H, 2]
    shown: list[Float] = []
    for agent, path in enumerate(history):
        if agent not in pair:
            axes.plot(*path.T, color=_FAINT, linewidth=0.8, alpha=0.6, zorder=1)
    for agent in pair:
        origin = forecast.position[agent]
        lines = np.concatenate(
            [np.zeros((SAMPLES, 1, 2)), forecast.samples[agent]], axis=1
        )  # [S, 1 + H, 2]
        modes = forecast.sample_modes[agent].tolist()
        axes.add_collection(
            LineCollection(
                list(origin + lines),
                colors=[colours.get(mode, _OTHER) for mode in modes],
                linewidths=0.8,
                alpha=0.5,
                zorder=2,
            )
        )
        for mode, colour in colours.items():
            mean = origin + np.vstack([np.zeros((1, 2)), forecast.mean[agent, mode]])  # [1 + H, 2]
            axes.plot(*mean.T, color=colour, linewidth=2.0, alpha=0.9, zorder=3)
        known = np.vstack([origin, future[agent]])
        axes.plot(*known.T, color=_INK, linewidth=1.2, linestyle=(0, (1, 1.4)), zorder=4)
        axes.plot(*history[agent].T, color=_INK, marker="o", markersize=1.8, linewidth=1.2)
        axes.plot(*origin, color=_INK, marker="o", markersize=5, markerfacecolor="white", zorder=5)
        ends = origin + np.quantile(forecast.samples[agent].reshape(-1, 2), [0.01, 0.99], axis=0)
        shown += [history[agent], known, ends]
    _dress(axes, np.vstack(shown), title)
    handles = [
        Line2D([], [], color=colour, linewidth=2.5, label=f"z = {mode}: {share[mode]:.0%}")
        for mode, colour in colours.items()
    ]
    rest = 1.0 - sum(float(share[mode]) for mode in colours)
    handles.append(Line2D([], [], color=_OTHER, linewidth=2.5, label=f"others: {rest:.0%}"))
    axes.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.1),
        ncols=3,
        frameon=False,
        fontsize=7,
        handlelength=1.2,
        columnspacing=1.0,
    )


def _dress(axes: Axes, points: Float, title: str) -> None:
    """A square of the scene around what is drawn, metres counted from its corner."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = 0.5 * float(np.ptp(points, axis=0).max()) + _MARGIN_M
    low, high = middle - reach, middle + reach
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    step = 2.0 if reach < 6.0 else 5.0
    for axis, start in ((axes.xaxis, low[0]), (axes.yaxis, low[1])):
        ticks = np.arange(0.0, 2.0 * reach, step)
        axis.set_ticks((start + ticks).tolist(), [f"{tick:g}" for tick in ticks])
    axes.tick_params(length=2.5, color=_FAINT, labelsize=7)
    axes.spines[:].set_color("#D0D0D0")
    axes.set_title(f"{title} (metres)", loc="left", fontsize=9)
