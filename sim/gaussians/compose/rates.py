# SPDX-License-Identifier: MIT
"""From gradients to steps: factors chosen once, at the first step, and kept.

A gradient of the loss is in 1/m, 1 per logarithm of a scale, 1/rad: what makes a move of it depends on the picture's
size, the number of splats and what they show. So each kind gets one factor such that its fastest hundredth makes a step
of known size at first; the directions and all ratios stay the gradient's own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAST = 0.99
"""Of the points that the picture moves at all, the share that is slower than the ones that set the factor."""

CAP = 4.0
"""Times the first step that no step is longer than: single splats may have enormous gradients."""


class Rate:
    """Steps down ``gradients`` whose first is about ``first`` long; ``last`` of it are left at the last step."""

    def __init__(self, *, first: float, last: float, steps: int) -> None:
        """first: length of the first step in the parameter's own unit, 0 holds it."""
        self._first, self._last, self._steps = first, last, steps
        self._factor: float | None = None

    def steps_down(self, gradients: Array, step: int) -> Array:
        """The step (N, D) down ``gradients`` (N, D) in step ``step``, from 0: -factor · gradient, of bounded length."""
        length = np.linalg.norm(gradients, axis=1)
        if self._factor is None:
            moved = length[length > 0]
            if len(moved) == 0 or self._first == 0:
                return np.zeros_like(gradients)
            self._factor = self._first / float(np.quantile(moved, FAST))
        share = step / max(self._steps - 1, 1)
        factor = self._factor * self._last**share
        most = CAP * self._first * self._last**share
        return np.asarray(-gradients * np.minimum(factor, most / np.maximum(length, 1e-300))[:, None])
