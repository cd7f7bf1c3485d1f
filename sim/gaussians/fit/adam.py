# SPDX-License-Identifier: MIT
"""Adam (Kingma and Ba 2015) with a rate for each group of values; state in, state out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .parameters import Groups

BETA_1, BETA_2 = 0.9, 0.999
TINY = 1e-15
"""Kept out of a division by 0. As small as 3D Gaussian Splatting has it: a splat's share of a picture's mean loss, and
with it its gradient, is far below the usual 1e-8."""


@dataclass(frozen=True)
class Descent:
    """Where a descent stands. values, means, squares: by group, the values and the running means of their gradients
    and of the gradients' squares; a group without means has not moved yet. steps: taken so far."""

    values: Groups
    means: Groups = field(default_factory=dict)
    squares: Groups = field(default_factory=dict)
    steps: int = 0

    def stepped(self, gradients: Groups, rates: Mapping[str, float]) -> Descent:
        """One step down ``gradients``. Groups that ``rates`` does not name stay where they are."""
        values, means, squares = dict(self.values), dict(self.means), dict(self.squares)
        steps = self.steps + 1
        for name, rate in rates.items():
            gradient = gradients[name]
            means[name] = BETA_1 * means.get(name, 0.0) + (1 - BETA_1) * gradient
            squares[name] = BETA_2 * squares.get(name, 0.0) + (1 - BETA_2) * gradient * gradient
            mean = means[name] / (1 - BETA_1**steps)
            size = np.sqrt(squares[name] / (1 - BETA_2**steps)) + TINY
            values[name] = values[name] - rate * mean / size
        return Descent(values, means, squares, steps)

    def chosen(self, which: NDArray[np.integer]) -> Descent:
        """The same descent of the splats with these indices; one that is named twice goes on as two."""
        values, means, squares = (
            {name: array[which] for name, array in part.items()} for part in (self.values, self.means, self.squares)
        )
        return Descent(values, means, squares, self.steps)
