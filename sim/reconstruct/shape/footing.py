# SPDX-License-Identifier: MIT
"""A broader base for inflated bodies: the hidden underside is lowered to the ground.

Inflated bodies are round below and would stand on a spot, where real things have settled. The part of the underside
that faces away from the camera sags to the ground wherever the body still hides it there. The photo shows none of it:
neither the front nor the outline changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...mpm.geometry.triangles import area_normals
from ...scene.model import Camera
from .inflate import Silhouette
from .support import support_of

Points = NDArray[np.float64]

FOOTINGS = (0.03, 0.06, 0.1, 0.14)
"""Heights over the body's height up to which the underside comes down, to try until the body stands."""
RAMP = 3.0
"""Height, over that of the footing, above which nothing sags."""
HIDDEN_PX = 1
"""Pixels by which the outline encloses what has moved."""


def footed(
    camera: Camera, silhouette: Silhouette, vertices: Points, faces: NDArray[np.int64]
) -> tuple[Points, NDArray[np.bool_]]:
    """Return ``vertices`` (V, 3) with as much of the underside on the ground z = 0 as the body needs to stand safely,
    and which of them moved (V,).

    camera: above the ground. As safely as ``support.SupportMargin.wanted`` says, or as the hidden underside allows.
    """
    stands = support_of(vertices, faces)
    best, safest = vertices, stands.margin
    for share in FOOTINGS:
        if safest >= stands.wanted:
            break
        made = _settled(camera, silhouette, vertices, faces, share * stands.height)
        margin = support_of(made, faces).margin
        if margin > safest:
            best, safest = made, margin
    return best, (best != vertices).any(axis=1)


def _settled(
    camera: Camera, silhouette: Silhouette, vertices: Points, faces: NDArray[np.int64], height: float
) -> Points:
    """``vertices`` with the hidden underside below ``height`` on the ground, and what is above it drawn after."""
    normals = area_normals(vertices, faces)
    unseen = np.einsum("ij,ij->i", normals, camera.position - vertices) < 0.0
    z = vertices[:, 2]
    sagged = vertices.copy()
    sagged[:, 2] = np.clip((z - height) * (RAMP / (RAMP - 1.0)), 0.0, np.maximum(z, 0.0))
    inside = ndimage.binary_erosion(silhouette.mask, iterations=HIDDEN_PX)
    at = camera.project(sagged)[:, :2] - (silhouette.left, silhouette.top)
    column, row = np.floor(at).astype(np.int64).T
    known = (row >= 0) & (row < inside.shape[0]) & (column >= 0) & (column < inside.shape[1])
    hidden = np.zeros(len(vertices), dtype=bool)
    hidden[known] = inside[row[known], column[known]]
    moves = (normals[:, 2] < 0.0) & unseen & hidden & (z < RAMP * height)
    return np.asarray(np.where(moves[:, None], sagged, vertices))
