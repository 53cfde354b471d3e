"""Scores of forecasts whose future has arrived: the `streaming` protocol's, one piece at a time.

Shape letters: A agents, H horizon steps, L levels of `densities.LEVELS`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trajectron_model.evaluation import densities, metrics
from trajectron_model.predictor import PositionMixture

Float = NDArray[np.float64]

NLL_BOUND = 1000.0
"""Nats beyond which a negative log likelihood counts as so many: one impossible step must not
drown all others in a sum that is kept for months."""


class LiveScores(NamedTuple):
    """What A forecasts scored at every step; NaN where the truth is not known.

    Both forms of the point forecast: the mean of the most probable mode, the mean over all.
    """

    distance_mode_m: Float  # [A, H]
    distance_mean_m: Float  # [A, H]
    nll_mixture: Float  # [A, H] nats, of a density over positions in metres
    covered: Float  # [L, A, H] 1 where the truth lies in the region, 0 where not

    def only(self, chosen: NDArray[np.bool_]) -> LiveScores:
        """Those of some agents; ``chosen`` is [A]."""
        return LiveScores(
            self.distance_mode_m[chosen],
            self.distance_mean_m[chosen],
            self.nll_mixture[chosen],
            self.covered[:, chosen],
        )


def score(mixture: PositionMixture, truth: Float, random: np.random.Generator) -> LiveScores:
    """Holds forecasts against what came.

    Args:
        mixture: of A agents, in the truth's frame.
        truth: [A, H, 2] metres; NaN where not known.
        random: of the draws that rank the truth among positions of the mixture.
    """
    rows = np.arange(len(truth))
    best = mixture.mean[rows, mixture.probability.argmax(axis=1)]  # [A, H, 2]
    mean = np.einsum("az,azhi->ahi", mixture.probability, mixture.mean)
    nll = -densities.mixture_log_density(mixture, truth)
    return LiveScores(
        metrics.displacement(best, truth),
        metrics.displacement(mean, truth),
        np.clip(nll, -NLL_BOUND, NLL_BOUND),
        densities.highest_density_regions(mixture, truth, random).covered,
    )
