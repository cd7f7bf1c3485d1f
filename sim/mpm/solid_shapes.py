# SPDX-License-Identifier: MIT
"""Surfaces of solids as the kernels read them: distance lattices and clusters of surface points. No Taichi."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ..kept import Kept
from .colliders import Surface
from .contact_points import surface_points
from .curvature import PATCH, patches
from .distance import DistanceLattice, signed_distance
from .solid_layout import POINT

Array = NDArray[np.float64]

NODES = 32
"""Lattice nodes along the side of a cube of the volume of the surface's bounding box."""

FEWEST, MOST = 24, 96
"""Limits of the nodes along the longest side."""

POINTS = 16
"""The same for the surface points."""

FLAT_CELL = 2.5
"""Flat parts keep one point in each cube of so many spacings. What they meet are corners and edges, and those have
points of their own."""

MARGIN = 2.5
"""Lattice nodes around the bounding box."""

CLUSTER = 4.0
"""Side of a cluster of surface points in spacings of the points."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointSet:
    """Surface points in clusters, in units of the surface: ``rows`` (N, POINT) in cluster order, ``balls`` (C, 4)
    around them, ``starts`` (C + 1,) first points. The first ``hull`` clusters hold the convex hull's corners."""

    rows: Array
    balls: Array
    starts: NDArray[np.int64]
    hull: int
    radius: float
    spacing: float
    bulge: float


NO_POINTS = PointSet(
    rows=np.zeros((0, POINT)),
    balls=np.zeros((0, 4)),
    starts=np.zeros(1, dtype=np.int64),
    hull=0,
    radius=0.0,
    spacing=1.0,
    bulge=0.0,
)


_LATTICES: Kept[Surface, DistanceLattice] = Kept()
_POINTS: Kept[Surface, PointSet] = Kept()


def spacing_of(vertices: Array, nodes: int) -> float:
    """Distance between ``nodes`` nodes along the side of a cube as large as the bounding box of vertices (V, 3)."""
    extent = np.ptp(vertices, axis=0)
    longest = float(extent.max())
    side = float(np.cbrt(np.prod(np.maximum(extent, 1e-3 * longest))))
    scale = nodes / NODES
    return float(np.clip(side / nodes, longest / (MOST * scale), longest / (FEWEST * scale)))


def lattice_of(surface: Surface, *, margin: float = 0.0) -> DistanceLattice:
    """Distances to ``surface`` on a lattice of the usual fineness, ``margin`` farther out than need be."""
    spacing = spacing_of(surface.vertices, NODES)
    reach = MARGIN * spacing + margin
    return _LATTICES.get(surface, reach, lambda: signed_distance(surface, spacing, margin=reach))


def reach_of(lattice: DistanceLattice, center: Array) -> float:
    """Distance in metres from ``center`` (3,) within which lies all that is inside by ``lattice``."""
    inside = np.argwhere(lattice.distances <= 0)
    if len(inside) == 0:
        return 0.0
    away = np.linalg.norm(lattice.origin + lattice.spacing * inside - center, axis=1)
    return float(away.max()) + lattice.spacing


def points_of(surface: Surface, center: Array) -> PointSet:
    """Points of ``surface`` relative to ``center`` (3,), those of its convex hull first."""
    return _POINTS.get(surface, center.tobytes(), lambda: _points_of(surface, center))


def _points_of(surface: Surface, center: Array) -> PointSet:
    spacing = spacing_of(surface.vertices, POINTS)
    points, normals = surface_points(surface, spacing)
    local = points - center
    table, smooth = patches(local, normals, spacing)
    kept = _without_flats(local, smooth & (table[:, 9:11] == 0).all(axis=1), FLAT_CELL * spacing)
    local, table, smooth = local[kept], table[kept], smooth[kept]
    hull = np.zeros(len(local), dtype=bool)
    try:
        hull[ConvexHull(local).vertices] = True
    except QhullError:
        hull[:] = True
    rows = np.column_stack([table, smooth.astype(np.float64)])
    assert rows.shape[1] == PATCH + 1 == POINT
    groups = np.concatenate([_clusters(local, np.flatnonzero(chosen), spacing) for chosen in (hull, ~hull)])
    order = groups[:, 0]
    breaks = np.flatnonzero(np.diff(groups[:, 1], prepend=-1) != 0)
    split = int(np.count_nonzero(hull))
    breaks = np.union1d(breaks, [0, split][: 1 + (split < len(order))])
    starts = np.append(breaks, len(order))
    rows = rows[order]
    balls = np.zeros((len(breaks), 4))
    for c, (a, b) in enumerate(pairwise(starts)):
        members = rows[a:b, :3]
        middle = 0.5 * (members.min(axis=0) + members.max(axis=0))
        balls[c] = [*middle, np.linalg.norm(members - middle, axis=1).max()]
    radii = rows[:, 9:11]
    tightest = float(radii[radii > 0].min()) if (radii > 0).any() else np.inf
    return PointSet(
        rows=rows,
        balls=balls,
        starts=starts,
        hull=int(np.searchsorted(breaks, split)),
        radius=float(np.linalg.norm(rows[:, :3], axis=1).max()),
        spacing=spacing,
        bulge=float(min((0.7 * spacing) ** 2 / (2 * tightest), spacing)),
    )


def _without_flats(points: Array, flat: NDArray[np.bool_], side: float) -> NDArray[np.int64]:
    """Indices of the points that are not flat and of the first flat one in each cube of ``side``."""
    cells = np.floor((points[flat] - points.min(axis=0)) / side).astype(np.int64)
    first = np.unique(cells, axis=0, return_index=True)[1]
    return np.sort(np.concatenate([np.flatnonzero(~flat), np.flatnonzero(flat)[first]]))


def _clusters(points: Array, chosen: NDArray[np.int64], spacing: float) -> NDArray[np.int64]:
    """Indices ``chosen`` ordered by the cube of side ``CLUSTER`` spacings that they lie in, and the cubes' numbers."""
    cells = np.floor((points[chosen] - points.min(axis=0)) / (CLUSTER * spacing)).astype(np.int64)
    across = int(cells.max(initial=0)) + 1
    keys = (cells[:, 0] * across + cells[:, 1]) * across + cells[:, 2]
    order = np.lexsort((chosen, keys))
    return np.stack([chosen[order], keys[order]], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tables:
    """Lattices in the three arrays that ``shapes`` describes."""

    numbers: NDArray[np.float32]
    dims: NDArray[np.int32]
    distances: NDArray[np.float32]


def tables(lattices: Sequence[tuple[DistanceLattice, Array, float]]) -> Tables:
    """Lattices in world metres, each with the centre (3,) of its frame and the cells per metre."""
    numbers, dims, offset = [], [], 0
    for lattice, center, scale in lattices:
        numbers.append([*((lattice.origin - center) * scale), lattice.spacing * scale])
        dims.append([*lattice.distances.shape, offset])
        offset += lattice.distances.size
    flat = [np.ravel(lattice.distances) * scale for lattice, _, scale in lattices]
    return Tables(
        numbers=np.asarray(numbers, dtype=np.float32).ravel(),
        dims=np.asarray(dims, dtype=np.int32).ravel(),
        distances=np.concatenate([*flat, np.zeros(1)]).astype(np.float32),
    )
