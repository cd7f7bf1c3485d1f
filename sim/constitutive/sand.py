# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def"
"""Dry granular material (Klár et al. 2016): Hencky strain, Drucker–Prager cone by a return without dilatancy. Expansion
is remembered and taken back before pressure returns (Tampubolon et al. 2017); the history variable is its ln."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar

from .base import GRANULAR, Array, DeformableMaterial, DeviceFunctions, hencky_strains, principal_stretches


@dataclass(frozen=True, kw_only=True)
class SandMaterial(DeformableMaterial):
    """Dry granular material that holds no tension and flows where shear exceeds friction."""

    friction_angle: float
    """Steepest slope that stands, in radians; above 0, up to 1.4. The Drucker–Prager cone is fitted to plane shear, in
    which a slope fails; a cone fitted to triaxial compression (Klár et al. 2016) would stand some 5 degrees steeper."""

    law: ClassVar[str] = "sand"
    rank: ClassVar[int] = 4
    label: ClassVar[str] = "Sand"
    hint: ClassVar[str] = "Dry grains that flow and pile up"
    cohesion: ClassVar[str] = GRANULAR
    plastic: ClassVar[bool] = True
    memory_is_log_volume: ClassVar[bool] = True
    reads: ClassVar[tuple[str, ...]] = ("youngs_modulus", "poisson_ratio", "friction_angle", "damping_time")
    hidden: ClassVar[tuple[str, ...]] = ("damping_time",)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._in_range("friction_angle", 1e-3, 1.4, "give radians above 0 and up to 1.4")

    def own_numbers(self) -> tuple[float, ...]:
        """Slope of the cone in Hencky strain."""
        # |dev tau| <= -alpha tr tau is shear <= tan(angle) pressure in plane shear with alpha = sqrt(2)/3 tan(angle).
        stiff = (3 * self.lame_lambda + 2 * self.shear_modulus) / (2 * self.shear_modulus)
        return (math.sqrt(2) / 3 * math.tan(self.friction_angle) * stiff,)

    def elastic_energy(self, volumes: Array, deformation: Array, memories: Array) -> float:
        """Energy in J; see the base class."""
        strains = hencky_strains(principal_stretches(deformation)[0])
        shear = self.shear_modulus * (strains**2).sum(axis=1)
        energy = float(volumes @ (shear + 0.5 * self.lame_lambda * strains.sum(axis=1) ** 2))
        return energy + self.fibre_energy(volumes, deformation)

    @staticmethod
    @functools.cache
    def device() -> DeviceFunctions:
        """Return to the cone, or to its tip in tension."""
        import taichi as ti

        @ti.func
        def radial_return(volume, shear, memory, own):
            kept = 1.0
            elastic = volume + memory
            remembered = 0.0
            if elastic >= 0.0:
                remembered, elastic, kept = elastic, 0.0, 0.0
            elif shear + elastic * own[0] > 0.0:
                kept = -elastic * own[0] / shear
            return elastic, kept, remembered

        return DeviceFunctions(radial_return=radial_return)
