# SPDX-License-Identifier: MIT
"""The inside of an object of which a closed surface or only points are known, as signed distances. No Taichi."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from ...errors import InputError
from ...mpm.colliders import Surface
from ...mpm.distance import DistanceLattice
from ...mpm.triangles import check_closed, inside_lattice, validated

Array = NDArray[np.float64]

NODES = 48
"""Lattice nodes along the longest side of the object."""

AROUND = 4
"""Nodes around the object."""

CLOSING = 2.5
"""Distances between neighbouring points that a gap in a skin of points may be wide and still count as closed."""


def solid_of_surface(surface: Surface) -> DistanceLattice:
    """Distances to a closed surface, negative inside, right to half a node. Raises InputError where it is open."""
    points, triangles = validated(surface.vertices, surface.faces)
    oriented = check_closed(triangles)
    low = points[triangles].min(axis=(0, 1))
    extent = points[triangles].max(axis=(0, 1)) - low
    spacing = float(extent.max()) / NODES
    origin = low - AROUND * spacing
    counts = np.ceil(extent / spacing).astype(np.int64) + 1 + 2 * AROUND
    inside = inside_lattice(points, triangles, origin - 0.5 * spacing, np.full(3, spacing), counts, oriented)
    # Between an inner and an outer node the surface runs in the middle; smoothing takes the steps out of that.
    steps = np.where(inside, 0.5 - distance_transform_edt(inside), distance_transform_edt(~inside) - 0.5)
    distances = spacing * gaussian_filter(steps, 0.7)
    return DistanceLattice(origin=origin, spacing=spacing, distances=distances.astype(np.float32))


def solid_of_points(points: Array) -> DistanceLattice:
    """Distances to what points (N, 3) enclose: they swell until gaps close, holes are filled, and all shrinks back.

    A skin whose gaps are wider than 2.5 times the usual distance between neighbours has no inside; what is left then
    is the skin itself. Raises InputError for fewer than 8 points, or points all in one place.
    """
    if len(points) < 8 or not np.ptp(points, axis=0).max() > 0:
        raise InputError(f"physical body: {len(points)} points have no extent: give at least 8 in different places")
    tree = cKDTree(points)
    apart = float(np.median(tree.query(points, k=min(4, len(points)))[0][:, -1]))
    size = float(np.ptp(points, axis=0).max())
    spacing = size / NODES
    reach = max(0.5 * CLOSING * apart, spacing)
    low = points.min(axis=0) - reach - 3 * spacing
    shape = np.ceil((np.ptp(points, axis=0) + 2 * reach + 6 * spacing) / spacing).astype(np.int64) + 1
    nodes = low + spacing * np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    gap = tree.query(nodes.reshape(-1, 3), distance_upper_bound=4 * reach)[0].reshape(tuple(shape))
    swollen = binary_fill_holes(gap <= reach)
    # Inside, the distance to the swollen skin is measured on nodes; outside, to the points themselves.
    depth = distance_transform_edt(swollen) * spacing - 0.5 * spacing - reach
    distances = np.where(swollen, -depth, np.minimum(gap, 4 * reach) + 0.0)
    return DistanceLattice(origin=low, spacing=spacing, distances=distances.astype(np.float32))


def filling(solid: DistanceLattice, spacing: float, points: Array) -> Array:
    """Places (M, 3) ``spacing`` metres apart in the inside, none within 0.6 spacings of one of ``points`` (N, 3)."""
    first = solid.origin + 0.5 * spacing
    counts = np.maximum(1, np.floor((solid.high - first) / spacing)).astype(np.int64)
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    places = first + spacing * lattice
    places = places[solid.at(places)[0] < -0.25 * spacing]
    if len(places) == 0:
        return places
    beside = cKDTree(points).query(places, distance_upper_bound=0.6 * spacing)[0]
    return np.asarray(places[~np.isfinite(beside)])


def volumes_of(solid: DistanceLattice, spacing: float, particles: Array) -> Array:
    """Volume (N,) in m³ of the inside that is nearest to each particle (N, 3), looked at in places ``spacing`` apart.

    A particle to which no place is nearest gets an eighth of one place's share.
    """
    counts = np.maximum(1, np.floor((solid.high - solid.origin) / spacing)).astype(np.int64)
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    places = solid.origin + spacing * (lattice + 0.5)
    places = places[solid.at(places)[0] < 0]
    owners = cKDTree(particles).query(places)[1]
    return np.maximum(np.bincount(owners, minlength=len(particles)), 0.125) * spacing**3
