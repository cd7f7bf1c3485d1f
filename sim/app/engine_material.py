# SPDX-License-Identifier: MIT
"""From a scene's material to the engine's."""

from __future__ import annotations

from typing import Any

from ..mpm.materials import (
    ElasticMaterial,
    FluidMaterial,
    NeoHookeanMaterial,
    RigidMaterial,
    SandMaterial,
    SnowMaterial,
    VonMisesMaterial,
)
from ..scene.model import Material


def engine_material(material: Material) -> ElasticMaterial | RigidMaterial:
    """The engine's class for the material's law, with the numbers that count under it."""
    m = material
    if m.law == "rigid":
        return RigidMaterial(density=m.density)
    if m.law == "fluid":
        return FluidMaterial(density=m.density, bulk_modulus=m.bulk_modulus, viscosity=m.viscosity)
    solid: dict[str, Any] = {
        "density": m.density,
        "youngs_modulus": m.youngs_modulus,
        "poisson_ratio": m.poisson_ratio,
        "damping_time": m.damping_time,
    }
    if m.law == "von_mises":
        return VonMisesMaterial(**solid, yield_stress=m.yield_stress)
    if m.law == "snow":
        return SnowMaterial(
            **solid,
            critical_compression=m.critical_compression,
            critical_stretch=m.critical_stretch,
            hardening=m.hardening,
        )
    if m.law == "sand":
        return SandMaterial(**solid, friction_angle=m.friction_angle)
    elastic = NeoHookeanMaterial if m.law == "neo_hookean" else ElasticMaterial
    return elastic(**solid, fibre_modulus=m.fibre_modulus, fibre_axis=m.fibre_axis)
