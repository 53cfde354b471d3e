"""Draws a scene and its forecast: where agents came from, and where they may go.

Draws into a file, never to a screen. Shape letters: A agents, T steps of history, Z latent
values, H horizon steps, S samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from trajectron_service.messages import AgentForecast, Forecast

Positions = NDArray[np.float64]

# Latent values with a colour of their own, the most probable ones; the others are grey.
_COLOURS = ("#0077BB", "#EE7733", "#009988", "#CC3311", "#AA4499", "#DDAA33")
_OTHER = "#8A8A8A"
_INK = "#222222"
_TRUTH = "#000000"

_SAMPLES_IN_ALL = 240  # shared by the agents, each of which has at least
_FEWEST_SAMPLES = 8  # and at most
_MOST_SAMPLES = 40
_FEW_AGENTS = 6  # whose second mode is shown as well
_MANY_AGENTS = 12  # beyond, ellipses only at the end and not halfway
_NAMED_AGENTS = 60  # beyond, names would cover the scene
_MARGIN_M = 0.8
_LONG_SIDE_IN = 9.0
_SHORT_SIDE_IN = 5.0
_DPI = 150


def draw(
    path: Path,
    forecast: Forecast,
    histories: Mapping[str, Positions],
    *,
    futures: Mapping[str, Positions] | None = None,
    title: str = "",
) -> None:
    """Draws a forecast to a file, whose suffix says the format.

    Args:
        path: where to, such as ``out.png`` or ``out.svg``.
        forecast: with samples, or modes, or both.
        histories: [T, 2] metres by agent id, oldest first.
        futures: [<= H, 2] metres by agent id: what came, where it is known.
        title: above the picture.

    Raises:
        OSError: the file cannot be written.
        ValueError: the suffix is no format of matplotlib's.
    """
    ids = {agent.id for agent in forecast.agents}
    histories = {name: path for name, path in histories.items() if name in ids}
    futures = {name: path for name, path in (futures or {}).items() if name in ids}
    detail = _Detail.of(len(ids))
    low, high = _extent(forecast, detail, [*histories.values(), *futures.values()])
    width, height = _size(high - low)
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    colours = _colours(forecast.agents)
    for agent in forecast.agents:
        _draw_samples(axes, agent, colours, detail)
        _draw_modes(axes, agent, colours, detail)
    for agent in forecast.agents:
        away = agent.last_observed_time < forecast.reference_time
        _draw_past(axes, agent, histories.get(agent.id), named=detail.names, away=away)
        if agent.id in futures:
            known = np.vstack([_position(agent), futures[agent.id]])
            axes.plot(*known.T, color=_TRUTH, linewidth=1.1, linestyle=(0, (1, 1.6)), zorder=6)
    _dress(axes, low, high, title)
    axes.legend(
        handles=_legend(forecast, colours, detail, known=bool(futures)),
        loc="upper left",
        bbox_to_anchor=(1.01, 1.0),
        borderaxespad=0.0,
        frameon=False,
        fontsize=9,
    )
    figure.savefig(path, dpi=_DPI, bbox_inches="tight")


class _Detail(NamedTuple):
    """How much is drawn of each agent, so that a crowd stays readable."""

    samples: int
    modes: int
    ellipses: int
    names: bool

    @classmethod
    def of(cls, agents: int) -> _Detail:
        share = _SAMPLES_IN_ALL // max(agents, 1)
        samples = min(max(share, _FEWEST_SAMPLES), _MOST_SAMPLES)
        return cls(
            samples,
            modes=2 if agents <= _FEW_AGENTS else 1,
            ellipses=2 if agents <= _MANY_AGENTS else 1,
            names=agents <= _NAMED_AGENTS,
        )


def _position(agent: AgentForecast) -> Positions:
    return np.array([agent.x, agent.y])


def _colours(agents: Sequence[AgentForecast]) -> dict[int, str]:
    """A colour for each of the latent values that are the most probable over all agents."""
    if not agents:
        return {}
    share = np.mean([agent.mode_probabilities for agent in agents], axis=0)  # [Z]
    best = np.argsort(-share)[: len(_COLOURS)].tolist()
    return dict(zip(best, _COLOURS, strict=False))


def _draw_samples(
    axes: Axes, agent: AgentForecast, colours: Mapping[int, str], detail: _Detail
) -> None:
    """Sampled futures in the colour of the latent value that each came from."""
    if agent.samples is None or agent.sample_modes is None:
        return
    shown = agent.samples[: detail.samples]  # [S, H, 2] offsets
    start = np.zeros((len(shown), 1, 2))
    lines = _position(agent) + np.concatenate([start, shown], axis=1)  # [S, 1 + H, 2]
    modes = agent.sample_modes[: len(shown)].tolist()
    colour = [colours.get(mode, _OTHER) for mode in modes]
    order = [mode in colours for mode in modes]
    back, front = [n for n, c in enumerate(order) if not c], [n for n, c in enumerate(order) if c]
    for chosen, alpha, zorder in ((back, 0.28, 2), (front, 0.55, 3)):
        axes.add_collection(
            LineCollection(
                list(lines[chosen]),
                colors=[colour[n] for n in chosen],
                linewidths=0.9,
                alpha=alpha,
                zorder=zorder,
                capstyle="round",
            )
        )


def _draw_modes(
    axes: Axes, agent: AgentForecast, colours: Mapping[int, str], detail: _Detail
) -> None:
    """Means of an agent's most probable modes, with ellipses at a few steps."""
    if agent.mean is None or agent.covariance is None:
        return
    likely = agent.mode_probabilities.max()
    horizon = agent.mean.shape[1]
    every = horizon / detail.ellipses
    steps = np.unique(np.linspace(every, horizon, detail.ellipses).round().astype(int))
    steps = steps[steps > 0]
    for mode in np.argsort(-agent.mode_probabilities)[: detail.modes].tolist():
        colour = colours.get(mode, _OTHER)
        weight = float(agent.mode_probabilities[mode] / likely)
        path = _position(agent) + np.vstack([np.zeros((1, 2)), agent.mean[mode]])  # [1 + H, 2]
        axes.plot(*path.T, color=colour, linewidth=1.8, alpha=0.35 + 0.6 * weight, zorder=4)
        centres, covariance = path[steps], agent.covariance[mode, steps - 1]
        shade = 0.4 + 0.6 * weight
        _draw_ellipses(axes, centres, covariance, 1.0, facecolors=colour, alpha=0.13 * shade)
        _draw_ellipses(axes, centres, covariance, 1.0, edgecolors=colour, alpha=0.8 * shade)
        _draw_ellipses(axes, centres, covariance, 2.0, edgecolors=colour, alpha=0.4 * shade)


