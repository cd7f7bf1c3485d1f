# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def"
"""Ideal plasticity with von Mises' yield criterion (Simo 1992; Simo and Hughes 1998).

e = ln s, tau = 2 mu e + lambda tr e,  sqrt(3/2) |dev tau| <= yield stress: radial return in Hencky strain
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar

from .base import Array, DeformableMaterial, DeviceFunctions, hencky_strains, principal_stretches


@dataclass(frozen=True, kw_only=True)
class VonMisesMaterial(DeformableMaterial):
    """Ideally plastic solid: clay, metal."""

    yield_stress: float
    """Stress in Pa at which a bar in tension begins to flow; above 0."""

    law: ClassVar[str] = "von_mises"
    rank: ClassVar[int] = 2
    label: ClassVar[str] = "Plastic"
    hint: ClassVar[str] = "Deforms permanently above its yield stress: clay, metal"
    plastic: ClassVar[bool] = True
    reads: ClassVar[tuple[str, ...]] = ("youngs_modulus", "poisson_ratio", "yield_stress", "damping_time")

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("yield_stress")

    def own_numbers(self) -> tuple[float, ...]:
        """Norm of the deviatoric Hencky strain at which the material yields."""
        return (math.sqrt(2 / 3) * self.yield_stress / (2 * self.shear_modulus),)

    def elastic_energy(self, volumes: Array, deformation: Array, memories: Array) -> float:
        """Energy in J; see the base class."""
        strains = hencky_strains(principal_stretches(deformation)[0])
        shear = self.shear_modulus * (strains**2).sum(axis=1)
        energy = float(volumes @ (shear + 0.5 * self.lame_lambda * strains.sum(axis=1) ** 2))
        return energy + self.fibre_energy(volumes, deformation)

    @staticmethod
    @functools.cache
    def device() -> DeviceFunctions:
        """Radial return; keeps the volume."""
        import taichi as ti

        @ti.func
        def radial_return(volume, shear, memory, own):
            kept = 1.0
            if shear > own[0]:
                kept = own[0] / shear
            return volume, kept, memory

        return DeviceFunctions(radial_return=radial_return)
