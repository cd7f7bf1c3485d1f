# SPDX-License-Identifier: MIT
"""To which side of an obstacle matter that is in it, or behind it, has to leave. No Taichi.

The distance to a thin wall sends what is in it to its nearer side. A finger too thick for its ring would leak to the
ring's outside: its skin lies in the outer half of the wall, or beyond. What it should do instead is told by the
finger itself. From every place of a body a path leads up its depth, to its middle. Where this path enters the obstacle
and leaves it again, the place is behind a wall: matter may be there no more than in the wall. So the region that is
closed to the body is

    U = W ∪ S,     S = { x : the path of steepest ascent of the depth of B from x crosses W and leaves it within B }

and the length of the path to where it leaves W takes the place of the distance to W's surface: everything is led out on
the side of the body's middle, unless the rim of U is much nearer. Where the obstacle reaches the middle itself, no path
leaves it, S is empty there, and the nearest side is as good as any other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from ...mpm.colliders import Surface
from ...mpm.distance import DistanceLattice, signed_distance
from ...mpm.triangles import check_closed, face_normals, signed_volume, validated

Array = NDArray[np.float64]

FINEST, COARSEST = 128, 40
"""Lattice nodes along the longest side of an obstacle, from thin walls to a ball."""

NODES_IN_WALL = 3.0
"""Lattice spacings in the thickness of a wall."""

PACE = 0.6
"""Lattice spacings by which a path is followed at a time."""

SHELL = 2.5
"""Lattice spacings around the obstacle in which paths are followed."""

SIDEWAYS = 4.0
"""Times that the way to the rim of the closed region must be shorter than the way inward to be taken instead."""

AROUND = 4.0
"""Lattice spacings around the obstacle that the lattice spans, besides the depth of what it is in."""


def obstacle_lattice(surface: Surface, body: DistanceLattice, *, exit_side: str) -> DistanceLattice:
    """Signed distances in metres to what is closed to a body, fine enough for the surface's walls.

    body: signed distances of the body's inside. exit_side: "bulk" for U, "nearest" for the obstacle W alone.
    Raises InputError when the surface is not closed or is flat.
    """
    spacing = lattice_spacing(surface)
    depth = _deepest(surface, body, spacing) if exit_side == "bulk" else 0.0
    lattice = signed_distance(surface, spacing, margin=(depth + AROUND * spacing) if depth > 0 else 3 * spacing)
    if depth <= 0:
        return lattice
    return _with_shadow(lattice, _inward(lattice, body, depth))


def lattice_spacing(surface: Surface) -> float:
    """Metres between nodes: a third of the mean thickness 2 V / A, within 1/128 and 1/40 of the longest side."""
    points, triangles = validated(surface.vertices, surface.faces)
    check_closed(triangles)
    size = float(np.ptp(points[triangles].reshape(-1, 3), axis=0).max())
    area = float(face_normals(points[triangles])[1].sum())
    thickness = 2.0 * abs(signed_volume(points, triangles)) / max(area, 1e-300)
    return float(np.clip(thickness / NODES_IN_WALL, size / FINEST, size / COARSEST))


def _deepest(surface: Surface, body: DistanceLattice, spacing: float) -> float:
    """How deep in the body the obstacle reaches, in metres; 0 where it does not."""
    corners = surface.vertices[surface.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    pieces = int(np.clip(np.ceil(longest / (2 * spacing)), 1, 12))
    i, j = np.meshgrid(np.arange(pieces + 1), np.arange(pieces + 1), indexing="ij")
    held = i + j <= pieces
    u, v = i[held] / pieces, j[held] / pieces
    shares = np.stack([1 - u - v, u, v], axis=1)
    places = np.einsum("sb,tbc->tsc", shares, corners).reshape(-1, 3)
    depth = -float(body.at(places)[0].min())
    return depth + spacing if depth > 0 else 0.0


def _inward(lattice: DistanceLattice, body: DistanceLattice, deepest: float) -> Array:
    """Metres (nx, ny, nz) along the path from each node to where it leaves the obstacle for good; inf: not in U."""
    step, own = lattice.spacing, lattice.distances
    near = own < SHELL * step
    index = np.argwhere(near)
    places = lattice.origin + step * index
    entered = own[near] < 0
    depth, uphill = body.at(places)
    depth, uphill = -depth, -uphill
    left_after = np.full(len(index), np.inf)
    length = np.zeros(len(index))
    distance = own[near].astype(np.float64)
    walking = np.flatnonzero(depth < deepest)
    places, depth, uphill = places[walking], depth[walking], uphill[walking]
    pace = PACE * step
    while len(walking):
        before = distance[walking]
        # Far from the obstacle and outside of the body nothing is missed by long strides.
        stride = np.where(depth < 0, np.maximum(pace, 0.5 * np.minimum(np.abs(before), -depth)), pace)
        places = places + (stride / np.maximum(np.linalg.norm(uphill, axis=1), 1e-12))[:, None] * uphill
        higher, uphill = body.at(places)
        higher, uphill = -higher, -uphill
        now = lattice.at(places)[0]
        leaves = entered[walking] & (before <= 0) & (now > 0) & (higher > 0)
        share = before[leaves] / (before[leaves] - now[leaves])
        left_after[walking[leaves]] = length[walking[leaves]] + share * stride[leaves]
        entered[walking] |= now < 0
        distance[walking] = now
        length[walking] += stride
        # Beyond the obstacle's deepest place nothing is entered any more; on the middle the depth no longer grows.
        goes_on = (higher > depth + 0.1 * stride) & ((now < 0) | (higher < deepest))
        # What ends in the obstacle has no side to leave on.
        left_after[walking[~goes_on & (now < 0)]] = np.inf
        walking, places, depth, uphill = walking[goes_on], places[goes_on], higher[goes_on], uphill[goes_on]
    result = np.full(own.shape, np.inf)
    result[near] = left_after
    # Farther away, a place is on the side of the obstacle that is nearest to it.
    away, nearest = distance_transform_edt(~near, return_indices=True)
    deep = -body.at(lattice.origin + step * np.indices(own.shape).reshape(3, -1).T)[0].reshape(own.shape)
    return np.where(near | (deep < deepest), result[tuple(nearest)] + step * away, np.inf)


def _with_shadow(lattice: DistanceLattice, inward: Array) -> DistanceLattice:
    """Distances to U; within it the way inward, or ``SIDEWAYS`` times the way to its nearest rim if that is less."""
    own, step = lattice.distances.astype(np.float64), lattice.spacing
    covered = np.isfinite(inward)
    closed = covered | (own < 0)
    if not (covered & (own >= 0)).any():
        return lattice
    inner, nearest = distance_transform_edt(closed, return_indices=True)
    # The way to a free node leads beyond the surface by as much as that node is away from it.
    rim = np.maximum(step * inner - np.clip(own[tuple(nearest)], 0.0, 0.5 * step), 0.01 * step)
    inside = np.where(covered, np.minimum(inward, SIDEWAYS * np.maximum(rim, -own)), -own)
    outer = np.minimum(own, step * (distance_transform_edt(~(closed & (own >= 0))) - 0.5))
    distances = np.where(closed, -inside, outer)
    return DistanceLattice(origin=lattice.origin, spacing=step, distances=distances.astype(np.float32))
