# SPDX-License-Identifier: MIT
"""How the motion of few points moves a body: harmonic extension over its surface, gradients fitted around particles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

PATCHES = 12
"""Patches of the point set along the longest side of the object."""

NEAR_POINTS = 8
"""Points that a particle near the surface follows, weighted by 1/distance³."""


class HarmonicExtension:
    """Extends values at surface points (N, 3) to filling particles (M, 3), both at rest.

    A filling particle has no loss of its own. Its motion should vary least between the points around it: the harmonic
    extension, which for a sphere is Poisson's integral, the mean over the surface with weights 1/distance³. It is exact
    for all fields linear in space, so a translation, rotation or stretch of the surface is one of the whole body. The
    same weights are used for other shapes. Points nearer than a patch are summed one by one.
    """

    def __init__(self, points: Array, fill: Array) -> None:
        side = float(np.ptp(points, axis=0).max()) / PATCHES
        places, patch = np.unique(np.floor((points - points.min(axis=0)) / side), axis=0, return_inverse=True)
        self._shape = (len(fill), len(points))
        count = np.bincount(patch.ravel())
        self._patches = csr_matrix((1.0 / count[patch.ravel()], (patch.ravel(), np.arange(len(points)))))
        if len(fill) == 0:
            return
        distance, nearest = cKDTree(points).query(fill, k=min(NEAR_POINTS, len(points)))
        weights = 1.0 / np.maximum(distance, 1e-6 * side) ** 3
        # Weight of the far patches against the nearest points.
        far = np.clip(distance[:, :1] / side - 0.5, 0.0, 1.0)
        weights *= (1.0 - far) / weights.sum(axis=1, keepdims=True)
        rows = np.repeat(np.arange(len(fill)), weights.shape[1])
        self._near = csr_matrix((weights.ravel(), (rows, nearest.ravel())), shape=self._shape)
        middles = self._patches @ points
        # Patches cut by a voxel's edge are smaller; weight them by their points, as the surface is evenly sampled.
        kernel = np.empty((len(fill), len(places)), dtype=np.float32)
        for start in range(0, len(fill), 4096):
            some = slice(start, start + 4096)
            gap = np.linalg.norm(fill[some, None] - middles[None], axis=2)
            part = count / np.maximum(gap, 0.5 * side) ** 3
            kernel[some] = far[some] * part / part.sum(axis=1, keepdims=True)
        self._far = kernel

    def __call__(self, values: Array) -> Array:
        """Return values (M, K) of the filling particles, given those (N, K) of the points."""
        if self._shape[0] == 0:
            return np.zeros((0, values.shape[1]))
        around = self._far @ (self._patches @ values).astype(np.float32)
        return np.asarray(self._near @ values + around)


FIT_NEIGHBOURS = 20
"""Thinned particles in the neighbourhood of a fit."""

FIT_SPACING = 0.7
"""Side, in grid cells, of a voxel that keeps one particle."""

MIN_FITTED_STRETCH, MAX_FITTED_STRETCH = 0.3, 3.0
"""Range of reported principal stretches: beyond, the material is torn and the fit is meaningless."""


class DeformationFit:
    """Deformation gradients of particles at ``rest`` (M, 3), on a grid of ``cell`` metres, from their positions.

    The engine's F is lost where a step discards strain, and near a free surface it lags behind, since the velocities of
    every step begin without gradients of their own. So the affine motion is fitted to a neighbourhood: with rest
    positions X_j and displacements u_j of its particles, weighted means X̄ and ū (Falk and Langer 1998),

        F = I + [ Σ w_j (u_j − ū)(X_j − X̄)ᵀ ] [ Σ w_j (X_j − X̄)(X_j − X̄)ᵀ ]⁻¹

    The neighbourhood is about two grid cells wide and chosen among particles thinned to about one a voxel: a dense skin
    would fill it alone, without any particle across.
    """

    def __init__(self, rest: Array, cell: float) -> None:
        places = np.floor((rest - rest.min(axis=0)) / (FIT_SPACING * cell)).astype(np.int64)
        kept = np.sort(np.unique(places, axis=0, return_index=True)[1])
        distance, near = cKDTree(rest[kept]).query(rest, k=min(FIT_NEIGHBOURS, len(kept)))
        self._near = kept[near].reshape(len(rest), -1)
        width = np.maximum(distance.reshape(len(rest), -1)[:, -1:], 1e-12)
        weights = 1.0 - 0.9 * (distance.reshape(len(rest), -1) / width) ** 2
        self._weights = weights / weights.sum(axis=1, keepdims=True)
        arms = rest[self._near]
        arms = (arms - np.einsum("mk,mki->mi", self._weights, arms)[:, None]) / width[:, None]
        moment = np.einsum("mk,mki,mkj->mij", self._weights, arms, arms)
        # Neighbours in a plane or line do not constrain the direction across it: identity there.
        self._arms = np.einsum("mk,mki,mij->mkj", self._weights, arms, np.linalg.pinv(moment, 1e-3, hermitian=True))
        self._arms /= width[:, None]
        self._rest = rest

    def at(self, positions: Array) -> Array:
        """Return gradients (M, 3, 3) of the map from rest positions to ``positions`` (M, 3)."""
        moved = (positions - self._rest)[self._near]
        # The arms' weighted sum is 0, so the mean displacement drops out.
        fitted = np.einsum("mki,mkj->mij", moved, self._arms) + np.eye(3)
        far = np.flatnonzero(np.abs(fitted - np.eye(3)).max(axis=(1, 2)) > 0.25)
        turned, stretches, axes = np.linalg.svd(fitted[far])
        fitted[far] = (turned * np.clip(stretches, MIN_FITTED_STRETCH, MAX_FITTED_STRETCH)[:, None, :]) @ axes
        return fitted
