# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def"
"""Weakly compressible Newtonian fluid (Cole 1948; Becker and Teschner 2007).

    p = K/7 (J^-7 - 1), never below 0;  tau = -J p + 2 eta J dev D

D is the symmetric part of the velocity gradient. The history variable is ln J; F stays the identity.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .base import FLUID, Array, DeformableMaterial, DeviceFunctions

TAIT = 7.0
"""Exponent of Tait's equation for water."""

LOOSE = 0.02
PACKED = -1.0
"""Limits of ln J as it is integrated: fluid that flies apart forgets how far, so that drops resist when they land.
Beyond LOOSE ln J only follows the density of the grid (``crowding``)."""


@dataclass(frozen=True, kw_only=True)
class FluidMaterial(DeformableMaterial):
    """Weakly compressible Newtonian fluid. Young's modulus and Poisson's ratio do not count."""

    youngs_modulus: float = 1.0
    poisson_ratio: float = 0.0

    bulk_modulus: float
    """Pa, above 0. A hundred times density g depth keeps the compression under 1 %; water's own 2.2e9 costs much."""

    viscosity: float
    """Dynamic viscosity in Pa s, 0 or more; above 0 it costs substeps in proportion."""

    law: ClassVar[str] = "fluid"
    rank: ClassVar[int] = 5
    label: ClassVar[str] = "Fluid"
    hint: ClassVar[str] = "Water, honey"
    cohesion: ClassVar[str] = FLUID
    plastic: ClassVar[bool] = True
    memory_is_log_volume: ClassVar[bool] = True
    reads: ClassVar[tuple[str, ...]] = ("bulk_modulus", "viscosity")

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("bulk_modulus")
        self._in_range("viscosity", 0.0, 1e6, "give Pa s from 0 to 1e6")

    @property
    def wave_speed(self) -> float:
        """Speed of sound in m/s, sqrt(K / rho)."""
        return math.sqrt(self.bulk_modulus / self.density)

    @property
    def diffusivity(self) -> float:
        """Longitudinal kinematic viscosity in m²/s, 4/3 eta / rho."""
        return 4 / 3 * self.viscosity / self.density

    @property
    def shear_number(self) -> float:
        """2 eta in Pa s."""
        return 2 * self.viscosity

    @property
    def bulk_number(self) -> float:
        """The bulk modulus in Pa."""
        return self.bulk_modulus

    def elastic_energy(self, volumes: Array, deformation: Array, memories: Array) -> float:
        """Energy in J; see the base class. psi is the integral of p dJ from J to 1; none in tension."""
        ratio = np.exp(np.minimum(memories, 0.0))
        return float(volumes @ (self.bulk_number / 7 * ((ratio**-6 - 1) / 6 + ratio - 1)))

    @staticmethod
    @functools.cache
    def device() -> DeviceFunctions:
        """Pressure and viscous stress; two_mu is 2 eta, lam the bulk modulus."""
        import taichi as ti

        @ti.func
        def stress(F, C, memory, two_mu, lam, own):
            J = ti.exp(memory)
            pressure = ti.max(lam / TAIT * (ti.exp(-TAIT * memory) - 1.0), 0.0)
            D = 0.5 * (C + C.transpose())
            tau = two_mu * J * D
            for i in ti.static(range(3)):
                tau[i, i] -= J * (pressure + two_mu * C.trace() / 3.0)
            return tau, lam * ti.exp((1.0 - TAIT) * memory), two_mu * (2.0 / 3.0) * J

        @ti.func
        def advance_volume(memory, dt, C):
            return ti.min(ti.max(memory + dt * C.trace(), PACKED), ti.max(memory, LOOSE))

        return DeviceFunctions(stress=stress, advance_volume=advance_volume)
