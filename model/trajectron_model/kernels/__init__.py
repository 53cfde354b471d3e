"""Compiled kernels for inference on a processor, in plain C, and how torch does without them.

Torch is the reference: whatever a kernel computes, a torch function beside it computes too,
and tests compare them. Which of the two is in use is said by `in_use`. ``docs/kernels.md``
tells how to add one.
"""

from __future__ import annotations

from trajectron_model.kernels.loading import Kernels, in_use, kernels, without

__all__ = ["Kernels", "in_use", "kernels", "without"]
