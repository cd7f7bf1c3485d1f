# SPDX-License-Identifier: MIT
"""Fill a closed mesh with particles. No Taichi; vectorised numpy, deterministic.

A lattice of the particle spacing is fitted to the mesh's bounding box and cut by the mesh: a point is inside where the
winding number along its vertical line is not zero (parity, where the faces are not consistently oriented). The same
test on a lattice three times finer gives each particle its share of the volume and finds parts so thin that the
lattice misses them; these get particles of their own.

Matter that falls apart would show the lattice. Scattered particles are therefore moved off it by up to a spacing along
each axis, then evened out by Lloyd's iteration: like blue noise, neither in rows nor crowded. (From half a spacing, one
in each cell, the iteration finds its way back to the lattice.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...errors import InputError
from .inside_test import inside_lattice
from .triangles import Array, Faces, check_closed, signed_volume, validated

MIN_PARTICLES = 8
"""Minimum number of particles of a body: one grid cell of them at the usual density."""

FINE = 3
"""Test points per particle spacing and axis."""

MAX_FINE_POINTS = 400_000_000
"""Maximum number of test points, about 1.2 GB of memory."""

EVENING = 3
"""Steps of Lloyd's iteration: the closest pair of scattered particles is then about half a spacing apart."""

COVERED = 0.9
"""A test point is covered by a particle within this many spacings (half a lattice cell's diagonal is 0.87)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class InteriorSample:
    """Particles in a mesh."""

    positions: Array
    """(N, 3), in the mesh's units and frame."""

    volumes: Array
    """(N,), cubic units; their sum is the mesh's volume."""

    contact_radii: Array
    """(N,): distance to the surface, at most half the spacing. Where a particle this far above a plane touches it,
    the mesh's surface touches it."""


