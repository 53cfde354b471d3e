"""Figures that others published, to stand beside ours: muted in every table, never ranked.

Each is ADE and FDE in metres by test set, then their mean as published. The conditions of many
differ from ours; the notes of the tables say how.
"""

from __future__ import annotations

from typing import NamedTuple

SETS = ("eth", "hotel", "univ", "zara1", "zara2")


def place(test_set: str) -> int | None:
    """Where a set stands in every published row; None for a set of one's own."""
    return SETS.index(test_set) if test_set in SETS else None


Pair = tuple[float, float] | None


class Published(NamedTuple):
    """One published row: ADE and FDE by set in the order of `SETS`, and their mean."""

    title: str
    sets: tuple[Pair, Pair, Pair, Pair, Pair]
    mean: Pair


# Ivanovic & Pavone, ICCV 2019, Table 1; the last two: the authors' code and weights, run under
# the same protocol with velocity and acceleration from the past alone (Univ was not run).
TABLE_1 = (
    Published(
        "Trajectron Full, as published (leaking inputs)",
        ((0.37, 0.72), (0.20, 0.35), (0.48, 0.99), (0.32, 0.62), (0.34, 0.66)),
        (0.34, 0.67),
    ),
    Published(
        "Trajectron z_best, as published (leaking inputs)",
        ((0.40, 0.78), (0.19, 0.34), (0.47, 0.98), (0.32, 0.64), (0.33, 0.65)),
        (0.34, 0.68),
    ),
    Published(
        "Social GAN, as published in the same table",
        ((0.64, 1.13), (0.43, 0.91), (0.53, 1.12), (0.29, 0.58), (0.27, 0.56)),
        (0.43, 0.86),
    ),
    Published(
        "the authors' batch model, causal inputs",
        ((0.438, 0.788), (0.244, 0.418), None, (0.343, 0.666), (0.352, 0.692)),
        None,
    ),
    Published(
        "the authors' online model, causal inputs",
        ((0.553, 0.960), (0.346, 0.597), None, (0.478, 0.903), (0.488, 0.936)),
        None,
    ),
)

# Point forecasts of deterministic baselines, as Gupta et al. (CVPR 2018) print them.
POINT = (
    Published(
        "Linear, as published",
        ((1.33, 2.94), (0.39, 0.72), (0.82, 1.59), (0.62, 1.21), (0.77, 1.48)),
        (0.79, 1.59),
    ),
    Published(
        "LSTM, as published",
        ((1.09, 2.41), (0.86, 1.91), (0.61, 1.31), (0.41, 0.88), (0.52, 1.11)),
        (0.70, 1.52),
    ),
    Published(
        "Social LSTM, as published",
        ((1.09, 2.35), (0.79, 1.76), (0.67, 1.40), (0.47, 1.00), (0.56, 1.17)),
        (0.72, 1.54),
    ),
)

# Best of 20 per agent; Trajectron++ judges the windows of the protocol "all".
BEST_OF_20 = (
    Published(
        "Trajectron++, mended, as published",
        ((0.67, 1.18), (0.18, 0.28), (0.30, 0.54), (0.25, 0.41), (0.18, 0.32)),
        (0.32, 0.55),
    ),
    Published(
        "STAR, as published",
        ((0.36, 0.65), (0.17, 0.36), (0.31, 0.62), (0.26, 0.55), (0.22, 0.46)),
        (0.26, 0.53),
    ),
    Published(
        "AgentFormer, mended, as published",
        ((0.45, 0.75), (0.14, 0.22), (0.25, 0.45), (0.18, 0.30), (0.14, 0.24)),
        (0.23, 0.39),
    ),
)

# Best of 20, one sample index for the whole scene (SGAN-20VP-20).
JOINT_20 = (
    Published(
        "Social GAN, as published",
        ((0.87, 1.62), (0.67, 1.37), (0.76, 1.52), (0.35, 0.68), (0.42, 0.84)),
        (0.61, 1.21),
    ),
)

# Ivanovic & Pavone, ICCV 2019, Table 2: seconds for 200 samples on a 2.7 GHz laptop.
TABLE_2 = {
    "Trajectron Full, as published": (0.13, 0.08, 2.00, 0.16, 0.37),
    "Social GAN, as published": (6.98, 6.46, 46.71, 6.47, 9.56),
}
