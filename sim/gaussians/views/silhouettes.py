# SPDX-License-Identifier: MIT
"""Silhouettes as distance fields, the space that they leave on a grid of voxels, and depth buffers of meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes

from ...mpm.geometry.triangles import batches, ranges, signed_volume
from ...scene.model import Camera
from .posed_images import Picture

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


NEAR_PLANE = 1e-9
"""Metres in front of the camera; triangles that reach behind it are skipped."""
MAX_FRAGMENTS = 2**21
"""Pairs of a triangle and a pixel processed at a time."""


def depth_buffer(vertices: Array, faces: Faces, camera: Camera) -> Array:
    """Return (H, W) metres along the optical axis to the nearest triangle at each pixel's centre; infinite where none.

    vertices: (V, 3) world metres; faces: (T, 3). NumPy only.
    """
    buffer = np.full(camera.width * camera.height, np.inf)
    seen = camera.project(vertices)
    corners = seen[faces]
    corners = corners[(corners[..., 2] > NEAR_PLANE).all(axis=1)]
    # A pixel's centre is at its index plus one half.
    low = np.ceil(corners[..., :2].min(axis=1) - 0.5)
    high = np.floor(corners[..., :2].max(axis=1) - 0.5)
    limit = np.array([camera.width - 1, camera.height - 1])
    low = np.clip(low, 0, limit + 1).astype(np.int64)
    high = np.clip(high, -1, limit).astype(np.int64)
    spans = np.maximum(high - low + 1, 0)
    for chosen in batches(spans[:, 0] * spans[:, 1], MAX_FRAGMENTS):
        _rasterise(buffer, corners[chosen], low[chosen], spans[chosen], camera.width)
    return buffer.reshape(camera.height, camera.width)


def _rasterise(buffer: Array, corners: Array, low: NDArray[np.int64], spans: NDArray[np.int64], width: int) -> None:
    sizes = spans[:, 0] * spans[:, 1]
    which, cell = ranges(np.zeros(len(sizes), np.int64), sizes)
    column = low[which, 0] + cell % spans[which, 0]
    row = low[which, 1] + cell // spans[which, 0]
    a, b, c = (corners[which, i, :2] for i in range(3))
    at = np.stack([column + 0.5, row + 0.5], axis=1)
    area = _cross_2d(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = np.stack([_cross_2d(b - at, c - at), _cross_2d(c - at, a - at), _cross_2d(a - at, b - at)]) / area
        # Within a triangle the inverse of depth is linear in image coordinates.
        depth = 1.0 / (weights / corners[which, :, 2].T).sum(axis=0)
    hit = (weights >= -1e-9).all(axis=0) & np.isfinite(depth)
    np.minimum.at(buffer, row[hit] * width + column[hit], depth[hit])


def _cross_2d(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


BLOCK_POINTS = 2**17
"""Points processed at a time."""


@dataclass(frozen=True)
class Silhouette:
    """A mask as a distance field. depth: (H, W) pixels from a pixel's centre to the outline, positive inside."""

    camera: Camera
    depth: Array

    @staticmethod
    def of(camera: Camera, mask: Picture) -> Silhouette:
        """Return the silhouette of ``mask`` (H, W) at half coverage; partial coverage locates it within a pixel."""
        inside = mask >= 0.5
        depth = ndimage.distance_transform_edt(inside) - ndimage.distance_transform_edt(~inside)
        depth -= np.sign(depth) * 0.5
        edge = (np.abs(depth) <= 0.5) & (mask > 0) & (mask < 1)
        depth[edge] = mask[edge] - 0.5
        return Silhouette(camera, depth)

    def metres(self, points: Array) -> Array:
        """Return (n,) how far ``points`` (n, 3) are inside, in metres at their distance; NaN outside the image."""
        seen = self.camera.project(points)
        x, y, distance = seen.T
        known = (distance > 0) & (x >= 0) & (y >= 0) & (x <= self.camera.width) & (y <= self.camera.height)
        found = np.full(len(points), np.nan)
        at = np.stack([y[known] - 0.5, x[known] - 0.5])
        pixels = ndimage.map_coordinates(self.depth, at, order=1, mode="nearest")
        found[known] = pixels * distance[known] / max(self.camera.fx, self.camera.fy)
        return found


