# SPDX-License-Identifier: MIT
"""One piece that yields to others: Algorithm 1 of PhyCAGE, and its ablations under the same budget of steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import SimulationError
from ..moving import from_half_axes, half_axes
from ..raster.rasteriser import SplatGradients
from ..splats import LARGEST_SCALE, LEAST_SCALE, Splats
from .matter import Matter
from .objective import Descent
from .options import ComposeOptions
from .rates import Rate

Array = NDArray[np.float64]
STRAIGHT = 0.5
"""Share of ``first_move`` that a step straight down the gradient takes: single points overshoot where matter averages.
With it (half a cell) the ablations did best of 0.5, 1 and 2 cells on two assets of the benchmark."""

Look = Callable[[Splats, int], Descent]
"""Loss and gradients at the splats, in a step counted from 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """Where the piece is after a step, and what was found before it."""

    number: int
    splats: Splats
    descent: Descent | None


class Walk:
    """Steps of one piece: Δμ by the simulator or straight down the gradient, scales and rotations by descent.

    ∇μ L points uphill, so the velocity handed over is -P ∇μ L with P > 0 (Algorithm 1, line 4 leaves the sign open).
    """

    def __init__(self, *, splats: Splats, matter: Matter, options: ComposeOptions) -> None:
        """matter: holds ``splats.centres`` as its points."""
        self.splats = splats
        self._matter = matter
        # Of the last physical step, because they are dear; None once points were placed.
        self._gradients: Array | None = None
        self._options = options
        last, steps = options.last_rate, options.steps
        share = 1.0 if options.method == "pse-sds" else STRAIGHT
        self._move = Rate(first=share * options.first_move * matter.cell, last=last, steps=steps)
        self._stretch = Rate(first=options.first_stretch, last=last, steps=steps)
        self._turn = Rate(first=options.first_turn, last=last, steps=steps)

    def steps(self, look: Look) -> Iterator[Step]:
        """The steps of the options' method, ``look`` asked once in each that looks at pictures.

        Raises SimulationError when the loss or the places stop being numbers; ``splats`` are then those of the last
        good step.
        """
        for number in range(self._options.steps):
            descent = look(self.splats, number) if self._looks(number) else None
            if descent is not None:
                _check(descent.gradients, number)
            splats = self._moved(descent, number)
            if descent is not None:
                splats = self._reshaped(splats, descent.gradients, number)
            self.splats = splats
            yield Step(number=number, splats=splats, descent=descent)

    def _looks(self, number: int) -> bool:
        """PPPS + SDS takes turns, the simulator first."""
        return self._options.sees and not (self._options.method == "ppps+sds" and number % 2 == 0)

    def _straight(self, number: int) -> bool:
        """Whether a step goes straight down the gradient, without the simulator."""
        return self._options.method == "sds" or (self._options.method == "ppps+sds" and self._looks(number))

    def _moved(self, descent: Descent | None, number: int) -> Splats:
        still = np.zeros((len(self.splats), 3))
        down = still if descent is None else self._move.steps_down(descent.gradients.centres, number)
        if self._straight(number):
            self._matter.place(self.splats.centres + down)
            self._gradients = None
            return self.splats.changed(centres=self.splats.centres + down)
        before = self._matter.gradients if self._gradients is None else self._gradients
        self._matter.step(down)
        self._gradients = self._matter.gradients
        part = _sound(self._gradients @ np.linalg.inv(before))
        return from_half_axes(self.splats, self._matter.points, part @ half_axes(self.splats))

    def _reshaped(self, splats: Splats, gradients: SplatGradients, number: int) -> Splats:
        """θ_t: scales along their logarithms, rotations on the sphere of unit quaternions."""
        stretch = self._stretch.steps_down(gradients.scales * splats.scales, number)
        along = gradients.rotations
        along = along - (along * splats.rotations).sum(axis=1, keepdims=True) * splats.rotations
        turn = 0.5 * self._turn.steps_down(0.5 * along, number)
        return splats.changed(
            scales=np.clip(splats.scales * np.exp(stretch), LEAST_SCALE, LARGEST_SCALE),
            rotations=splats.rotations + turn,
        )


def _sound(gradients: Array) -> Array:
    """Deformation gradients (N, 3, 3) with those replaced by none that are no numbers or turn matter inside out."""
    finite = np.isfinite(gradients).all(axis=(1, 2))
    safe = np.where(finite[:, None, None], gradients, np.eye(3))
    good = finite & (np.linalg.det(safe) > 0)
    return np.where(good[:, None, None], safe, np.eye(3))


def _check(gradients: SplatGradients, number: int) -> None:
    for name in ("centres", "scales", "rotations"):
        if not np.isfinite(getattr(gradients, name)).all():
            raise SimulationError(
                f"composition: the gradient of {name} is not a number in step {number + 1}; lower first_move, or leave "
                "the guidance out"
            )
