# SPDX-License-Identifier: MIT
"""Signed distances: to the inside of a body known by its surface or points, and to obstacles by the side to leave on.

The distance to a thin wall sends what is in it to its nearer side. A finger too thick for its ring would leak to the
ring's outside: its skin lies in the outer half of the wall, or beyond. The finger itself shows what should happen
instead. From every point of a body a path leads up its depth, to its middle. Where this path enters the obstacle and
leaves it again, the point is behind a wall: material may be there no more than in the wall. So the region that is
closed to the body B is

    U = W ∪ S,     S = { x : the path of steepest ascent of the depth of B from x crosses W and leaves it within B }

and the length of the path to where it leaves W replaces the distance to W's surface: everything leaves on the side of
the body's middle, unless the rim of U is much nearer. Where the obstacle reaches the middle itself, no path leaves
it, S is empty there, and the nearest side is as good as any other. No Taichi."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from ...errors import InputError
from ...mpm.colliders import Surface
from ...mpm.geometry.inside_test import inside_lattice
from ...mpm.geometry.signed_distance import DistanceLattice, signed_distance
from ...mpm.geometry.triangles import check_closed, face_normals, signed_volume, validated

Array = NDArray[np.float64]

BODY_NODES = 48
"""Lattice nodes along the longest side of the body."""

BODY_MARGIN = 4
"""Lattice nodes around the body."""

MAX_GAP = 2.5
"""Largest gap in a shell of points that counts as closed, in distances between neighbouring points."""


def surface_distances(surface: Surface) -> DistanceLattice:
    """Return signed distances to a closed surface, m, negative inside, accurate to half a node.

    Raises InputError where it is open.
    """
    points, triangles = validated(surface.vertices, surface.faces)
    oriented = check_closed(triangles)
    low = points[triangles].min(axis=(0, 1))
    extent = points[triangles].max(axis=(0, 1)) - low
    spacing = float(extent.max()) / BODY_NODES
    origin = low - BODY_MARGIN * spacing
    counts = np.ceil(extent / spacing).astype(np.int64) + 1 + 2 * BODY_MARGIN
    inside = inside_lattice(points, triangles, origin - 0.5 * spacing, np.full(3, spacing), counts, oriented)
    # The surface runs midway between inner and outer nodes; smoothing removes the steps.
    steps = np.where(inside, 0.5 - distance_transform_edt(inside), distance_transform_edt(~inside) - 0.5)
    distances = spacing * gaussian_filter(steps, 0.7)
    return DistanceLattice(origin=origin, spacing=spacing, distances=distances.astype(np.float32))


def point_cloud_distances(points: Array) -> DistanceLattice:
    """Return signed distances, m, to the region that points (N, 3) enclose: dilate, fill holes, erode.

    A shell with gaps wider than 2.5 times the usual distance between neighbours has no inside; the result is then the
    shell itself. Raises InputError for fewer than 8 points, or points all in one place.
    """
    if len(points) < 8 or not np.ptp(points, axis=0).max() > 0:
        raise InputError(f"physical body: {len(points)} points have no extent: give at least 8 in different places")
    tree = cKDTree(points)
    apart = float(np.median(tree.query(points, k=min(4, len(points)))[0][:, -1]))
    size = float(np.ptp(points, axis=0).max())
    spacing = size / BODY_NODES
    reach = max(0.5 * MAX_GAP * apart, spacing)
    low = points.min(axis=0) - reach - 3 * spacing
    shape = np.ceil((np.ptp(points, axis=0) + 2 * reach + 6 * spacing) / spacing).astype(np.int64) + 1
    nodes = low + spacing * np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    gap = tree.query(nodes.reshape(-1, 3), distance_upper_bound=4 * reach)[0].reshape(tuple(shape))
    swollen = binary_fill_holes(gap <= reach)
    # Inside, the distance to the dilated shell is measured between nodes; outside, to the points themselves.
    depth = distance_transform_edt(swollen) * spacing - 0.5 * spacing - reach
    distances = np.where(swollen, -depth, np.minimum(gap, 4 * reach) + 0.0)
    return DistanceLattice(origin=low, spacing=spacing, distances=distances.astype(np.float32))


def fill_points(solid: DistanceLattice, spacing: float, points: Array) -> Array:
    """Return points (M, 3) ``spacing`` metres apart in the inside, none within 0.6 spacings of ``points`` (N, 3)."""
    first = solid.origin + 0.5 * spacing
    counts = np.maximum(1, np.floor((solid.high - first) / spacing)).astype(np.int64)
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    places = first + spacing * lattice
    places = places[solid.at(places)[0] < -0.25 * spacing]
    if len(places) == 0:
        return places
    beside = cKDTree(points).query(places, distance_upper_bound=0.6 * spacing)[0]
    return np.asarray(places[~np.isfinite(beside)])


def particle_volumes(solid: DistanceLattice, spacing: float, particles: Array) -> Array:
    """Return the volume (N,) in m³ of the inside nearest to each particle (N, 3), sampled at ``spacing`` metres.

    A particle without any sample gets an eighth of a sample's volume.
    """
    counts = np.maximum(1, np.floor((solid.high - solid.origin) / spacing)).astype(np.int64)
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    places = solid.origin + spacing * (lattice + 0.5)
    places = places[solid.at(places)[0] < 0]
    owners = cKDTree(particles).query(places)[1]
    return np.maximum(np.bincount(owners, minlength=len(particles)), 0.125) * spacing**3


MAX_NODES, MIN_NODES = 128, 40
"""Lattice nodes along the longest side of an obstacle, from thin walls to a sphere."""

WALL_NODES = 3.0
"""Lattice spacings across the thickness of a wall."""

PATH_STEP = 0.6
"""Lattice spacings of a step along a path."""

PATH_SHELL = 2.5
"""Lattice spacings around the obstacle in which paths are followed."""

RIM_PREFERENCE = 4.0
"""Factor by which the way to the rim of the closed region must be shorter than the way inward to be preferred."""

OBSTACLE_MARGIN = 4.0
"""Lattice spacings around the obstacle, besides the depth of the penetration."""


def obstacle_lattice(surface: Surface, body: DistanceLattice, *, exit_side: str) -> DistanceLattice:
    """Return signed distances in metres to the region closed to a body, resolving the surface's walls.

    body: signed distances of the body's inside. exit_side: "bulk" for U, "nearest" for the obstacle W alone.
    Raises InputError when the surface is open or flat.
    """
    spacing = lattice_spacing(surface)
    depth = _deepest_penetration(surface, body, spacing) if exit_side == "bulk" else 0.0
    lattice = signed_distance(
        surface, spacing, margin=(depth + OBSTACLE_MARGIN * spacing) if depth > 0 else 3 * spacing
    )
    if depth <= 0:
        return lattice
    return _with_closed_region(lattice, _exit_lengths(lattice, body, depth))


def lattice_spacing(surface: Surface) -> float:
    """Return metres between nodes: a third of the mean thickness 2 V / A, within 1/128 and 1/40 of the longest side."""
    points, triangles = validated(surface.vertices, surface.faces)
    check_closed(triangles)
    size = float(np.ptp(points[triangles].reshape(-1, 3), axis=0).max())
    area = float(face_normals(points[triangles])[1].sum())
    thickness = 2.0 * abs(signed_volume(points, triangles)) / max(area, 1e-300)
    return float(np.clip(thickness / WALL_NODES, size / MAX_NODES, size / MIN_NODES))


def _deepest_penetration(surface: Surface, body: DistanceLattice, spacing: float) -> float:
    """Return the depth of the obstacle in the body in metres; 0 where they do not overlap."""
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


def _exit_lengths(lattice: DistanceLattice, body: DistanceLattice, deepest: float) -> Array:
    """Return (nx, ny, nz) metres along the path from each node to where it leaves the obstacle; inf: not in U."""
    step, own = lattice.spacing, lattice.distances
    near = own < PATH_SHELL * step
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
    pace = PATH_STEP * step
    while len(walking):
        before = distance[walking]
        # Far from the obstacle and outside the body long strides miss nothing.
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
        # Beyond the obstacle's deepest point nothing more is entered; at the middle the depth no longer grows.
        goes_on = (higher > depth + 0.1 * stride) & ((now < 0) | (higher < deepest))
        # A path that ends in the obstacle has no exit side.
        left_after[walking[~goes_on & (now < 0)]] = np.inf
        walking, places, depth, uphill = walking[goes_on], places[goes_on], higher[goes_on], uphill[goes_on]
    result = np.full(own.shape, np.inf)
    result[near] = left_after
    # Farther away, a node is on the side of the obstacle nearest to it.
    away, nearest = distance_transform_edt(~near, return_indices=True)
    deep = -body.at(lattice.origin + step * np.indices(own.shape).reshape(3, -1).T)[0].reshape(own.shape)
    return np.where(near | (deep < deepest), result[tuple(nearest)] + step * away, np.inf)


def _with_closed_region(lattice: DistanceLattice, inward: Array) -> DistanceLattice:
    """Return distances to U; inside, the way inward, or ``RIM_PREFERENCE`` times the way to the rim if less."""
    own, step = lattice.distances.astype(np.float64), lattice.spacing
    covered = np.isfinite(inward)
    closed = covered | (own < 0)
    if not (covered & (own >= 0)).any():
        return lattice
    inner, nearest = distance_transform_edt(closed, return_indices=True)
    # The distance to a free node exceeds that to the surface by the node's own distance.
    rim = np.maximum(step * inner - np.clip(own[tuple(nearest)], 0.0, 0.5 * step), 0.01 * step)
    inside = np.where(covered, np.minimum(inward, RIM_PREFERENCE * np.maximum(rim, -own)), -own)
    outer = np.minimum(own, step * (distance_transform_edt(~(closed & (own >= 0))) - 0.5))
    distances = np.where(closed, -inside, outer)
    return DistanceLattice(origin=lattice.origin, spacing=step, distances=distances.astype(np.float32))
