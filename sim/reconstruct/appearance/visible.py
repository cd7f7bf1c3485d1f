# SPDX-License-Identifier: MIT
"""Which point of a surface each pixel of the photo shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera

CHUNK = 2_000_000
"""Candidate pixels at a time."""
DEPTH_CELLS = 256
"""Along the longer side of the depth map that tells which faces are seen."""
BEHIND = 0.015
"""Of the extent: how far behind the nearest surface a face may lie and still be what is seen."""


@dataclass(frozen=True, eq=False)
class VisiblePixels:
    """P pixels of a grid. rows, columns: (P,); faces: (P,); corners: (P, 3) barycentric, in space."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    faces: NDArray[np.int64]
    corners: NDArray[np.float64]

    def interpolated(self, faces: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """``values`` (N, C) of the vertices that ``faces`` (T, 3) name, at the pixels (P, C)."""
        return np.asarray(np.einsum("pk,pkc->pc", self.corners, values[faces[self.faces]]))


def visible_pixels(
    camera: Camera, vertices: NDArray[np.float64], faces: NDArray[np.int64], scale: float = 1.0
) -> VisiblePixels:
    """The nearest surface at the pixel centres of the photo at ``scale``, the camera's pixels times it.

    Faces behind the camera, or that reach there, are left out, and those whose outside is turned away.
    """
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    at = camera.project(vertices)
    at[:, :2] *= (size[0] / camera.width, size[1] / camera.height)
    # Pixel rows run downward: a face whose outside is seen goes round the other way on the image.
    return rasterised(at, faces, size, _area(at[faces]) < 0)


def seen_faces(camera: Camera, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which faces (T,) are turned to the camera and lie, with their middle, before all others."""
    corner = camera.project(vertices)[faces]
    towards = (_area(corner) < 0) & (corner[..., 2] > 1e-9).all(axis=1)
    extent = float(np.ptp(corner[..., :2].reshape(-1, 2), axis=0).max())
    scale = min(1.0, DEPTH_CELLS / max(extent, 1.0))
    shown = visible_pixels(camera, vertices, faces, scale)
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    depth = np.full(size[::-1], np.inf)
    depth[shown.rows, shown.columns] = shown.interpolated(faces, camera.project(vertices)[:, 2:])[:, 0]
    middle = corner.mean(axis=1)
    x, y = ((middle[:, i] * scale).clip(0, size[i] - 1).astype(np.int64) for i in (0, 1))
    slack = BEHIND * float(np.ptp(vertices, axis=0).max())
    return np.asarray(towards & (middle[:, 2] <= depth[y, x] + slack))


def rasterised(
    at: NDArray[np.float64], faces: NDArray[np.int64], size: tuple[int, int], use: NDArray[np.bool_]
) -> VisiblePixels:
    """What the pixels of a grid of ``size`` (width, height) show of the triangles ``faces`` (T, 3) among ``use`` (T,).

    at: (N, 3) x, y in pixels and depth of the vertices; the least depth wins.
    """
    width, height = size
    corner = at[faces]
    a, b, c = corner[:, 0, :2], corner[:, 1, :2], corner[:, 2, :2]
    area = _area(corner)
    low = np.maximum(np.ceil(corner[..., :2].min(axis=1) - 0.5), 0)
    high = np.minimum(np.floor(corner[..., :2].max(axis=1) - 0.5), (width - 1, height - 1))
    span = (high - low + 1).clip(0)
    kept = np.flatnonzero(use & (corner[..., 2] > 1e-9).all(axis=1) & (np.abs(area) > 1e-12) & (span > 0).all(axis=1))
    counts = (span[kept, 0] * span[kept, 1]).astype(np.int64)
    ends = np.cumsum(counts)
    best_depth = np.full(width * height, np.inf)
    best_face = np.full(width * height, -1, dtype=np.int64)
    best_corners = np.zeros((width * height, 3))
    start = 0
    while start < len(kept):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + CHUNK, side="right")))
        part, number = kept[start:stop], counts[start:stop]
        face = np.repeat(part, number)
        offset = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
        columns = (low[face, 0] + offset % span[face, 0]).astype(np.int64)
        rows = (low[face, 1] + offset // span[face, 0]).astype(np.int64)
        x, y = columns + 0.5, rows + 0.5
        flat = np.empty((len(face), 3))
        for k, (first, second) in enumerate(((b, c), (c, a), (a, b))):
            p, q = first[face], second[face]
            flat[:, k] = ((q[:, 0] - p[:, 0]) * (y - p[:, 1]) - (q[:, 1] - p[:, 1]) * (x - p[:, 0])) / area[face]
        inside = (flat >= -1e-9).all(axis=1)
        face, flat, cell = face[inside], flat[inside], (rows * width + columns)[inside]
        weight = flat / corner[face, :, 2]
        depth = 1.0 / weight.sum(axis=1)
        order = np.lexsort((depth, cell))
        cell, depth, face, weight = cell[order], depth[order], face[order], weight[order]
        first_there = np.flatnonzero(np.diff(cell, prepend=-1))
        nearer = first_there[depth[first_there] < best_depth[cell[first_there]]]
        best_depth[cell[nearer]] = depth[nearer]
        best_face[cell[nearer]] = face[nearer]
        best_corners[cell[nearer]] = weight[nearer] * depth[nearer, None]
        start = stop
    found = np.flatnonzero(best_face >= 0)
    return VisiblePixels(found // width, found % width, best_face[found], best_corners[found])


def _area(corner: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the signed area (T,) of triangles (T, 3, 2 or more)."""
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    return np.asarray((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
