"""The spread of analytic modes, corrected by what validation data showed.

A rollout on the mixture's mean carries variances that hold only while its increments are
independent, and one Gaussian for each latent value has too light a tail: the modes are too
wide in the middle and too narrow far out. Two numbers for each step mend both, fitted by
``training.calibration``; means and probabilities stay as they are.

Shape letters: N nodes, Z latent values, H horizon steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from trajectron_model.config import Dispersion

_LARGEST_CONTRAST = 20.0
"""A mode is made at most so many times wider or narrower than its agent's modes; as placing.c."""


def disperse(covariance: Tensor, probability: Tensor, dispersion: Sequence[Dispersion]) -> Tensor:
    """Covariances of the modes, each step's scaled as its `Dispersion` says.

    Standard deviations are multiplied by factor x (s / s_mean)^contrast, where s is the fourth
    root of the determinant and log s_mean the mean of log s over the agent's modes: a contrast
    above zero widens the wide modes and narrows the narrow ones.

    Args:
        covariance: [N, Z, H, 3] xx, xy, yy, positive definite.
        probability: [N, Z] p(z|x).
        dispersion: of each step; the last holds beyond; none leaves everything as it is.

    Returns:
        [N, Z, H, 3].
    """
    if not dispersion:
        return covariance
    steps = torch.arange(covariance.shape[2]).clamp_max(len(dispersion) - 1)
    table = covariance.new_tensor(dispersion)[steps]  # [H, 2]
    xx, xy, yy = covariance.unbind(dim=-1)
    log_spread = 0.25 * (xx * yy - xy * xy).log()  # [N, Z, H]
    mean = (probability.unsqueeze(-1) * log_spread).sum(dim=1, keepdim=True)  # [N, 1, H]
    contrast = ((log_spread - mean) * table[:, 1]).exp()
    contrast = contrast.clamp(1.0 / _LARGEST_CONTRAST, _LARGEST_CONTRAST)
    return covariance * (table[:, 0] * contrast).square().unsqueeze(-1)
