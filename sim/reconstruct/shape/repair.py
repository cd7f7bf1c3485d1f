# SPDX-License-Identifier: MIT
"""Remove what floats: a body is one connected surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

WORTH_SAYING = 0.01
"""Share of the surface above which its removal is said."""


def keep_main_part(points: Points, faces: Faces) -> tuple[Points, Faces, float]:
    """The connected part with the largest area, its vertices renumbered in order, and the removed share of the area.

    points: (V, 3); faces: (T, 3), not empty. Vertices without a face go as well.
    """
    count = len(points)
    ends = faces[:, [0, 1, 2, 1]].reshape(-1, 2)
    links = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    parts, labels = sparse.csgraph.connected_components(links, directed=False)
    lost = 0.0
    if parts > 1:
        a, b, c = (points[faces[:, corner]] for corner in range(3))
        areas = np.bincount(
            labels[faces[:, 0]], weights=np.linalg.norm(np.cross(b - a, c - a), axis=1), minlength=parts
        )
        keep = int(np.argmax(areas))
        lost = float(1.0 - areas[keep] / max(float(areas.sum()), 1e-300))
        faces = faces[labels[faces[:, 0]] == keep]
    used, renumbered = np.unique(faces, return_inverse=True)
    return points[used], renumbered.reshape(faces.shape), lost
