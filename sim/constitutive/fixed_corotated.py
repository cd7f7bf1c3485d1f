# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def"
"""Fixed-corotated elasticity (Stomakhin et al. 2012, "Energetically consistent invertible elasticity").

    psi = mu * sum_i (s_i - 1)^2 + lambda / 2 * (J - 1)^2
    tau = 2 mu (F - R) F^T + lambda J (J - 1) I          (Kirchhoff stress)

With the left stretch V (F = V R, b = F F^T = V^2) the first term is 2 mu (b - V), so no rotation is needed. V follows
from the invariants of b: i1 = tr V is the largest root of (i1^2 - I1)^2 / 4 = I2 + 2 J i1, found by Newton's method
from a series in the deviator of b, or from above (Hoger and Carlson 1984 give V from its invariants). Where that is
ill-conditioned (collapsed or inverted particles, extreme stretch) b is diagonalised instead, and an inverted particle
has its smallest stretch negative, as in the paper. Both branches describe the same energy.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .base import Array, DeformableMaterial, DeviceFunctions, principal_stretches

NEWTON_STEPS = 4
"""Enough for 1e-6 between stretches of 0.5 and 2; where it is not, the last change shows it."""

CLOSE = 3e-4
"""Share of i1 that the first of those steps may change: the second would change 3e-7 of it. They wait for one another,
so that four of them took as long as a third of all that is done for a particle."""

MOST_SERIES = 0.5
"""Largest p = tr Y^2 / 2 at which Newton's method starts from a series in Y."""


@dataclass(frozen=True, kw_only=True)
class ElasticMaterial(DeformableMaterial):
    """Isotropic elastic solid."""

    law: ClassVar[str] = "fixed_corotated"
    rank: ClassVar[int] = 0
    label: ClassVar[str] = "Elastic"
    hint: ClassVar[str] = "Returns to its shape: rubber, jelly, foam, most objects"
    reads: ClassVar[tuple[str, ...]] = (
        *DeformableMaterial.reads,
        "relaxing_share",
        "relaxation_time",
        "fibre_modulus",
        "fibre_axis",
    )

    def elastic_energy(self, volumes: Array, deformation: Array, memories: Array) -> float:
        """Energy in J; see the base class."""
        stretches, volume_ratio = principal_stretches(deformation)
        stretches[:, 2] = np.copysign(stretches[:, 2], volume_ratio)
        density = self.shear_modulus * ((stretches - 1) ** 2).sum(axis=1)
        density = density + 0.5 * self.lame_lambda * (volume_ratio - 1) ** 2
        return float(volumes @ density) + self.fibre_energy(volumes, deformation)

    @staticmethod
    @functools.cache
    def device() -> DeviceFunctions:
        """Stress from the invariants of b."""
        import taichi as ti

        from .tensors import eigen_symmetric, mat3, vec3

        @ti.func
        def newton_step(i1, I1, I2, J):
            q = 0.5 * (i1 * i1 - I1)
            return (q * q - I2 - 2.0 * J * i1) / (2.0 * (q * i1 - J) + 1e-30)

        @ti.func
        def stress(F, C, memory, two_mu, lam, own):
            # A longitudinal wave along the principal direction i of the deformed body travels at
            # c_i^2 = (2 mu s_i^2 + lambda J^2) / rho0; the largest s_i^2 is bounded by I1/3 + 2/3 sqrt(I1^2 - 3 I2).
            J = F.determinant()
            b = F @ F.transpose()
            I1 = b.trace()
            b2 = b @ b
            I2 = 0.5 * (I1 * I1 - b2.trace())
            # b = I1/3 (1 + Y), tr Y^2 = 2 p, det Y = q: the sum of the square roots of 1 + y as a series in p and q, of
            # which the first term alone counts where Y is large; that is above the root.
            mean = I1 * (1.0 / 3.0) + 1e-30
            inverse = 1.0 / mean
            ratio = J * inverse
            p = 3.0 - I2 * inverse * inverse
            q = ratio * ratio * inverse - 1.0 + p
            series = ti.select(p < MOST_SERIES, q * (0.1875 + 0.13671875 * p) - p * (0.25 + 0.078125 * p), 0.0)
            i1 = ti.sqrt(mean) * (3.0 + series)
            change = newton_step(i1, I1, I2, J)
            i1 -= change
            if ti.abs(change) > CLOSE * i1:
                for _ in ti.static(range(NEWTON_STEPS - 1)):
                    change = newton_step(i1, I1, I2, J)
                    i1 -= change
            i2 = 0.5 * (i1 * i1 - I1)
            pairs = i1 * i2 - J  # (s1 + s2)(s2 + s3)(s3 + s1)
            deviator = mat3(0.0)
            if J > 0.0 and pairs > 1e-2 * i1 * i1 * i1 and ti.abs(change) < 1e-3 * i1:
                scale = 1.0 / pairs
                deviator = (1.0 - (i1 * i1 - i2) * scale) * b + scale * b2
                for i in ti.static(range(3)):
                    deviator[i, i] -= i1 * J * scale
            else:
                squares, axes = eigen_symmetric(b)
                stretch = ti.sqrt(ti.max(squares, 0.0))
                if J < 0.0:
                    if stretch[0] <= stretch[1] and stretch[0] <= stretch[2]:
                        stretch[0] = -stretch[0]
                    elif stretch[1] <= stretch[2]:
                        stretch[1] = -stretch[1]
                    else:
                        stretch[2] = -stretch[2]
                for i in ti.static(range(3)):
                    axis = vec3(axes[0, i], axes[1, i], axes[2, i])
                    deviator += (stretch[i] * (stretch[i] - 1.0)) * axis.outer_product(axis)
            tau = two_mu * deviator
            pressure = lam * J * (J - 1.0)
            for i in ti.static(range(3)):
                tau[i, i] += pressure
            largest = I1 * (1.0 / 3.0) + (2.0 / 3.0) * ti.sqrt(ti.max(I1 * I1 - 3.0 * I2, 0.0))
            return tau, two_mu * largest + lam * J * J, 0.0

        return DeviceFunctions(stress=stress)
