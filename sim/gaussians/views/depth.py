# SPDX-License-Identifier: MIT
"""What a camera sees of a mesh: the depth of the nearest surface at each pixel, in numpy alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...mpm.triangles import batches, ranges
from ...scene.model import Camera

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

NEAREST = 1e-9
"""Metres in front of the camera; triangles that reach behind it are not drawn."""
MAX_CELLS = 2**21
"""Pairs of a triangle and a pixel looked at together."""


def depth_buffer(vertices: Array, faces: Faces, camera: Camera) -> Array:
    """(H, W) metres along the optical axis to the nearest of the triangles at each pixel's centre; infinite where none.

    vertices: (V, 3) world metres; faces: (T, 3).
    """
    buffer = np.full(camera.width * camera.height, np.inf)
    seen = camera.project(vertices)
    corners = seen[faces]
    corners = corners[(corners[..., 2] > NEAREST).all(axis=1)]
    # A pixel's centre lies half a pixel after its number.
    low = np.ceil(corners[..., :2].min(axis=1) - 0.5)
    high = np.floor(corners[..., :2].max(axis=1) - 0.5)
    limit = np.array([camera.width - 1, camera.height - 1])
    low = np.clip(low, 0, limit + 1).astype(np.int64)
    high = np.clip(high, -1, limit).astype(np.int64)
    spans = np.maximum(high - low + 1, 0)
    for chosen in batches(spans[:, 0] * spans[:, 1], MAX_CELLS):
        _draw(buffer, corners[chosen], low[chosen], spans[chosen], camera.width)
    return buffer.reshape(camera.height, camera.width)


def _draw(buffer: Array, corners: Array, low: NDArray[np.int64], spans: NDArray[np.int64], width: int) -> None:
    sizes = spans[:, 0] * spans[:, 1]
    which, cell = ranges(np.zeros(len(sizes), np.int64), sizes)
    column = low[which, 0] + cell % spans[which, 0]
    row = low[which, 1] + cell // spans[which, 0]
    a, b, c = (corners[which, i, :2] for i in range(3))
    at = np.stack([column + 0.5, row + 0.5], axis=1)
    area = _cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = np.stack([_cross(b - at, c - at), _cross(c - at, a - at), _cross(a - at, b - at)]) / area
        # Within a triangle it is the inverse of depth that is linear on the picture.
        depth = 1.0 / (weights / corners[which, :, 2].T).sum(axis=0)
    hit = (weights >= -1e-9).all(axis=0) & np.isfinite(depth)
    np.minimum.at(buffer, row[hit] * width + column[hit], depth[hit])


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
