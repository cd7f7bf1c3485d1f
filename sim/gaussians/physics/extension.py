# SPDX-License-Identifier: MIT
"""Values at the points of an object's skin, carried on into what fills it. No Taichi.

A filling particle has no loss of its own. What it should do is what changes least between the points around it: the
harmonic extension, which for a ball is Poisson's integral, the mean over the skin with weights 1/distance³. It is exact
for all fields that are linear in space, so a body that is shifted, turned or stretched by its skin is so throughout.
For other shapes the same weights are taken. Skin nearer than a patch of it is seen point by point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

PATCHES = 12
"""Patches of the skin along the longest side of the object."""

NEIGHBOURS = 8
"""Points that a particle near the skin follows, by 1/distance³."""


class Extension:
    """From points (N, 3) to filling particles (M, 3), where both are at rest."""

    def __init__(self, points: Array, fill: Array) -> None:
        side = float(np.ptp(points, axis=0).max()) / PATCHES
        places, patch = np.unique(np.floor((points - points.min(axis=0)) / side), axis=0, return_inverse=True)
        self._shape = (len(fill), len(points))
        count = np.bincount(patch.ravel())
        self._patches = csr_matrix((1.0 / count[patch.ravel()], (patch.ravel(), np.arange(len(points)))))
        if len(fill) == 0:
            return
        distance, nearest = cKDTree(points).query(fill, k=min(NEIGHBOURS, len(points)))
        weights = 1.0 / np.maximum(distance, 1e-6 * side) ** 3
        # How much a particle sees of the skin around it, against the skin right before it.
        far = np.clip(distance[:, :1] / side - 0.5, 0.0, 1.0)
        weights *= (1.0 - far) / weights.sum(axis=1, keepdims=True)
        rows = np.repeat(np.arange(len(fill)), weights.shape[1])
        self._near = csr_matrix((weights.ravel(), (rows, nearest.ravel())), shape=self._shape)
        middles = self._patches @ points
        # Patches that a voxel's edge cuts are smaller; each counts by its points, as the skin is evenly sampled.
        kernel = np.empty((len(fill), len(places)), dtype=np.float32)
        for start in range(0, len(fill), 4096):
            some = slice(start, start + 4096)
            gap = np.linalg.norm(fill[some, None] - middles[None], axis=2)
            part = count / np.maximum(gap, 0.5 * side) ** 3
            kernel[some] = far[some] * part / part.sum(axis=1, keepdims=True)
        self._far = kernel

    def __call__(self, values: Array) -> Array:
        """Values (M, K) of the filling particles for those (N, K) of the points."""
        if self._shape[0] == 0:
            return np.zeros((0, values.shape[1]))
        around = self._far @ (self._patches @ values).astype(np.float32)
        return np.asarray(self._near @ values + around)
