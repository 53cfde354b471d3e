"""The bivariate Gaussian over the next displacement that three of the baselines give out.

Alahi et al., "Social LSTM" (CVPR 2016), section 3.1, after Graves, "Generating sequences with
recurrent neural networks" (2013), equations 19 to 25.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

OUTPUTS = 5
"""Numbers that a network gives for one distribution."""

_SCALE_FLOOR_M = 0.02
"""Below it a network would spend itself on the recordings' splines, whose displacements are often
exactly equal: 0.05 m/s at 0.4 s. The papers have no floor."""
_MAX_CORRELATION = 0.99


class BivariateGaussian(NamedTuple):
    """Gaussians over displacements, metres."""

    mean: Tensor  # [..., 2]
    scale: Tensor  # [..., 2] standard deviations
    correlation: Tensor  # [...]

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density of displacements [..., 2]; [...] nats."""
        x, y = ((value - self.mean) / self.scale).unbind(-1)
        rest = 1.0 - self.correlation**2
        squared = (x**2 - 2.0 * self.correlation * x * y + y**2) / rest
        return -0.5 * (squared + rest.log()) - self.scale.log().sum(-1) - math.log(2.0 * math.pi)

    def sample(self, normal: Tensor) -> Tensor:
        """Displacements [..., 2] from standard normal numbers [..., 2]."""
        x, y = normal.unbind(-1)
        y = self.correlation * x + (1.0 - self.correlation**2).sqrt() * y
        return self.mean + self.scale * torch.stack([x, y], dim=-1)


def from_outputs(outputs: Tensor) -> BivariateGaussian:
    """The distributions that a network's outputs [..., 5] stand for."""
    mean, log_scale, raw = outputs[..., :2], outputs[..., 2:4], outputs[..., 4]
    scale = log_scale.clamp(max=3.0).exp() + _SCALE_FLOOR_M
    return BivariateGaussian(mean, scale, _MAX_CORRELATION * raw.tanh())
