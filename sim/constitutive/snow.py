# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def"
"""Snow (Stomakhin et al. 2013): fixed-corotated elasticity, principal stretches clamped to [1 - theta_c, 1 + theta_s],
moduli times exp(xi (1 - J_P)). The history variable is ln J_P, the ln of the plastic volume ratio."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .base import COHERENT, Array, DeformableMaterial, DeviceFunctions, principal_stretches

PACKED = -0.5
LOOSE = 0.7
"""Limits of ln J_P: beyond a volume ratio of 0.6 to 2 the moduli change no further."""


@dataclass(frozen=True, kw_only=True)
class SnowMaterial(DeformableMaterial):
    """Snow: breaks beyond a small stretch, packs and hardens beyond a small compression."""

    critical_compression: float = 0.025
    """Elastic compression of a principal stretch, theta_c; above 0, below 0.5."""

    critical_stretch: float = 0.0075
    """Elastic extension of a principal stretch, theta_s; above 0, below 0.5."""

    hardening: float = 10.0
    """xi: the moduli grow by exp(xi (1 - J_P)) as the snow is packed to the volume ratio J_P; 0 to 30."""

    law: ClassVar[str] = "snow"
    rank: ClassVar[int] = 3
    label: ClassVar[str] = "Snow"
    hint: ClassVar[str] = "Packs, crumbles and breaks"
    cohesion: ClassVar[str] = COHERENT
    plastic: ClassVar[bool] = True
    memory_is_log_volume: ClassVar[bool] = True
    reads: ClassVar[tuple[str, ...]] = (
        "youngs_modulus",
        "poisson_ratio",
        "critical_compression",
        "critical_stretch",
        "hardening",
        "damping_time",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("critical_compression", "critical_stretch"):
            self._in_range(field, 1e-6, 0.5, "give a strain above 0 and up to 0.5")
        self._in_range("hardening", 0.0, 30.0, "give a number from 0 to 30")

    def own_numbers(self) -> tuple[float, ...]:
        """theta_c, theta_s, xi."""
        return (self.critical_compression, self.critical_stretch, self.hardening)

    def elastic_energy(self, volumes: Array, deformation: Array, memories: Array) -> float:
        """Energy in J; see the base class."""
        stretches, volume_ratio = principal_stretches(deformation)
        stretches[:, 2] = np.copysign(stretches[:, 2], volume_ratio)
        density = self.shear_modulus * ((stretches - 1) ** 2).sum(axis=1)
        density = density + 0.5 * self.lame_lambda * (volume_ratio - 1) ** 2
        density = density * np.exp(self.hardening * (1 - np.exp(memories)))
        return float(volumes @ density) + self.fibre_energy(volumes, deformation)

    @staticmethod
    @functools.cache
    def device() -> DeviceFunctions:
        """Clamped stretches; the clamped part goes into ln J_P."""
        import taichi as ti

        @ti.func
        def return_map(stretch, memory, two_mu, lam, own):
            mapped = ti.min(ti.max(stretch, 1.0 - own[0]), 1.0 + own[1])
            lost = ti.log(stretch[0] * stretch[1] * stretch[2] / (mapped[0] * mapped[1] * mapped[2]))
            remembered = ti.min(ti.max(memory + lost, PACKED), LOOSE)
            harder = ti.exp(own[2] * (1.0 - ti.exp(remembered)))
            J = mapped[0] * mapped[1] * mapped[2]
            principal = harder * (two_mu * (mapped * mapped - mapped) + lam * J * (J - 1.0))
            stiffness = harder * (two_mu * mapped.max() ** 2 + lam * J * J)
            return mapped, remembered, principal, stiffness

        return DeviceFunctions(return_map=return_map)
