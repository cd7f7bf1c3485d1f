# SPDX-License-Identifier: MIT
"""Forces on a body that no other body exerts, per unit of its mass. No Taichi. ``sim/effects`` sets them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class BodyForces:
    """Accelerations of a body of velocity v and angular velocity w at the place x of its centre of mass.

        a = gravity_factor g - drag |v - wind| (v - wind) + lift w x (v - wind) + tether

    The tether pulls with tether_stiffness (d - tether_length) towards its anchor, d the distance to it; a string
    (``tether_string``) only where d is larger than its length. Drag of matter that deforms acts with the matter's local
    velocity, all else on the body as a whole. Raises InputError on a value out of range.
    """

    gravity_factor: float = 1.0
    """Share of gravity that acts, -10 to 10; 1 - fraction of the weight that a medium carries."""

    drag: float = 0.0
    """rho c_d A / (2 m) in 1/m, 0 to 1e4."""

    wind: Vector = (0.0, 0.0, 0.0)
    """Velocity of the air in m/s."""

    lift: float = 0.0
    """Magnus coefficient S / m, no unit, -10 to 10."""

    tether_stiffness: float = 0.0
    """Spring constant over mass in 1/s², 0 to 1e6."""

    tether_length: float = 0.0
    """Length in metres at which the tether does not pull, 0 or more."""

    tether_anchor: Vector = (0.0, 0.0, 0.0)
    """Where the tether is fixed, world metres."""

    tether_string: bool = False
    """Whether the tether only pulls (a string) or also pushes (a spring)."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("gravity_factor", -10.0, 10.0),
            ("drag", 0.0, 1e4),
            ("lift", -10.0, 10.0),
            ("tether_stiffness", 0.0, 1e6),
            ("tether_length", 0.0, 1e6),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise InputError(f"force {name} is {value!r}: give {low:g} to {high:g}")
        for name in ("wind", "tether_anchor"):
            vector = getattr(self, name)
            if len(vector) != 3 or not all(math.isfinite(c) for c in vector):
                raise InputError(f"force {name} is {vector!r}: give three finite numbers")

    def in_cells(self, scale: float, origin: NDArray[np.float64]) -> NDArray[np.float64]:
        """The fields in their order as 12 numbers for the kernels, ``scale`` cells a metre counted from ``origin``."""
        return np.array(
            [
                self.gravity_factor,
                self.drag / scale,
                *(np.asarray(self.wind) * scale),
                self.lift,
                self.tether_stiffness,
                self.tether_length * scale,
                *((np.asarray(self.tether_anchor) - origin) * scale),
                float(self.tether_string),
            ]
        )


NO_FORCES = BodyForces()
