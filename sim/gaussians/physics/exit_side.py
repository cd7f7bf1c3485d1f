# SPDX-License-Identifier: MIT
"""To which side of an obstacle matter that is in it, or behind it, has to leave. No Taichi.

The distance to a thin wall sends what is in it to its nearer side. A finger too thick for its ring would leak to the
ring's outside: its skin lies in the outer half of the wall, or beyond. What it should do instead is told by the
finger itself. From every place of a body a path leads up its depth, to its middle. Where this path enters the obstacle
and leaves it again, the place is behind a wall: matter may be there no more than in the wall. So the region that is
closed to the body is

    U = W ∪ S,     S = { x : the path of steepest ascent of the depth of B from x crosses W and leaves it within B }

and the distance to U, in place of that to W, leads everything out on the side of the body's middle. Where the obstacle
reaches the middle itself, no path leaves it, S is empty there, and the nearest side is as good as any other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, distance_transform_edt

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

AROUND = 4.0
"""Lattice spacings around the obstacle in which its shadow is looked for, besides the depth of what it is in."""


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
    return _with_shadow(lattice, _shadow(lattice, body, depth))


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


def _shadow(lattice: DistanceLattice, body: DistanceLattice, deepest: float) -> NDArray[np.bool_]:
    """Nodes (nx, ny, nz) outside of the obstacle that are behind it, seen from the body's middle."""
    shape, step = lattice.distances.shape, lattice.spacing
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    places = lattice.origin + step * index
    own = lattice.distances.reshape(-1)
    depth, uphill = body.at(places)
    depth, uphill = -depth, -uphill
    climbing = (own >= 0) & (depth < deepest)
    index, places, depth, uphill = index[climbing], places[climbing], depth[climbing], uphill[climbing]
    behind = np.zeros(len(index), dtype=np.bool_)
    entered = np.zeros(len(index), dtype=np.bool_)
    walking = np.arange(len(index))
    pace = PACE * step
    while len(walking):
        # Far from the obstacle and outside of the body nothing is missed by long strides.
        distance = lattice.at(places)[0]
        stride = np.maximum(pace, 0.5 * np.where(depth < 0, np.minimum(np.abs(distance), -depth), 0.0))
        direction = uphill / np.maximum(np.linalg.norm(uphill, axis=1), 1e-12)[:, None]
        places = places + stride[:, None] * direction
        higher, uphill = body.at(places)
        higher, uphill = -higher, -uphill
        distance = lattice.at(places)[0]
        left = entered[walking] & (distance > 0) & (higher > 0)
        behind[walking[left]] = True
        entered[walking[distance < 0]] = True
        # Beyond the obstacle's deepest place nothing is entered any more; on the middle the depth no longer grows.
        goes_on = ~left & (higher > depth + 0.1 * stride) & (entered[walking] | (higher < deepest))
        walking, places, depth, uphill = walking[goes_on], places[goes_on], higher[goes_on], uphill[goes_on]
    shadow = np.zeros(shape, dtype=np.bool_)
    shadow[tuple(index[behind].T)] = True
    return shadow


def _with_shadow(lattice: DistanceLattice, shadow: NDArray[np.bool_]) -> DistanceLattice:
    """Distances to the union of the obstacle and the shadow, exact to a lattice spacing in the shadow."""
    if not shadow.any():
        return lattice
    own, step = lattice.distances.astype(np.float64), lattice.spacing
    closed = binary_closing(np.pad(shadow | (own < 0), 2), np.ones((3, 3, 3)))[2:-2, 2:-2, 2:-2] | shadow | (own < 0)
    # What the closing added where the body's middle lies is a rounded corner of a wall: it stays free.
    closed &= (own < 0) | shadow | (distance_transform_edt(~shadow) <= 1.5)
    inner, nearest = distance_transform_edt(closed, return_indices=True)
    # The way to a free node leads beyond the surface by as much as that node is away from it.
    beyond = np.minimum(own[tuple(nearest)], 0.5 * step)
    inside = np.maximum(step * inner - np.maximum(beyond, 0.0), np.maximum(-own, 1e-3 * step))
    outer = np.minimum(own, step * distance_transform_edt(~(closed & (own >= 0))) - 0.5 * step)
    distances = np.where(closed, -inside, np.maximum(outer, np.minimum(own, 1e-3 * step)))
    return DistanceLattice(origin=lattice.origin, spacing=step, distances=distances.astype(np.float32))