def _draw_ellipses(
    axes: Axes,
    centres: Positions,
    covariance: NDArray[np.float32],
    sigma: float,
    *,
    facecolors: str = "none",
    edgecolors: str = "none",
    alpha: float,
) -> None:
    """Ellipses of ``sigma`` standard deviations; ``covariance`` [N, 3] is xx, xy, yy."""
    matrices = covariance[:, [0, 1, 1, 2]].astype(np.float64).reshape(-1, 2, 2)  # [N, 2, 2]
    variances, vectors = np.linalg.eigh(matrices)  # ascending
    diameters = 2.0 * sigma * np.sqrt(np.maximum(variances, 0.0))  # [N, 2]
    axes.add_collection(
        EllipseCollection(
            diameters[:, 1],
            diameters[:, 0],
            np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])),
            units="xy",
            offsets=centres,
            offset_transform=axes.transData,
            facecolors=facecolors,
            edgecolors=edgecolors,
            linewidths=0.7,
            alpha=alpha,
            zorder=1,
        )
    )


def _draw_past(
    axes: Axes, agent: AgentForecast, history: Positions | None, *, named: bool, away: bool
) -> None:
    """Where an agent came from, and where it stands."""
    if history is not None and len(history):
        axes.plot(*history.T, color=_INK, linewidth=1.3, alpha=0.75, zorder=5)
        axes.plot(*history.T, color=_INK, marker="o", markersize=1.8, linestyle="", zorder=5)
    axes.plot(
        agent.x,
        agent.y,
        marker="o",
        markersize=6.5,
        markerfacecolor="white",
        markeredgecolor=_OTHER if away else _INK,
        markeredgewidth=1.3,
        zorder=7,
    )
    if named:
        axes.annotate(
            agent.id,
            (agent.x, agent.y),
            xytext=(5, 5),
            textcoords="offset points",
            fontsize=8,
            color=_INK,
            bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "alpha": 0.7, "linewidth": 0},
            zorder=8,
        )


