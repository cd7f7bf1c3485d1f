# SPDX-License-Identifier: MIT
"""The similarity map between metres and engine lengths.

PhysGen3D (supplement A.4) simulates every scene in a box of side 2, where an object of real size s₀ becomes s' = k s₀.
With time and mass unchanged, every other quantity follows from its dimension:

    length, velocity, acceleration   × k
    Young's modulus, stress          ÷ k     [M L⁻¹ T⁻²]
    density                          ÷ k³    [M L⁻³]

so the same object simulated at any k moves identically in metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

ENGINE_BOX_SIZE = 2.0
"""Side of the engine's domain in engine lengths, as in PhysGen3D."""


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """Similarity map ``x_engine = scale * (x_world - origin)`` with time and mass unchanged.

    scale: engine lengths per metre, k in the paper; > 0.
    origin: world point (metres) that maps to the engine's corner (0, 0, 0).

    Raises InputError when ``scale`` is not a positive finite number.
    """

    scale: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"similarity scale must be a positive number, not {self.scale!r}")

    def length(self, metres: float) -> float:
        """Return a length in engine units; velocities (m/s) and accelerations (m/s²) map the same way."""
        return metres * self.scale

    def modulus(self, pascal: float) -> float:
        """Return a Young's modulus, stress or pressure in engine units."""
        return pascal / self.scale

    def density(self, kg_per_m3: float) -> float:
        """Return a density in engine units."""
        return kg_per_m3 / self.scale**3

    def points_to_engine(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return engine coordinates of world points (..., 3) in metres."""
        return (np.asarray(points, dtype=np.float64) - np.asarray(self.origin)) * self.scale

    def points_to_world(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return world points in metres of engine coordinates (..., 3)."""
        return np.asarray(points, dtype=np.float64) / self.scale + np.asarray(self.origin)
