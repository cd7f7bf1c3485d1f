# SPDX-License-Identifier: MIT
"""How deep a point lies inside the silhouettes of all views, when a few of them may be wrong.

Laurentini 1994: the visual hull is what projects into every silhouette. Here a share of the views may object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes

from ...mpm.triangles import signed_volume
from ...scene.model import Camera
from .view import Picture

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

BLOCK = 2**17
"""Points looked at together."""


@dataclass(frozen=True)
class Silhouette:
    """depth: (H, W) pixels from a pixel's centre to the outline, above 0 inside."""

    camera: Camera
    depth: Array

    @staticmethod
    def of(camera: Camera, mask: Picture) -> Silhouette:
        """That of ``mask`` (H, W), where it is half covered; partly covered pixels place the outline within them."""
        inside = mask >= 0.5
        depth = ndimage.distance_transform_edt(inside) - ndimage.distance_transform_edt(~inside)
        depth -= np.sign(depth) * 0.5
        edge = (np.abs(depth) <= 0.5) & (mask > 0) & (mask < 1)
        depth[edge] = mask[edge] - 0.5
        return Silhouette(camera, depth)

    def metres(self, points: Array) -> Array:
        """(n) how far ``points`` (n, 3) are inside, in metres at their distance; NaN where the picture ends."""
        seen = self.camera.project(points)
        x, y, distance = seen.T
        known = (distance > 0) & (x >= 0) & (y >= 0) & (x <= self.camera.width) & (y <= self.camera.height)
        found = np.full(len(points), np.nan)
        at = np.stack([y[known] - 0.5, x[known] - 0.5])
        pixels = ndimage.map_coordinates(self.depth, at, order=1, mode="nearest")
        found[known] = pixels * distance[known] / max(self.camera.fx, self.camera.fy)
        return found


def depths_inside(points: Array, silhouettes: Sequence[Silhouette], dissent: float) -> tuple[Array, Array]:
    """Metres that ``points`` (n, 3) lie inside the hull, below 0 outside, twice (n): of all views, and of most.

    The first is the least depth in any view. The second is the least after the ``dissent`` share of the views that see
    a point and place it furthest out are passed over. A point that fewer than half of the views can see is outside.
    """
    found = np.empty((2, len(points)))
    for start in range(0, len(points), BLOCK):
        block = points[start : start + BLOCK]
        depths = np.stack([silhouette.metres(block) for silhouette in silhouettes], axis=1)
        seen = np.isfinite(depths).sum(axis=1)
        # NaN sorts last, so what is passed over comes first.
        depths.sort(axis=1)
        passed = np.minimum(np.floor(dissent * seen + 1e-9).astype(np.int64), len(silhouettes) - 1)
        least = np.stack([depths[:, 0], np.take_along_axis(depths, passed[:, None], axis=1)[:, 0]])
        found[:, start : start + BLOCK] = np.where((seen >= 2) & (2 * seen >= len(silhouettes)), least, -np.inf)
    return found[0], found[1]


@dataclass(frozen=True)
class Lattice:
    """Places on a regular grid. first: (3,) m of the first one; spacing: m; shape: how many along x, y, z."""

    first: Array
    spacing: float
    shape: tuple[int, int, int]

    @staticmethod
    def around(low: Array, high: Array, cells: int) -> Lattice:
        """``cells`` along the longest side of the box, and two more outside it all around."""
        spacing = float((high - low).max()) / cells
        counts = np.ceil((high - low) / spacing).astype(int) + 5
        first = (low + high) / 2 - spacing * (counts - 1) / 2
        return Lattice(first, spacing, (int(counts[0]), int(counts[1]), int(counts[2])))

    def finer(self, cells: int) -> Lattice:
        """The same box with ``cells`` along its longest side."""
        inner = self.spacing * (np.array(self.shape) - 5)
        middle = self.first + self.spacing * (np.array(self.shape) - 1) / 2
        return Lattice.around(middle - inner / 2, middle + inner / 2, cells)

    def points(self, which: NDArray[np.int64] | None = None) -> Array:
        """(n, 3) m, of the places with the numbers ``which`` (n,), z counting fastest, or of all."""
        numbers = np.arange(int(np.prod(self.shape))) if which is None else which
        return np.asarray(self.first + self.spacing * np.stack(np.unravel_index(numbers, self.shape), axis=1))

    def fields(self, silhouettes: Sequence[Silhouette], dissent: float) -> tuple[Array, Array]:
        """``depths_inside`` at all places, each (nx, ny, nz); beyond three cells from the surface only its sign counts.

        Every second place is looked at first, and the others only where a surface can be near.
        """
        halves = (-(-np.array(self.shape) // 2) + 1).tolist()
        coarse = Lattice(self.first, 2 * self.spacing, (halves[0], halves[1], halves[2]))
        reach = 4 * coarse.spacing
        known = [
            np.clip(field, -reach, reach).reshape(coarse.shape)
            for field in depths_inside(coarse.points(), silhouettes, dissent)
        ]
        found = np.stack([_doubled(field, self.shape).ravel() for field in known])
        near = np.flatnonzero((np.abs(found) < 3 * self.spacing).any(axis=0))
        found[:, near] = np.clip(depths_inside(self.points(near), silhouettes, dissent), -reach, reach)
        return found[0].reshape(self.shape), found[1].reshape(self.shape)

    def surface(self, field: Array) -> tuple[Array, Faces]:
        """Vertices (V, 3) and faces (T, 3) of the closed surface around the places where ``field`` is above 0; none
        where there are no such places."""
        field = field.copy()
        border = np.ones(self.shape, dtype=bool)
        border[1:-1, 1:-1, 1:-1] = False
        field[border] = np.minimum(field[border], -0.5 * self.spacing)
        # A place exactly on the surface would make triangles without area.
        field[np.abs(field) < 1e-6 * self.spacing] = -1e-6 * self.spacing
        if field.max() <= 0:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        points, triangles, _, _ = marching_cubes(field, level=0.0, spacing=(self.spacing,) * 3)
        faces = triangles.astype(np.int64)
        points = points.astype(np.float64) + self.first
        return points, faces[:, ::-1].copy() if signed_volume(points, faces) < 0 else faces


def _doubled(field: Array, shape: tuple[int, int, int]) -> Array:
    """``field`` at twice as many places along each axis, straight in between, cut to ``shape``."""
    for axis, length in enumerate(shape):
        between = np.repeat(field, 2, axis=axis)
        odd, after = [slice(None)] * 3, [slice(None)] * 3
        odd[axis], after[axis] = slice(1, -1, 2), slice(2, None, 2)
        between[tuple(odd)] = (between[tuple(odd)] + between[tuple(after)]) / 2
        kept = [slice(None)] * 3
        kept[axis] = slice(0, length)
        field = between[tuple(kept)]
    return field
