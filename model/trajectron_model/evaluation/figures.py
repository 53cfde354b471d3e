"""The figures of a report: small multiples with one colour for each entry throughout.

Everything comes in as plain numbers and goes out as a matplotlib figure; nothing here knows
where a number was measured. Names are drawn literally (no TeX): they may come from uploads.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.container import Container
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]

# Paul Tol's "bright" and "muted" schemes, told apart by colour-blind readers.
_COLOURS = (
    "#CC3311", "#0077BB", "#009988", "#EE7733", "#AA4499", "#999933",
    "#33BBEE", "#882255", "#117733", "#666666", "#DDAA33", "#332288",
)  # fmt: skip
_MARKERS = "osD^vP*XhdpH"
_INK = "#222222"
_FAINT = "#8A8A8A"
_GRID = "#E6E6E6"
_PANEL_IN = (1.75, 2.3)  # width and height of one panel
_MAX_WIDTH_IN = 11.0
_FONTS = "Helvetica Neue, Helvetica, Arial, 'Liberation Sans', 'DejaVu Sans', sans-serif"

Dash = Literal["-", "--", "-."] | tuple[float, tuple[float, ...]]
_DASHES: tuple[Dash, ...] = ("-", "--", "-.", (0, (1, 1.2)))


def look() -> AbstractContextManager[None]:
    """How all figures look. Text stays text: small, searchable, sharp in print.

    The salt makes the same figure the same file.
    """
    return mpl.rc_context(
        {
            "svg.fonttype": "none",
            "svg.hashsalt": "trajectron",
            "text.parse_math": False,
            "font.family": "DejaVu Sans",
            "font.size": 8.0,
            "axes.titlesize": 9.0,
            "axes.labelsize": 8.0,
            "legend.fontsize": 8.0,
            "lines.linewidth": 1.3,
        }
    )


class Style(NamedTuple):
    """How an entry is drawn in every figure of a report."""

    colour: str
    marker: str
    dash: Dash


def styles(names: Iterable[str]) -> dict[str, Style]:
    """A style for each name, in order; past a dozen the colours come again, dashed."""
    found: dict[str, Style] = {}
    for index, name in enumerate(dict.fromkeys(names)):
        turn, at = divmod(index, len(_COLOURS))
        found[name] = Style(_COLOURS[at], _MARKERS[at], _DASHES[turn % len(_DASHES)])
    return found


class Box(NamedTuple):
    """A distribution as a boxplot shows it, all in the unit of the axis.

    The box spans the quartiles, the whiskers the 5% and 95% quantiles, the cross is the mean.
    """

    low: float
    first_quartile: float
    median: float
    third_quartile: float
    high: float
    mean: float


class Curve(NamedTuple):
    """One line of a panel, with its 95% interval where there is one.

    Attributes:
        x: [P] where.
        value: [P] NaN leaves a gap.
        low, high: [P] the interval's ends; equal to ``value`` for none.
    """

    x: ArrayLike
    value: ArrayLike
    low: ArrayLike
    high: ArrayLike


class Point(NamedTuple):
    """An estimate with its 95% interval."""

    value: float
    low: float
    high: float


def boxplots(
    panels: Mapping[str, Mapping[str, Box]],
    lines: Mapping[str, Mapping[str, float]],
    style: Mapping[str, Style],
    label: str,
) -> Figure:
    """Boxes of the entries with a distribution, one panel a set; the others are lines.

    Each panel has an axis of its own: what compares is within a set.

    Args:
        panels: by set, then by entry.
        lines: the means of entries with a single trajectory, by set, then by entry.
        style: of every entry named.
        label: of the vertical axis, with its unit.
    """
    with look():
        boxed = list(dict.fromkeys(name for boxes in panels.values() for name in boxes))
        flat = list(dict.fromkeys(name for found in lines.values() for name in found))
        figure, axes = _panels(
            list(panels), label, width_in=max(1.45, 0.26 * len(boxed) + 0.75), shared=False
        )
        for one, (panel, boxes) in zip(axes, panels.items(), strict=True):
            for name, height in lines.get(panel, {}).items():
                one.axhline(
                    height, color=style[name].colour, linewidth=1.1, linestyle=(0, (4, 2)), zorder=1
                )
            shown = [name for name in boxed if name in boxes]
            _draw_boxes(one, [boxes[name] for name in shown], [style[name] for name in shown])
            one.set_xticks([])
        _from_zero(axes)
        handles = [
            Line2D([], [], color=style[n].colour, marker="s", markersize=7, linestyle="", label=n)
            for n in boxed
        ]
        handles += [
            Line2D([], [], color=style[n].colour, linestyle=(0, (4, 2)), label=n) for n in flat
        ]
        return _with_legend(figure, handles)


def _draw_boxes(axes: Axes, boxes: Sequence[Box], style: Sequence[Style]) -> None:
    if not boxes:
        return
    drawn = axes.bxp(
        [
            {
                "whislo": box.low,
                "q1": box.first_quartile,
                "med": box.median,
                "q3": box.third_quartile,
                "whishi": box.high,
                "mean": box.mean,
            }
            for box in boxes
        ],
        widths=0.66,
        showfliers=False,
        showmeans=True,
        patch_artist=True,
        medianprops={"color": _INK, "linewidth": 1.2},
        meanprops={"marker": "x", "markeredgecolor": _INK, "markersize": 4.5},
        whiskerprops={"color": _FAINT},
        capprops={"color": _FAINT},
    )
    for patch, one in zip(drawn["boxes"], style, strict=True):
        patch.set(facecolor=one.colour, alpha=0.8, edgecolor=_INK, linewidth=0.7)


def points(
    groups: Mapping[str, Mapping[str, Point]], style: Mapping[str, Style], label: str
) -> Figure:
    """Estimates with their intervals: groups (sets) along the axis, entries side by side.

    Args:
        groups: by set, then by entry; a missing entry leaves its place empty.
        style: of every entry named.
        label: of the vertical axis, with its unit.
    """
    with look():
        names = list(dict.fromkeys(name for found in groups.values() for name in found))
        width = min(_MAX_WIDTH_IN, max(4.5, 0.13 * len(names) * len(groups) + 1.6))
        figure = blank(width, 2.9)
        axes = figure.add_subplot()
        _dress(axes)
        step = 0.78 / max(len(names), 1)
        for place, name in enumerate(names):
            here = [(at, found[name]) for at, found in enumerate(groups.values()) if name in found]
            at = [where + (place - (len(names) - 1) / 2) * step for where, _ in here]
            value = np.array([point.value for _, point in here])
            reach = [
                [max(p.value - p.low, 0.0) for _, p in here],
                [max(p.high - p.value, 0.0) for _, p in here],
            ]
            axes.errorbar(
                at,
                value,
                yerr=np.nan_to_num(reach),
                color=style[name].colour,
                marker=style[name].marker,
                markersize=4,
                linestyle="",
                elinewidth=1.0,
                capsize=1.5,
                label=name,
            )
        for edge in range(1, len(groups)):
            axes.axvline(edge - 0.5, color=_GRID, linewidth=0.8)
        axes.set_xticks(range(len(groups)), list(groups))
        axes.set_xlim(-0.5, len(groups) - 0.5)
        axes.set_ylabel(label)
        return _with_legend(figure, _entry_handles(names, style, lines=False))


def curves(
    panels: Mapping[str, Mapping[str, Curve]],
    style: Mapping[str, Style],
    *,
    label: str,
    below: str,
    ticks: Sequence[float] | None = None,
    tick_labels: Sequence[str] | None = None,
    zero: bool = True,
    shared: bool = True,
    references: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """Lines with 95% bands, one panel a set.

    Args:
        panels: by set, then by entry.
        style: of every entry named.
        label: of the vertical axis, with its unit.
        below: of the horizontal axis.
        ticks: of the horizontal axis.
        tick_labels: of these; None for the numbers.
        zero: whether the vertical axis begins at zero.
        shared: whether all panels have the same vertical axis.
        references: heights of thin lines behind the curves, by panel.
    """
    with look():
        names = list(dict.fromkeys(name for found in panels.values() for name in found))
        figure, axes = _panels(list(panels), label, shared=shared)
        for one, (panel, found) in zip(axes, panels.items(), strict=True):
            for height in (references or {}).get(panel, ()):
                one.axhline(height, color=_FAINT, linewidth=0.8, linestyle=(0, (2, 2)), zorder=1)
            for name, curve in found.items():
                _draw_curve(one, curve, style[name], markers=len(np.atleast_1d(curve.x)) <= 6)
            one.set_xlabel(below)
            if ticks is not None:
                one.set_xticks(list(ticks), tick_labels)
        if zero:
            _from_zero(axes)
        return _with_legend(figure, _entry_handles(names, style))


def _draw_curve(axes: Axes, curve: Curve, style: Style, *, markers: bool) -> None:
    x, value, low, high = (np.asarray(column, dtype=np.float64) for column in curve)
    axes.plot(
        x,
        value,
        color=style.colour,
        linestyle=style.dash,
        marker=style.marker if markers else "",
        markersize=3.5,
    )
    if (high > low).any():
        axes.fill_between(x, low, high, color=style.colour, alpha=0.16, linewidth=0.0)


def calibration(
    panels: Mapping[str, Mapping[str, Mapping[float, Point]]], style: Mapping[str, Style]
) -> Figure:
    """Observed coverage over nominal coverage, one panel an entry; the diagonal is perfect.

    Args:
        panels: by entry, then by set, then by nominal level (0 to 1): the share observed.
        style: of every set named.
    """
    with look():
        figure, axes = _panels(list(panels), "observed coverage, %")
        names = list(dict.fromkeys(name for found in panels.values() for name in found))
        levels = sorted({level for found in panels.values() for one in found.values()
                         for level in one})  # fmt: skip
        for one, found in zip(axes, panels.values(), strict=True):
            one.plot([0, 100], [0, 100], color=_FAINT, linewidth=0.8, linestyle=(0, (2, 2)))
            for name, by_level in found.items():
                nominal = sorted(by_level)
                share = np.array([by_level[level] for level in nominal])  # [L, 3]
                _draw_curve(
                    one,
                    Curve(100.0 * np.array(nominal), *(100.0 * share.T)),
                    style[name],
                    markers=True,
                )
            one.set_xlim(100.0 * min(levels, default=0.0) - 8.0, 102.0)
            one.set_ylim(0.0, 102.0)
            one.set_xticks([100.0 * level for level in levels])
            one.tick_params(axis="x", labelsize=7)
            one.set_xlabel("nominal coverage, %")
        return _with_legend(figure, _entry_handles(names, style))


def svg(figure: Figure) -> str:
    """The figure as one SVG document, the same for the same figure; nothing it needs lies outside.

    The preamble and metadata are left out, so that it can stand in a page.
    """
    with look(), warnings.catch_warnings():
        # Whoever shows the figure has the glyphs that are missing here: text stays text.
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        stream = io.StringIO()
        figure.savefig(
            stream, format="svg", bbox_inches="tight", pad_inches=0.04, metadata={"Date": None}
        )
    return _short(stream.getvalue())


def _short(text: str) -> str:
    """The same drawing in a third less: what no reader and no browser needs is left out."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    used = set(re.findall(r"(?:url\(#|href=\"#)([^)\"]+)", text))
    text = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", text)
    # A hundredth of a point is finer than print.
    text = re.sub(r"-?\d+\.\d{3,}", lambda number: f"{float(number[0]):.2f}", text)
    text = re.sub(r"\s+", " ", re.sub(r">\s+<", "><", text))
    text = text.replace("font-family: 'DejaVu Sans'; ", "")
    return text.replace("<svg ", f'<svg style="font-family: {_FONTS}" ', 1)


def blank(width_in: float, height_in: float) -> Figure:
    """An empty figure that `svg` can write."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasSVG(figure)
    return figure


def _panels(
    titles: Sequence[str], label: str, *, width_in: float = _PANEL_IN[0], shared: bool = True
) -> tuple[Figure, list[Axes]]:
    """A row of panels, or rows where they are many."""
    count = max(len(titles), 1)
    columns = max(1, min(count, int(_MAX_WIDTH_IN / width_in)))
    rows = -(-count // columns)
    figure = blank(max(columns * width_in + 0.6, 3.2), rows * _PANEL_IN[1] + 0.5)
    grid = figure.subplots(rows, columns, sharey=shared, squeeze=False)
    axes = list(grid.ravel())
    for one in axes[count:]:
        one.remove()
    for place, (one, title) in enumerate(zip(axes, titles, strict=False)):
        _dress(one)
        one.set_title(title, loc="left")
        if place % columns == 0:
            one.set_ylabel(label)
    return figure, axes[: len(titles)]


def _from_zero(axes: Sequence[Axes]) -> None:
    """The vertical axes begin at zero; done last, since a limit ends the automatic choice."""
    for one in axes:
        one.set_ylim(bottom=0.0)


def _dress(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_FAINT)
    axes.tick_params(color=_FAINT, labelcolor=_INK, length=2.5)
    axes.grid(visible=True, axis="y", color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)


def _entry_handles(
    names: Sequence[str], style: Mapping[str, Style], *, lines: bool = True
) -> list[Line2D]:
    return [
        Line2D(
            [],
            [],
            color=style[name].colour,
            linestyle=style[name].dash if lines else "",
            marker=style[name].marker,
            markersize=4,
            label=name,
        )
        for name in names
    ]


def _with_legend(figure: Figure, handles: Sequence[Line2D | Container]) -> Figure:
    """The legend below all panels, in as many columns as fit."""
    if handles:
        longest = max(len(str(handle.get_label())) for handle in handles)
        columns = max(1, int(figure.get_figwidth() / (0.45 + 0.075 * longest)))
        figure.legend(
            handles=handles,
            loc="outside lower left",
            ncols=min(columns, len(handles)),
            frameon=False,
            handlelength=1.8,
            columnspacing=1.4,
        )
    return figure
