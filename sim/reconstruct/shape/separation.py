# SPDX-License-Identifier: MIT
"""Bodies that share space are separated along the camera's rays, which moves nothing in the photo.

Two bodies can overlap only where the photo shows one in front of the other: their silhouettes would be disjoint
otherwise, and so would their cones of sight. Along each ray through both, the body in front should end where the one
behind begins. What reaches too far is on a side that the photo does not show, either the back of the one or the hidden
part of the other, so vertices slide along their own rays until the two are apart: silhouettes, texture coordinates and
everything visible stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..camera.ground_camera import ground_depth
from ..mesh_raster import depth_range

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

CELLS = 160
"""Cells along the longer side of the window that two silhouettes share."""
GAP = 0.002
"""Distance left between the two along a ray, over the front body's extent; contact closes it."""
THINNEST = 0.02
"""Depth that is left of a body along a ray, over its extent: with less it would have no inside there."""
MOST_THINNED = 0.5
"""Largest share of its depth that a front body of unknown shape gives way."""
TOUCHING = 0.01
"""Depth along a ray, over the front body's extent, by which bodies may share space: those that rest on each other do so
by rounding, and moving them would take their support away."""


@dataclass(frozen=True)
class PlacedBody:
    """vertices: (V, 3); faces: (T, 3), in the camera's unit. guessed: whether its depth is inflated from its outline
    rather than that of a primitive or a given mesh."""

    vertices: Points
    faces: Faces
    guessed: bool

    @property
    def extent(self) -> float:
        """Largest extent along the world's axes."""
        return float(np.ptp(self.vertices, axis=0).max())


@dataclass(frozen=True)
class Separation:
    """``yielding`` gave way to ``other`` (indices) by up to ``share`` of its own extent."""

    yielding: int
    other: int
    share: float


def separate(
    camera: Camera, bodies: Sequence[PlacedBody], front_to_back: Sequence[int]
) -> tuple[list[Points], list[Separation]]:
    """Return the vertices (V, 3) of ``bodies``, none of which reaches into another along any ray, and what gave way.

    front_to_back: indices of the bodies as the photo shows them. A front body whose depth is guessed gives up to half
    of it to one behind whose depth is known; else the one behind recedes. Nothing is moved below the ground z = 0.
    """
    placed = list(bodies)
    moved: dict[tuple[int, int], float] = {}

    def put(index: int, other: int, depth: Points, projected: Points) -> None:
        body = placed[index]
        away = float(np.abs(depth - projected[:, 2]).max())
        if away <= 0.0:
            return
        vertices = body.vertices.copy()
        changed = depth != projected[:, 2]
        rays = camera.rays(projected[changed, :2])
        vertices[changed] = camera.position + depth[changed, None] * rays
        placed[index] = PlacedBody(vertices, body.faces, body.guessed)
        moved[index, other] = max(moved.get((index, other), 0.0), away / max(body.extent, 1e-12))

    for place, front in enumerate(front_to_back):
        for behind in front_to_back[place + 1 :]:
            if placed[front].guessed and not placed[behind].guessed:
                near = _Pair.of(camera, placed[front], placed[behind])
                if near is not None and near.overlap:
                    put(front, behind, near.front_thinned(), near.front)
            near = _Pair.of(camera, placed[front], placed[behind])
            if near is not None and near.overlap:
                put(behind, front, near.behind_receded(camera), near.behind)
    found = [Separation(index, other, share) for (index, other), share in moved.items()]
    return [body.vertices for body in placed], found


