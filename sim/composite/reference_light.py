# SPDX-License-Identifier: MIT
"""Reference lighting at a surface's vertices: averaged along the surface, and continued over what the photo hides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

Values = NDArray[np.float64]

SAME_PLACE = 1e-6
"""Distance over the surface's extent up to which vertices, split where texture coordinates are, are one."""
HOLD = 1e-6
"""Weight of the mean light against the neighbours': it alone counts where no seen vertex is connected."""


class SurfaceGraph:
    """The edges of a surface of ``vertices`` (V, 3) and triangles ``faces`` (T, 3); vertices in one place are one."""

    def __init__(self, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> None:
        low = vertices.min(axis=0)
        size = max(float(np.ptp(vertices, axis=0).max()), 1e-30)
        places = np.round((vertices - low) / (size * SAME_PLACE)).astype(np.int64)
        _, which = np.unique(places, axis=0, return_inverse=True)
        self._which = which.reshape(-1)
        self._count = int(self._which.max()) + 1
        corner = self._which[faces]
        ends = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
        ends = ends[ends[:, 0] != ends[:, 1]]
        edges = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(self._count, self._count))
        self._links = ((edges + edges.T) > 0).astype(np.float64).tocsr()

    def smoothed(self, values: Values, steps: int) -> Values:
        """Return ``values`` (V, C) averaged ``steps`` times with their neighbours'."""
        graph = self._links + sparse.identity(self._count)
        share = 1.0 / np.asarray(graph.sum(axis=1)).reshape(-1, 1)
        merged = self._merged(values, np.ones(len(values)))[0]
        for _ in range(steps):
            merged = (graph @ merged) * share
        return np.asarray(merged[self._which])

    def continued(self, values: Values, seen: NDArray[np.bool_]) -> Values:
        """Return ``values`` (V, C), where not ``seen`` (V,) continued from those that are as smoothly as possible:
        harmonic, each the mean of its neighbours. Without a seen vertex, ``values``."""
        merged, weight = self._merged(values, seen.astype(np.float64))
        known = weight > 0
        if not known.any() or known.all():
            return values if not known.any() else np.asarray(merged[self._which])
        degree = np.asarray(self._links.sum(axis=1)).ravel()
        matrix = sparse.diags(degree + HOLD) - self._links
        rest = np.flatnonzero(~known)
        right = HOLD * merged[known].mean(axis=0) + (self._links @ np.where(known[:, None], merged, 0.0))[rest]
        merged[rest] = splu(matrix.tocsc()[rest][:, rest].tocsc()).solve(np.asarray(right))
        result = merged[self._which]
        return np.asarray(np.where(seen[:, None], values, result))

    def _merged(self, values: Values, weight: NDArray[np.float64]) -> tuple[Values, NDArray[np.float64]]:
        """Weighted means (P, C) of the ``values`` (V, C) in each place, and their weights (P,)."""
        total = np.bincount(self._which, weight, self._count)
        sums = [np.bincount(self._which, weight * column, self._count) for column in values.T]
        return np.stack(sums, axis=-1) / np.maximum(total, 1e-30)[:, None], total
