"""Weights averaged over the steps of a training.

Gradients of small batches make weights wander about where they are heading; their running mean
stands nearer to it. The mean is of the weights alone: it costs a sum over them at each step, and
the gradient is never taken there.
"""

from __future__ import annotations

import copy

import torch

from trajectron_model.trajectron import Trajectron


class Average:
    """An exponential running mean of a model's weights, without bias towards its beginning.

    After k steps the decay is the smaller of 1 - 1 / steps and k / (k + 1): the plain mean of
    the first weights, until there are more of them than ``steps``.

    Args:
        model: whose weights are averaged.
        steps: about how many of them; 0 or 1 gives the newest weights.
    """

    def __init__(self, model: Trajectron, steps: int) -> None:
        self.steps = steps
        self._source = model
        self._mean = copy.deepcopy(model).requires_grad_(False) if steps > 1 else model

    @property
    def model(self) -> Trajectron:
        """The model to judge and to keep."""
        return self._mean

    @torch.no_grad()
    def update(self, seen: int) -> None:
        """Takes the weights in as they stand, after ``seen`` earlier updates."""
        if self._mean is self._source:
            return
        share = max(1.0 / self.steps, 1.0 / (seen + 1))
        for mean, newest in zip(self._mean.parameters(), self._source.parameters(), strict=True):
            mean.lerp_(newest, share)