@dataclass(frozen=True)
class _Pair:
    """Two bodies over the window that their silhouettes share.

    front, behind: (V, 3) pixels and depth of their vertices. corner: (2,) pixels; cell: pixels. front_range,
    behind_range: nearest and farthest depth (h, w) of each, +inf and −inf where there is none. gap, touching, kept,
    least: depths in the camera's unit: between the two, shared at most, left of the front body and of the other.
    """

    front: Points
    behind: Points
    corner: Points
    cell: float
    front_range: tuple[Points, Points]
    behind_range: tuple[Points, Points]
    gap: float
    touching: float
    kept: float
    least: float

    @staticmethod
    def of(camera: Camera, front: PlacedBody, behind: PlacedBody) -> _Pair | None:
        """Return the pair, None where the silhouettes' boxes are apart or a body reaches behind the camera."""
        first, second = camera.project(front.vertices), camera.project(behind.vertices)
        if not ((first[:, 2] > 0).all() and (second[:, 2] > 0).all()):
            return None
        low = np.maximum(first[:, :2].min(axis=0), second[:, :2].min(axis=0))
        high = np.minimum(first[:, :2].max(axis=0), second[:, :2].max(axis=0))
        if (high <= low).any():
            return None
        cell = float((high - low).max()) / CELLS
        size = tuple(int(n) for n in np.ceil((high - low) / cell) + 2)
        corner = low - cell
        return _Pair(
            front=first,
            behind=second,
            corner=corner,
            cell=cell,
            front_range=_depth_range(first, front.faces, corner, cell, size),
            behind_range=_depth_range(second, behind.faces, corner, cell, size),
            gap=GAP * front.extent,
            touching=TOUCHING * front.extent,
            kept=THINNEST * front.extent,
            least=THINNEST * behind.extent,
        )

    @property
    def overlap(self) -> bool:
        """Whether the front body reaches into the one behind, or beyond it, along any ray."""
        return bool((self._shared() > 0).any())

    def _shared(self) -> Points:
        """Depth (h, w) by which the front body reaches too far, the gap included, also around such places; else 0."""
        with np.errstate(invalid="ignore"):
            shared = self.front_range[1] - self.behind_range[0]
        shared = np.where(np.isfinite(shared) & (shared > self.touching), shared + self.gap, 0.0)
        return np.asarray(ndimage.maximum_filter(shared, 3))

    def front_thinned(self) -> Points:
        """Depths (V,) of the front body's vertices, its far side in front of the other where it has that much room."""
        near, far = self.front_range
        shared = self._shared()
        with np.errstate(invalid="ignore"):
            floor = near + np.maximum((1.0 - MOST_THINNED) * (far - near), self.kept)
            limit = np.where(np.isfinite(near) & (shared > 0), np.maximum(far - shared, floor), np.inf)
        return np.minimum(self.front[:, 2], self._at(limit, self.front, np.inf))

    def behind_receded(self, camera: Camera) -> Points:
        """Depths (V,) of the other body's vertices, all of them behind the front body, none below the ground."""
        near, far = self.behind_range
        shared = self._shared()
        with np.errstate(invalid="ignore"):
            start = np.where(np.isfinite(near) & (shared > 0), near + shared, -np.inf)
            thick = np.where(np.isfinite(near), np.maximum(far - near, self.least), self.least)
        depth = self.behind[:, 2]
        # What was behind stays behind, also where all of the body has to recede.
        order = np.clip((depth - self._at(near, self.behind, np.inf)) / self._at(thick, self.behind, 1.0), 0.0, 1.0)
        receded = np.maximum(depth, self._at(start, self.behind, -np.inf) + self.least * order)
        below = ground_depth(camera, camera.rays(self.behind[:, :2]))
        return np.where(receded > depth, np.maximum(depth, np.minimum(receded, below)), depth)

    def _at(self, field: Points, vertices: Points, outside: float) -> Points:
        """Values (V,) of ``field`` (h, w) at the pixels of ``vertices`` (V, 3)."""
        index = np.floor((vertices[:, :2] - self.corner) / self.cell).astype(int)
        inside = ((index >= 0) & (index < field.shape[::-1])).all(axis=1)
        values = np.full(len(vertices), outside)
        values[inside] = field[index[inside, 1], index[inside, 0]]
        return values


def _depth_range(
    projected: Points, faces: Faces, corner: Points, cell: float, size: tuple[int, ...]
) -> tuple[Points, Points]:
    """Nearest and farthest depth (h, w) of a mesh with ``projected`` vertices (V, 3) at the middles of the cells.

    At the middles, not anywhere in a cell: bodies that rest on each other have the same depth there.
    """
    at = np.column_stack([(projected[:, :2] - corner) / cell, projected[:, 2]])
    return depth_range(at, faces, (size[0], size[1]))