def _dress(axes: Axes, low: Positions, high: Positions, title: str) -> None:
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("x, metres")
    axes.set_ylabel("y, metres")
    axes.set_title(title, loc="left", fontsize=11)
    axes.grid(visible=True, color="#E4E4E4", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _extent(
    forecast: Forecast, detail: _Detail, known: Sequence[Positions]
) -> tuple[Positions, Positions]:
    """The corners of what is drawn, a few stray samples left out."""
    points = list(known)
    for agent in forecast.agents:
        points.append(_position(agent)[None])
        if agent.mean is not None:
            likely = np.argsort(-agent.mode_probabilities)[: detail.modes]
            points.append(_position(agent) + agent.mean[likely].reshape(-1, 2))
        if agent.samples is not None:
            ends = agent.samples[: detail.samples, -1]  # [S, 2]
            points.append(_position(agent) + np.quantile(ends, [0.05, 0.95], axis=0))
    everything = np.vstack(points) if points else np.zeros((1, 2))
    return everything.min(axis=0) - _MARGIN_M, everything.max(axis=0) + _MARGIN_M


def _size(span: Positions) -> tuple[float, float]:
    """Inches of a picture of this many metres, in the scene's own proportions."""
    scale = _LONG_SIDE_IN / span.max()
    width, height = np.maximum(span * scale, _SHORT_SIDE_IN).tolist()
    return width, height


def _legend(
    forecast: Forecast, colours: Mapping[int, str], detail: _Detail, *, known: bool
) -> list[Line2D | Patch]:
    agents = forecast.agents
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=_INK, marker="o", markersize=2.5, linewidth=1.3, label="history"),
        _marker(_INK, "in sight"),
    ]
    if any(agent.last_observed_time < forecast.reference_time for agent in agents):
        handles.append(_marker(_OTHER, "out of sight"))
    if known:
        handles.append(
            Line2D([], [], color=_TRUTH, linewidth=1.1, linestyle=(0, (1, 1.6)), label="what came")
        )
    if not agents:
        return handles
    share = np.mean([agent.mode_probabilities for agent in agents], axis=0)
    handles += [
        Line2D([], [], color=colour, linewidth=2.5, label=f"z = {mode}   {share[mode]:.0%}")
        for mode, colour in colours.items()
    ]
    if len(colours) < len(share):
        rest = 1.0 - sum(share[mode] for mode in colours)
        handles.append(Line2D([], [], color=_OTHER, linewidth=2.5, label=f"other z   {rest:.0%}"))
    if agents[0].covariance is not None:
        which = "likeliest mode" if detail.modes == 1 else f"{detail.modes} likeliest modes"
        label = f"1 and 2 sigma of\neach agent's {which}"
        handles.append(Patch(facecolor="#0077BB33", edgecolor="#0077BB99", label=label))
    return handles


def _marker(colour: str, label: str) -> Line2D:
    return Line2D(
        [],
        [],
        linestyle="",
        marker="o",
        markersize=6.5,
        markerfacecolor="white",
        markeredgecolor=colour,
        label=label,
    )
