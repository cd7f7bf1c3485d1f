# SPDX-License-Identifier: MIT
"""Momenta, energies and fitted deformation gradients of a particle state, in float64 on the host. No Taichi.

The engine's F of a plastic particle is the elastic part; the whole deformation is in the positions. With the rest
offsets X_j - X_i of the neighbours j and their displacements u_j - u_i the least-squares fit (Falk and Langer 1998) is

    F_i = I + [ sum_j w_j (u_j - u_i)(X_j - X_i)^T ] [ sum_j w_j (X_j - X_i)(X_j - X_i)^T ]^-1

It is exact for affine motion, and the identity at rest. Where a neighbourhood has been torn apart the fit is poor;
its principal stretches are clamped to ``LEAST`` and ``MOST``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

NEIGHBOURS = 14
"""Particles fitted to: the nearest shells of a cubic lattice are 6, 12 and 8."""

LEAST = 0.1
MOST = 5.0


class FittedGradients:
    """Fits for one body, set up once from its rest ``positions`` (N, 3)."""

    def __init__(self, positions: Array) -> None:
        self._rest = positions
        count = min(NEIGHBOURS, len(positions) - 1)
        distance, index = cKDTree(positions).query(positions, k=count + 1)
        self._index = index[:, 1:]
        self._offsets = positions[self._index] - positions[:, None, :]
        scale = distance[:, -1:] + 1e-300
        self._weights = (1.0 - 0.8 * (distance[:, 1:] / scale) ** 2) / scale**2
        moment = np.einsum("nk,nki,nkj->nij", self._weights, self._offsets, self._offsets)
        # A neighbourhood in a plane or line says nothing across: no change there. (1e-6: moments are of order 1.)
        self._inverse = np.linalg.pinv(moment, rcond=1e-6, hermitian=True)

    def gradients(self, positions: Array) -> Array:
        """Deformation gradients (N, 3, 3) that take the rest positions to ``positions`` (N, 3)."""
        moved = positions - self._rest
        relative = moved[self._index] - moved[:, None, :]
        fitted = np.einsum("nk,nki,nkj->nij", self._weights, relative, self._offsets) @ self._inverse + np.eye(3)
        if not np.isfinite(fitted).all():
            fitted = np.where(np.isfinite(fitted), fitted, 0.0)
        size = np.abs(fitted - np.eye(3)).max(axis=(1, 2))
        far = np.flatnonzero(size > 0.25)
        if len(far):
            u, s, vt = np.linalg.svd(fitted[far])
            fitted[far] = u * np.clip(s, LEAST, MOST)[:, None, :] @ vt
        return fitted


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