def hull_depths(points: Array, silhouettes: Sequence[Silhouette], dissent: float) -> tuple[Array, Array]:
    """Return two depths (n,) of ``points`` (n, 3) inside the hull in metres, negative outside: strict and lenient.

    The strict one is the least depth in any view. The lenient one ignores the fraction ``dissent`` of the views that
    see a point and place it furthest out. A point in view of fewer than half of the cameras is outside.
    """
    found = np.empty((2, len(points)))
    for start in range(0, len(points), BLOCK_POINTS):
        block = points[start : start + BLOCK_POINTS]
        depths = np.stack([silhouette.metres(block) for silhouette in silhouettes], axis=1)
        seen = np.isfinite(depths).sum(axis=1)
        # NaN sorts last, so the dissenting views come first.
        depths.sort(axis=1)
        passed = np.minimum(np.floor(dissent * seen + 1e-9).astype(np.int64), len(silhouettes) - 1)
        least = np.stack([depths[:, 0], np.take_along_axis(depths, passed[:, None], axis=1)[:, 0]])
        found[:, start : start + BLOCK_POINTS] = np.where((seen >= 2) & (2 * seen >= len(silhouettes)), least, -np.inf)
    return found[0], found[1]


@dataclass(frozen=True)
class VoxelGrid:
    """Nodes of a regular grid. first: (3,) position of the first node, m; spacing: m; shape: nodes along x, y, z."""

    first: Array
    spacing: float
    shape: tuple[int, int, int]

    @staticmethod
    def around(low: Array, high: Array, cells: int) -> VoxelGrid:
        """Return a grid with ``cells`` along the longest side of the box, and two more all around it."""
        spacing = float((high - low).max()) / cells
        counts = np.ceil((high - low) / spacing).astype(int) + 5
        first = (low + high) / 2 - spacing * (counts - 1) / 2
        return VoxelGrid(first, spacing, (int(counts[0]), int(counts[1]), int(counts[2])))

    def finer(self, cells: int) -> VoxelGrid:
        """Return a grid over the same box with ``cells`` along its longest side."""
        inner = self.spacing * (np.array(self.shape) - 5)
        middle = self.first + self.spacing * (np.array(self.shape) - 1) / 2
        return VoxelGrid.around(middle - inner / 2, middle + inner / 2, cells)

    def points(self, which: NDArray[np.int64] | None = None) -> Array:
        """Return (n, 3) positions in metres of the nodes with flat indices ``which`` (n,), z fastest, or of all."""
        numbers = np.arange(int(np.prod(self.shape))) if which is None else which
        return np.asarray(self.first + self.spacing * np.stack(np.unravel_index(numbers, self.shape), axis=1))

    def fields(self, silhouettes: Sequence[Silhouette], dissent: float) -> tuple[Array, Array]:
        """Return ``hull_depths`` at all nodes, each (nx, ny, nz); beyond three cells from the surface only the sign.

        Every second node is evaluated first, the others only where a surface can be near.
        """
        halves = (-(-np.array(self.shape) // 2) + 1).tolist()
        coarse = VoxelGrid(self.first, 2 * self.spacing, (halves[0], halves[1], halves[2]))
        reach = 4 * coarse.spacing
        known = [
            np.clip(field, -reach, reach).reshape(coarse.shape)
            for field in hull_depths(coarse.points(), silhouettes, dissent)
        ]
        found = np.stack([_upsampled(field, self.shape).ravel() for field in known])
        near = np.flatnonzero((np.abs(found) < 3 * self.spacing).any(axis=0))
        found[:, near] = np.clip(hull_depths(self.points(near), silhouettes, dissent), -reach, reach)
        return found[0].reshape(self.shape), found[1].reshape(self.shape)

    def surface(self, field: Array) -> tuple[Array, Faces]:
        """Return vertices (V, 3) and faces (T, 3) of the closed surface around the nodes where ``field`` is positive;
        empty arrays where there are no such nodes."""
        field = field.copy()
        border = np.ones(self.shape, dtype=bool)
        border[1:-1, 1:-1, 1:-1] = False
        field[border] = np.minimum(field[border], -0.5 * self.spacing)
        # A node exactly on the surface would produce triangles without area.
        field[np.abs(field) < 1e-6 * self.spacing] = -1e-6 * self.spacing
        if field.max() <= 0:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        points, triangles, _, _ = marching_cubes(field, level=0.0, spacing=(self.spacing,) * 3)
        faces = triangles.astype(np.int64)
        points = points.astype(np.float64) + self.first
        return points, faces[:, ::-1].copy() if signed_volume(points, faces) < 0 else faces


def _upsampled(field: Array, shape: tuple[int, int, int]) -> Array:
    """Return ``field`` upsampled by 2 along each axis by linear interpolation, cropped to ``shape``."""
    for axis, length in enumerate(shape):
        between = np.repeat(field, 2, axis=axis)
        odd, after = [slice(None)] * 3, [slice(None)] * 3
        odd[axis], after[axis] = slice(1, -1, 2), slice(2, None, 2)
        between[tuple(odd)] = (between[tuple(odd)] + between[tuple(after)]) / 2
        kept = [slice(None)] * 3
        kept[axis] = slice(0, length)
        field = between[tuple(kept)]
    return field
