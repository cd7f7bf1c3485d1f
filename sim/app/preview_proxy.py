# SPDX-License-Identifier: MIT
"""The mesh that stands for an object while a preview plays: itself, or a coarser one where it is too fine to draw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene.meshes import ObjectMesh

MOST_VERTICES = 20_000


@dataclass(frozen=True, eq=False)
class Proxy:
    """vertices: (V, 3) world metres; faces: (T, 3) vertex indices."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


def proxy(mesh: Proxy | ObjectMesh, most: int = MOST_VERTICES) -> Proxy:
    """``mesh`` with at most ``most`` vertices: those in one cube of a lattice become one, and flat faces go.

    Vertices in the same place are merged in any case, so that a seam is never drawn as an edge.
    """
    points, owners = np.unique(mesh.vertices, axis=0, return_inverse=True)
    owners = owners.reshape(-1)
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())
    cells = float(np.sqrt(most))
    while len(points) > most and cells >= 2:
        keys = np.floor((mesh.vertices - low) * (cells / extent)).astype(np.int64)
        _, owners = np.unique(keys, axis=0, return_inverse=True)
        owners = owners.reshape(-1)
        counts = np.bincount(owners)
        points = np.stack([np.bincount(owners, weights=mesh.vertices[:, c]) / counts for c in range(3)], axis=1)
        cells *= 0.8
    faces = owners[mesh.faces]
    a, b, c = faces.T
    return Proxy(vertices=points, faces=faces[(a != b) & (b != c) & (c != a)].astype(np.int64))