def sample_interior(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    spacing: float,
    *,
    jitter: float = 0.0,
    seed: int = 0,
    scattered: bool = False,
) -> InteriorSample:
    """Return particles about ``spacing`` apart that fill a closed triangle mesh.

    vertices: (V, 3); faces: (T, 3) indices. Coincident vertices are merged, so seams do not matter.
    spacing: distance between neighbouring particles, in the mesh's units; above 0.
    jitter: random displacement on each axis as a share of the spacing, 0 to 0.45; ``seed`` makes it repeatable.
    scattered: no lattice, but places like blue noise, by ``seed``; ``jitter`` then counts nothing.

    Raises InputError when the mesh is empty, not finite, not closed, has no volume, or gets fewer than 8 particles.
    """
    if not (math.isfinite(spacing) and spacing > 0):
        raise InputError(f"spacing is {spacing!r}: give a length above 0 in the mesh's units")
    if not 0 <= jitter <= 0.45:
        raise InputError(f"jitter is {jitter!r}: give a share of the spacing from 0 to 0.45")
    points, triangles = validated(vertices, faces)
    oriented = check_closed(triangles)
    lattice = _lattice_in(points, triangles, spacing, oriented)
    step, fine = lattice.step, lattice.test_points()
    centres = lattice.inside[FINE // 2 :: FINE, FINE // 2 :: FINE, FINE // 2 :: FINE]
    positions = lattice.low + (np.argwhere(centres) + 0.5) * step
    # Number of the particle in each test point's own cell, -1 without one: most points need no search for the nearest.
    own = np.where(centres, np.cumsum(centres).reshape(centres.shape) - 1, -1)
    own = own.repeat(FINE, axis=0).repeat(FINE, axis=1).repeat(FINE, axis=2)[lattice.inside]
    on_lattice = len(positions)
    positions = _cover_thin_parts(positions, fine[own < 0], lattice)
    if len(positions) < MIN_PARTICLES:
        raise _too_few(len(positions), spacing, lattice.extent)
    rng = np.random.default_rng(seed)
    if scattered:
        positions = _scattered(positions, fine, lattice, rng)
    owners, unknown = own.copy(), own < 0
    if scattered or len(positions) > on_lattice:
        unknown[:] = True
    owners[unknown] = cKDTree(positions / step).query(fine[unknown] / step)[1]
    shares = np.maximum(np.bincount(owners, minlength=len(positions)), 1).astype(np.float64)
    volume = abs(signed_volume(points, triangles)) if oriented else float(step.prod()) * len(fine) / FINE**3
    if jitter and not scattered:
        # After the volumes, so that all worlds of other seeds weigh the same.
        positions = lattice.kept_inside(positions + rng.uniform(-jitter, jitter, positions.shape) * step, positions)
    return InteriorSample(
        positions=positions,
        volumes=shares * (volume / shares.sum()),
        contact_radii=np.minimum(0.5 * spacing, _surface_distance(points, triangles, positions, spacing)),
    )


@dataclass(frozen=True, eq=False)
class _Lattice:
    """Cells of about the particle spacing in a mesh's bounding box, each with ``FINE``³ test points.

    low: (3,) the box's corner. step: (3,) edges of a cell. counts: (3,) of cells. inside: (3 counts) which test points
    the mesh holds.
    """

    low: Array
    step: Array
    counts: NDArray[np.int64]
    inside: NDArray[np.bool_]

    @property
    def extent(self) -> Array:
        return self.step * self.counts

    def test_points(self) -> Array:
        """Return the places (N, 3) of those inside."""
        return np.asarray(self.low + (np.argwhere(self.inside) + 0.5) * (self.step / FINE))

    def kept_inside(self, moved: Array, before: Array) -> Array:
        """Return ``moved`` particles (N, 3) where their test points are inside, else where they were ``before``."""
        index = np.floor((moved - self.low) / (self.step / FINE)).astype(np.int64)
        boxed = ((index >= 0) & (index < self.counts * FINE)).all(axis=1)
        index = np.clip(index, 0, self.counts * FINE - 1)
        return np.where((boxed & self.inside[index[:, 0], index[:, 1], index[:, 2]])[:, None], moved, before)


def _lattice_in(points: Array, triangles: Faces, spacing: float, oriented: bool) -> _Lattice:
    """Return the lattice of a mesh. Raises InputError where that has no volume, or too much or too little for it."""
    low, high = points[triangles].min(axis=(0, 1)), points[triangles].max(axis=(0, 1))
    extent = high - low
    signed = signed_volume(points, triangles)
    if not np.min(extent) > 1e-12 * np.max(extent) or (oriented and abs(signed) <= 1e-9 * extent.prod()):
        raise InputError(
            f"mesh has no volume (bounding box {extent[0]:g} x {extent[1]:g} x {extent[2]:g}, volume {abs(signed):g}): "
            "give it thickness"
        )
    counts = np.maximum(1, np.rint(extent / spacing).astype(np.int64))
    if float(np.prod(counts.astype(float))) * FINE**3 > MAX_FINE_POINTS:
        raise InputError(
            f"spacing is {spacing:g} for a mesh of {extent[0]:g} x {extent[1]:g} x {extent[2]:g}: give a larger spacing"
        )
    step = extent / counts
    inside = inside_lattice(points, triangles, low, step / FINE, counts * FINE, oriented)
    if not inside.any():
        raise _too_few(0, spacing, extent)
    return _Lattice(low, step, counts, inside)


def _scattered(positions: Array, fine: Array, lattice: _Lattice, rng: np.random.Generator) -> Array:
    """Return particles at ``positions`` (N, 3) moved off the lattice, then evened out over test points ``fine``."""
    step = lattice.step
    positions = lattice.kept_inside(positions + rng.uniform(-1.0, 1.0, positions.shape) * step, positions)
    # Means of a lattice's points would be drawn to its planes.
    strewn = fine + rng.uniform(-0.5, 0.5, fine.shape) * (step / FINE)
    for _ in range(EVENING):
        owners = cKDTree(positions / step).query(strewn / step)[1]
        size = np.bincount(owners, minlength=len(positions))
        sums = np.stack([np.bincount(owners, strewn[:, c], minlength=len(positions)) for c in range(3)], axis=1)
        middle = np.where(size[:, None] > 0, sums / np.maximum(size, 1)[:, None], positions)
        positions = lattice.kept_inside(middle, positions)
    return positions


def _too_few(count: int, spacing: float, extent: Array) -> InputError:
    return InputError(
        f"mesh of {extent[0]:g} x {extent[1]:g} x {extent[2]:g} gets {count} particles at a spacing of {spacing:g}, "
        f"fewer than {MIN_PARTICLES}: use a finer grid (solver option grid), a larger similarity scale, or a "
        "larger mesh"
    )


def _cover_thin_parts(positions: Array, fine: Array, lattice: _Lattice) -> Array:
    """Return the particles with one more in each lattice cell whose inside test points ``fine`` have none nearby."""
    low, step, counts = lattice.low, lattice.step, lattice.counts
    if len(positions):
        distance = cKDTree(positions / step).query(fine / step, distance_upper_bound=COVERED)[0]
        fine = fine[~np.isfinite(distance)]
    if len(fine) == 0:
        return positions
    cells = np.clip(((fine - low) / step).astype(np.int64), 0, counts - 1)
    key = (cells[:, 0] * counts[1] + cells[:, 1]) * counts[2] + cells[:, 2]
    _, group = np.unique(key, return_inverse=True)
    group = group.reshape(-1)
    size = np.bincount(group)
    centre = np.stack([np.bincount(group, weights=fine[:, c]) / size for c in range(3)], axis=1)
    # The centre of a bent part may lie outside; the test point nearest to it does not.
    distance2 = (((fine - centre[group]) / step) ** 2).sum(axis=1)
    order = np.lexsort((distance2, group))
    nearest = order[np.concatenate([[0], np.cumsum(size)[:-1]])]
    return np.concatenate([positions, fine[nearest]])


def _surface_distance(points: Array, triangles: Faces, positions: Array, spacing: float) -> Array:
    """Return the distance of ``positions`` to the plane of the nearest face, inf beyond ``spacing``."""
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    corners, normals = corners[lengths > 0], normals[lengths > 0] / lengths[lengths > 0, None]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    divisions = np.minimum(np.ceil(edges / (spacing / 3)).astype(np.int64), 2000)
    seeds, owners = [], []
    for n in np.unique(divisions):
        which = np.flatnonzero(divisions == n)
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        inside = i + j <= n
        u, v = i[inside] / n, j[inside] / n
        bary = np.stack([1 - u - v, u, v], axis=1)
        seeds.append(np.einsum("sb,tbc->tsc", bary, corners[which]).reshape(-1, 3))
        owners.append(np.repeat(which, len(bary)))
    seed_points, seed_faces = np.concatenate(seeds), np.concatenate(owners)
    distance, nearest = cKDTree(seed_points).query(positions, distance_upper_bound=1.5 * spacing)
    result = np.full(len(positions), np.inf)
    near = np.isfinite(distance)
    offset = positions[near] - seed_points[nearest[near]]
    result[near] = np.abs(np.einsum("ij,ij->i", offset, normals[seed_faces[nearest[near]]]))
    return result
