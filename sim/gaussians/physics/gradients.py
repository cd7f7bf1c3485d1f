# SPDX-License-Identifier: MIT
"""Deformation gradients of a body since its start, from where its particles have gone. No Taichi.

The engine's F is lost where a step forgets strain, and near a free surface it lags behind, since the velocities of
every step begin without gradients of their own. So the affine motion is fitted to a neighbourhood: with rest places X_j
and displacements u_j of its particles, weighted means X̄ and ū (Falk and Langer 1998),

    F = I + [ Σ w_j (u_j − ū)(X_j − X̄)ᵀ ] [ Σ w_j (X_j − X̄)(X_j − X̄)ᵀ ]⁻¹

The neighbourhood is some two grid cells wide and chosen among particles thinned out to about one a place: a dense skin
would fill it alone, and know nothing of what is across.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

NEIGHBOURS = 20
"""Thinned particles that are fitted to."""

THINNED = 0.7
"""Grid cells of the side of a place that keeps one particle."""

LEAST, MOST = 0.3, 3.0
"""Principal stretches that are reported at most: beyond, matter is torn and the fit says little."""


class BodyGradients:
    """Fits for particles at ``rest`` (M, 3) on a grid of ``cell`` metres."""

    def __init__(self, rest: Array, cell: float) -> None:
        places = np.floor((rest - rest.min(axis=0)) / (THINNED * cell)).astype(np.int64)
        kept = np.sort(np.unique(places, axis=0, return_index=True)[1])
        distance, near = cKDTree(rest[kept]).query(rest, k=min(NEIGHBOURS, len(kept)))
        self._near = kept[near].reshape(len(rest), -1)
        width = np.maximum(distance.reshape(len(rest), -1)[:, -1:], 1e-12)
        weights = 1.0 - 0.9 * (distance.reshape(len(rest), -1) / width) ** 2
        self._weights = weights / weights.sum(axis=1, keepdims=True)
        arms = rest[self._near]
        arms = (arms - np.einsum("mk,mki->mi", self._weights, arms)[:, None]) / width[:, None]
        moment = np.einsum("mk,mki,mkj->mij", self._weights, arms, arms)
        # Neighbours in a plane or line say nothing across it: no change there.
        self._arms = np.einsum("mk,mki,mij->mkj", self._weights, arms, np.linalg.pinv(moment, 1e-3, hermitian=True))
        self._arms /= width[:, None]
        self._rest = rest

    def at(self, positions: Array) -> Array:
        """Gradients (M, 3, 3) that take the rest places to ``positions`` (M, 3)."""
        moved = (positions - self._rest)[self._near]
        # The arms' weighted sum is 0, so the mean displacement drops out.
        fitted = np.einsum("mki,mkj->mij", moved, self._arms) + np.eye(3)
        far = np.flatnonzero(np.abs(fitted - np.eye(3)).max(axis=(1, 2)) > 0.25)
        turned, stretches, axes = np.linalg.svd(fitted[far])
        fitted[far] = (turned * np.clip(stretches, LEAST, MOST)[:, None, :]) @ axes
        return fitted
