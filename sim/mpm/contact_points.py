# SPDX-License-Identifier: MIT
"""The points by which a rigid body touches others. No Taichi.

Vectorised numpy, deterministic. World metres.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ..errors import InputError
from .colliders import Surface
from .triangles import (
    Array,
    Faces,
    bisected,
    bounding_box,
    bounding_faces,
    face_normals,
    validated,
)

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
    # Scrambled, lest thinning out runs through a row of points one by one.
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
