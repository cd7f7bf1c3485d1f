# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def"
"""Neo-Hookean elasticity (Bonet and Wood 1997).

psi = mu/2 (tr b - 3) - mu ln J + lambda/2 (ln J)^2
tau = mu (b - I) + lambda ln J I                     (Kirchhoff stress, b = F F^T)
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import ClassVar

from .base import Array, DeformableMaterial, DeviceFunctions, hencky_strains, principal_stretches


@dataclass(frozen=True, kw_only=True)
class NeoHookeanMaterial(DeformableMaterial):
    """Elastic solid for large strain whose energy grows without bound as it is crushed."""

    law: ClassVar[str] = "neo_hookean"
    rank: ClassVar[int] = 1
    label: ClassVar[str] = "Elastic, Large Strain"
    hint: ClassVar[str] = "For extreme compression or stretching"
    reads: ClassVar[tuple[str, ...]] = (
        *DeformableMaterial.reads,
        "relaxing_share",
        "relaxation_time",
        "fibre_modulus",
        "fibre_axis",
    )

    def elastic_energy(self, volumes: Array, deformation: Array, memories: Array) -> float:
        """Energy in J; see the base class."""
        mu, lam = self.shear_modulus, self.lame_lambda
        stretches, _ = principal_stretches(deformation)
        total = hencky_strains(stretches).sum(axis=1)
        shear = 0.5 * mu * ((stretches**2).sum(axis=1) - 3) - mu * total
        return float(volumes @ (shear + 0.5 * lam * total**2)) + self.fibre_energy(volumes, deformation)

    @staticmethod
    @functools.cache
    def device() -> DeviceFunctions:
        """Stress of b. Along the principal direction i, rho0 c_i^2 = mu (s_i^2 + 1) + lambda (1 - ln J)."""
        import taichi as ti

        from .tensors import LEAST_STRETCH

        @ti.func
        def stress(F, C, memory, two_mu, lam, own):
            mu = 0.5 * two_mu
            log_j = ti.log(ti.max(F.determinant(), LEAST_STRETCH**3))
            b = F @ F.transpose()
            tau = mu * b
            for i in ti.static(range(3)):
                tau[i, i] += lam * log_j - mu
            b2 = b @ b
            I1 = b.trace()
            largest = I1 * (1.0 / 3.0) + ti.sqrt(ti.max((2.0 / 3.0) * (b2.trace() - I1 * I1 * (1.0 / 3.0)), 0.0))
            return tau, mu * (largest + 1.0) + lam * ti.max(1.0 - log_j, 0.0), 0.0

        return DeviceFunctions(stress=stress)
