# SPDX-License-Identifier: MIT
"""Conserved quantities of a particle state, in float64 on the host. Any consistent units; no Taichi."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .materials import FIXED_COROTATED, FLUID, NEO_HOOKEAN, SNOW, ElasticMaterial, SnowMaterial

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Energy:
    """Energies in joules."""

    kinetic: float
    """Of translation and of the affine velocity that each particle carries."""

    elastic: float
    """Stored in deformation."""

    potential: float
    """In the field of gravity, -sum m g . x, with zero at the world's origin."""

    @property
    def total(self) -> float:
        """Sum of the three."""
        return self.kinetic + self.elastic + self.potential


def linear_momentum(masses: Array, velocities: Array) -> Array:
    """Sum of m v, (3,)."""
    return masses @ velocities


def angular_momentum(
    masses: Array, positions: Array, velocities: Array, affine: Array, cell_size: float, about: Array
) -> Array:
    """Angular momentum (3,) about the point ``about``, with the part in the affine velocities ``affine`` (N, 3, 3).

    A particle spreads its mass over nodes whose second moment about it is dx²/4 on each axis (quadratic B-splines),
    so a velocity v + C r has the angular momentum m dx²/4 (C32 - C23, C13 - C31, C21 - C12) besides m x × v
    (Jiang et al. 2015, section 5.3.3; exact in APIC's transfers).
    """
    orbital = masses @ np.cross(positions - about, velocities)
    axial = np.stack(
        [
            affine[:, 2, 1] - affine[:, 1, 2],
            affine[:, 0, 2] - affine[:, 2, 0],
            affine[:, 1, 0] - affine[:, 0, 1],
        ],
        axis=1,
    )
    return np.asarray(orbital + masses @ axial * (cell_size**2 / 4))


def kinetic_energy(masses: Array, velocities: Array, affine: Array, cell_size: float) -> float:
    """Sum of m/2 (v² + dx²/4 C:C)."""
    squares = (velocities**2).sum(axis=1) + cell_size**2 / 4 * (affine**2).sum(axis=(1, 2))
    return float(0.5 * masses @ squares)


def elastic_energy(material: ElasticMaterial, volumes: Array, deformation: Array, memories: Array) -> float:
    """Sum of V0 psi over particles with elastic ``deformation`` (N, 3, 3), in J; the laws are in ``laws``."""
    mu, lam = material.shear_modulus, material.lame_lambda
    if material.law == FLUID:
        # psi = integral of p dJ from J to 1 with p = K/7 (J^-7 - 1); none in tension.
        ratio = np.exp(np.minimum(memories, 0.0))
        return float(volumes @ (material.bulk_number / 7 * ((ratio**-6 - 1) / 6 + ratio - 1)))
    fibres = 0.0
    if material.fibre_modulus > 0:
        along = np.linalg.norm(deformation @ np.asarray(material.fibre_axis), axis=1)
        fibres = float(volumes @ (0.5 * material.fibre_modulus * (along - 1) ** 2))
    stretches = np.linalg.svd(deformation, compute_uv=False)
    volume_ratio = np.linalg.det(deformation)
    if material.law in (FIXED_COROTATED, SNOW):
        stretches[:, 2] = np.copysign(stretches[:, 2], volume_ratio)
        density = mu * ((stretches - 1) ** 2).sum(axis=1) + 0.5 * lam * (volume_ratio - 1) ** 2
        if isinstance(material, SnowMaterial):
            density = density * np.exp(material.hardening * (1 - np.exp(memories)))
        return float(volumes @ density) + fibres
    strains = np.log(np.maximum(stretches, 1e-3))
    total = strains.sum(axis=1)
    if material.law == NEO_HOOKEAN:
        shear = 0.5 * mu * ((stretches**2).sum(axis=1) - 3) - mu * total
    else:
        shear = mu * (strains**2).sum(axis=1)
    return float(volumes @ (shear + 0.5 * lam * total**2)) + fibres
