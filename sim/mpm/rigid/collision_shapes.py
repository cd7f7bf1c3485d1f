# SPDX-License-Identifier: MIT
"""Collision shapes of rigid bodies and colliders: distance lattices and clusters of contact points. No Taichi.

A ball that touches the ground with the points of a mesh only is a polyhedron: it loses speed at every edge it rolls
over. A quadric is fitted around each point; where it fits, the point stands for a patch of that quadric, and the place
of the patch that faces the partner touches (``rigid_contact.patch``). Where it does not fit, at edges and corners, the
point stands for itself. Vectorised numpy, deterministic. World metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ...errors import InputError
from ...weak_cache import WeakCache
from ..colliders import Surface
from ..geometry.inside_test import bounding_faces
from ..geometry.signed_distance import DistanceLattice, signed_distance
from ..geometry.triangles import Array, Faces, bisected, bounding_box, face_normals, validated
from .rigid_layout import POINT

THIN_OUT = 0.35
"""Contact points closer than this many spacings are thinned out."""


def surface_points(surface: Surface, spacing: float) -> tuple[Array, Array]:
    """Points (K, 3) on a closed surface at which a rigid body touches others, and outward unit normals (K, 3).

    The vertices, and points between them so that the surface is covered by triangles of points with edges of
    ``spacing`` metres at most. Points closer than 0.35 spacings are thinned out: of a dense mesh every place has a
    point within a spacing. First come, and stay, the vertices of the convex hull: those lowest or highest along an
    axis, then those farthest from the middle.

    At a vertex the normal is the mean of its faces', by their area. Parts that lie inside others have no points.

    Raises InputError on a spacing that is not above 0, on a surface that is not closed, is flat or bounds nothing, and
    where it takes too many points.
    """
    if not (math.isfinite(spacing) and spacing > 0):
        raise InputError(f"spacing is {spacing!r}: give metres above 0")
    points, triangles = validated(surface.vertices, surface.faces)
    bounding_box(points[triangles])
    triangles = bounding_faces(points, triangles).triangles
    corners = points[triangles]
    pieces = bisected(corners, spacing)[0]
    count = 3 * len(corners)
    places, inverse = np.unique(
        np.concatenate([corners.reshape(-1, 3), pieces.reshape(-1, 3)]), axis=0, return_inverse=True
    )
    inverse = inverse.reshape(-1)
    given = np.zeros(len(places), dtype=np.bool_)
    given[inverse[:count]] = True
    of_faces = _mean_normals(corners, inverse[:count], len(places))
    of_pieces = _mean_normals(pieces, inverse[count:], len(places))
    normals = np.where(given[:, None], of_faces, of_pieces)
    order = _by_importance(places, given)
    kept = order[_thinned(places[order], THIN_OUT * spacing)]
    return places[kept], normals[kept]


def _mean_normals(corners: Array, corner_of: Faces, number: int) -> Array:
    """Unit normals (number, 3) at places, means by area over the triangles (T, 3, 3) whose corners (3T,) they are."""
    normals, area = face_normals(corners)
    of_corner = np.repeat(normals * area[:, None], 3, axis=0)
    total = np.stack([np.bincount(corner_of, weights=of_corner[:, k], minlength=number) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1)
    # Where the faces cancel out, as on the edge of a fold, any of them.
    single = np.zeros((number, 3))
    has_area = np.repeat(area > 0, 3)
    single[corner_of[has_area]] = np.repeat(normals, 3, axis=0)[has_area]
    scale = np.bincount(corner_of, weights=np.repeat(area, 3), minlength=number)
    cancelled = length <= 1e-9 * scale
    return np.where(cancelled[:, None], single, total / np.where(length > 0, length, 1.0)[:, None])


def _by_importance(places: Array, given: NDArray[np.bool_]) -> Faces:
    """Order of places: hull vertices at an extreme of an axis, other hull vertices, other vertices, the rest."""
    low, high = places.min(axis=0), places.max(axis=0)
    extreme = ((places == low) | (places == high)).any(axis=1)
    vertices = np.flatnonzero(given)
    hull = np.zeros(len(places), dtype=np.bool_)
    try:
        hull[vertices[ConvexHull(places[vertices]).vertices]] = True
    except QhullError:  # as good as flat
        hull[vertices] = True
    rank = np.select([hull & extreme, hull, extreme & given, given], [0, 1, 2, 3], 4)
    distance = np.linalg.norm(places - 0.5 * (low + high), axis=1) / np.linalg.norm(high - low)
    outermost = np.where(hull, -np.round(distance, 6), 0.0)
    # Scrambled, so that thinning does not run through a row of points one by one.
    scrambled = np.arange(len(places), dtype=np.uint64) * np.uint64(2654435761) % np.uint64(2**32)
    return np.lexsort((scrambled, outermost, rank))


def _thinned(places: Array, least: float) -> Faces:
    """Indices of places (N, 3) such that none is closer than ``least`` to one before it."""
    cells = np.floor((places - places.min(axis=0)) / (0.25 * least)).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    pairs = cKDTree(places[first]).query_pairs(least * (1 - 1e-9), output_type="ndarray")
    kept = np.zeros(len(first), dtype=np.bool_)
    open_ = np.ones(len(first), dtype=np.bool_)
    while open_.any():
        behind = np.zeros(len(first), dtype=np.bool_)
        behind[pairs[:, 1]] = True
        chosen = open_ & ~behind
        kept |= chosen
        open_ &= ~chosen
        open_[pairs[chosen[pairs[:, 0]], 1]] = False
        pairs = pairs[open_[pairs].all(axis=1)]
    return first[kept]


NEIGHBOURS = 16
"""Points that a quadric is fitted to."""

FITS = 0.03
"""A quadric fits where its points lie within this share of the spacing of it (root of the mean square)."""

FLAT = 1e-3
"""A surface whose radius of curvature is more than ``spacing / FLAT`` counts as flat."""

PATCH = 11
"""Numbers of a patch: point (3), outer normal (3), direction (3) of the first principal curvature, radii of both
curvatures (0: flat or hollow, does not roll). The smoothness follows as twelfth in ``ShapeArrays.points``."""


def patches(points: Array, normals: Array, spacing: float) -> tuple[Array, NDArray[np.bool_]]:
    """Patches (N, ``PATCH``) for surface points (N, 3) with outer normals (N, 3), and whether (N,) each is smooth."""
    count = len(points)
    out = np.zeros((count, PATCH))
    out[:, :3], out[:, 3:6] = points, normals
    k = min(NEIGHBOURS, count)
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.maximum(np.linalg.norm(first, axis=1), 1e-30)[:, None]
    out[:, 6:9] = first
    if k < 8:
        return out, np.zeros(count, dtype=bool)
    second = np.cross(normals, first)
    near = cKDTree(points).query(points, k=k)[1]
    arms = points[near] - points[:, None]
    x, y, z = (np.einsum("nkc,nc->nk", arms, axis) / spacing for axis in (first, second, normals))
    basis = np.stack([np.ones_like(x), x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=2)
    square = np.einsum("nki,nkj->nij", basis, basis) + 1e-9 * np.eye(6)
    fit = np.linalg.solve(square, np.einsum("nki,nk->ni", basis, z)[..., None])[..., 0]
    residual = np.sqrt(np.mean((np.einsum("nki,ni->nk", basis, fit) - z) ** 2, axis=1))
    facing = np.einsum("nkc,nc->nk", normals[near], normals).min(axis=1) > 0.5
    smooth = (residual < FITS) & facing & (np.hypot(fit[:, 1], fit[:, 2]) < 0.3)
    normal = normals - fit[:, 1:2] * first - fit[:, 2:3] * second
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    # Curvatures of the graph z(x, y), of which the slope is small; bending away from the normal is positive.
    bend = -np.stack([fit[:, [3, 4]], fit[:, [4, 5]]], axis=1)
    curvatures, axes = np.linalg.eigh(bend)
    direction = axes[:, 0, :1] * first + axes[:, 1, :1] * second
    direction -= np.einsum("nc,nc->n", direction, normal)[:, None] * normal
    direction /= np.maximum(np.linalg.norm(direction, axis=1), 1e-30)[:, None]
    radii = np.where(curvatures > FLAT, spacing / np.maximum(curvatures, FLAT), 0.0)
    bent = smooth & (radii > 0).any(axis=1)
    out[bent, :3] += spacing * fit[bent, :1] * normals[bent]
    out[bent, 3:6], out[bent, 6:9], out[bent, 9:11] = normal[bent], direction[bent], radii[bent]
    return out, smooth


NODES = 32
"""Lattice nodes along the side of a cube of the volume of the surface's bounding box."""

FEWEST, MOST = 24, 96
"""Limits of the nodes along the longest side."""

POINTS = 16
"""The same for the surface points."""

FLAT_CELL = 2.5
"""Flat parts keep one point in each cube of so many spacings. Corners and edges touch them, and those have
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


_LATTICES: WeakCache[Surface, DistanceLattice] = WeakCache()
_POINTS: WeakCache[Surface, PointSet] = WeakCache()


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
    """Lattices as in the last three arrays of ``ShapeArrays``."""

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
