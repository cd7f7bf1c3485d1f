# SPDX-License-Identifier: MIT
"""What an object is made of. The presets are in ``materials``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .checks import finite, require

LAWS = ("fixed_corotated", "neo_hookean", "von_mises", "snow", "sand", "fluid", "rigid")


@dataclass(frozen=True, kw_only=True)
class Material:
    """What an object is made of.

    preset: name of the preset in ``presets/materials`` that the numbers come from, or "custom".
    density: kg/m³, above 0 and up to 30000.
    youngs_modulus: Pa, 1e2 to 1e12.
    poisson_ratio: 0 to 0.49.
    law: how it responds, one of ``LAWS``: elastic; elastic for large strain; plastic (clay, metal); snow; sand; fluid;
        rigid, of which the density alone counts.
    damping_time: s, 0 to 10; Kelvin–Voigt retardation time viscosity / modulus of solids. A vibration of angular
        frequency w decays at the rate damping_time w² / 2.
    yield_stress: Pa, 1 to 1e12; of ``von_mises``, in tension.
    friction_angle: radians, 0.01 to 1.4; of ``sand``, internal.
    critical_compression, critical_stretch: strains, 1e-4 to 0.5; what ``snow`` bears elastically.
    hardening: 0 to 30; of ``snow``, its moduli grow by exp(hardening (1 - J)) when packed to the volume ratio J.
    bulk_modulus: Pa, 10 to 1e12; of ``fluid``, which has no Young's modulus and Poisson's ratio.
    viscosity: Pa s, 0 to 1e5; of ``fluid``, dynamic.
    fibre_modulus: Pa, 0 (none) to 1e12; of ``fixed_corotated`` and ``neo_hookean``: Young's modulus that fibres add
        along their axis.
    fibre_axis: unit vector of the fibres in the body at rest, world axes.

    Numbers of another law than the material's own are kept and do nothing.
    """

    preset: str = "custom"
    density: float = 1000.0
    youngs_modulus: float = 5e5
    poisson_ratio: float = 0.3
    law: str = "fixed_corotated"
    damping_time: float = 0.0
    yield_stress: float = 1e4
    friction_angle: float = 0.6
    critical_compression: float = 0.025
    critical_stretch: float = 0.0075
    hardening: float = 10.0
    bulk_modulus: float = 2e5
    viscosity: float = 0.0
    fibre_modulus: float = 0.0
    fibre_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        require(self.law in LAWS, "material.law", self.law, f"choose one of {', '.join(LAWS)}")
        for name, low, high, unit in (
            ("damping_time", 0.0, 10.0, "seconds"),
            ("yield_stress", 1.0, 1e12, "pascals"),
            ("friction_angle", 0.01, 1.4, "radians"),
            ("critical_compression", 1e-4, 0.5, "a strain"),
            ("critical_stretch", 1e-4, 0.5, "a strain"),
            ("hardening", 0.0, 30.0, "a number"),
            ("bulk_modulus", 10.0, 1e12, "pascals"),
            ("viscosity", 0.0, 1e5, "Pa s"),
            ("fibre_modulus", 0.0, 1e12, "pascals"),
        ):
            value = getattr(self, name)
            require(
                finite(value) and low <= value <= high,
                f"material.{name}",
                value,
                f"give {unit} from {low:g} to {high:g}",
            )
        require(
            finite(self.density) and 0 < self.density <= 3e4,
            "material.density",
            self.density,
            "give kg/m³ above 0 and up to 30000",
        )
        require(
            finite(self.youngs_modulus) and 1e2 <= self.youngs_modulus <= 1e12,
            "material.youngs_modulus",
            self.youngs_modulus,
            "give pascals between 1e2 and 1e12",
        )
        require(
            finite(self.poisson_ratio) and 0 <= self.poisson_ratio <= 0.49,
            "material.poisson_ratio",
            self.poisson_ratio,
            "give a number from 0 to 0.49",
        )
        require(
            finite(*self.fibre_axis) and abs(math.hypot(*self.fibre_axis) - 1.0) < 1e-3,
            "material.fibre_axis",
            self.fibre_axis,
            "give a unit vector",
        )
