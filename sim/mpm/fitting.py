# SPDX-License-Identifier: MIT
"""Deformation gradients of matter that flows, fitted to where the particles of a neighbourhood have gone. No Taichi.

The engine's F of a plastic particle is the elastic part; the whole deformation is in the positions. With the rest
offsets X_j - X_i of the neighbours j and their displacements u_j - u_i the least squares fit (Falk and Langer 1998) is

    F_i = I + [ sum_j w_j (u_j - u_i)(X_j - X_i)^T ] [ sum_j w_j (X_j - X_i)(X_j - X_i)^T ]^-1

It is exact for affine motion, and the identity at rest. Where a neighbourhood has been torn apart the fit means little,
so its principal stretches are held between ``LEAST`` and ``MOST``.
"""

from __future__ import annotations

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
