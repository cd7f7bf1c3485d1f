# SPDX-License-Identifier: MIT
"""Fill a closed mesh with particles. No Taichi; vectorised numpy, deterministic.

A lattice of the particle spacing is fitted to the mesh's bounding box and cut by the mesh: a point is inside where the
winding number along its vertical line is not zero (parity, where the faces are not consistently oriented). The same
test on a lattice three times finer gives each particle its share of the volume and finds parts so thin that the
lattice misses them; these get particles of their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import InputError

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

MIN_PARTICLES = 8
"""Fewest particles that make a body: one grid cell's worth at the usual density."""

FINE = 3
"""Test points per particle spacing and axis."""

MAX_FINE_POINTS = 400_000_000
"""Largest lattice that is tried, about 1.2 GB of memory."""

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
) -> InteriorSample:
    """Particles about ``spacing`` apart through the whole inside of a closed triangle mesh.

    vertices: (V, 3); faces: (T, 3) indices. Vertices in the same place are taken as one, so seams do no harm.
    spacing: distance between neighbouring particles, in the mesh's units; above 0.
    jitter: random displacement on each axis as a share of the spacing, 0 to 0.45; ``seed`` makes it repeatable.

    Raises InputError when the mesh is empty, not finite, not closed, has no volume, or gets fewer than 8 particles.
    """
    if not (math.isfinite(spacing) and spacing > 0):
        raise InputError(f"spacing is {spacing!r}: give a length above 0 in the mesh's units")
    if not 0 <= jitter <= 0.45:
        raise InputError(f"jitter is {jitter!r}: give a share of the spacing from 0 to 0.45")
    points, triangles = _validated(vertices, faces)
    oriented = _check_closed(triangles)
    low, high = points[triangles].min(axis=(0, 1)), points[triangles].max(axis=(0, 1))
    extent = high - low
    signed = _signed_volume(points, triangles)
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
    fine_inside = _inside_lattice(points, triangles, low, step / FINE, counts * FINE, oriented)
    if not fine_inside.any():
        raise _too_few(0, spacing, extent)
    centres = fine_inside[FINE // 2 :: FINE, FINE // 2 :: FINE, FINE // 2 :: FINE]
    positions = low + (np.argwhere(centres) + 0.5) * step
    fine = low + (np.argwhere(fine_inside) + 0.5) * (step / FINE)
    positions = _cover_thin_parts(positions, fine, low, step, counts)
    if len(positions) < MIN_PARTICLES:
        raise _too_few(len(positions), spacing, extent)
    owners = cKDTree(positions / step).query(fine / step)[1]
    shares = np.maximum(np.bincount(owners, minlength=len(positions)), 1).astype(np.float64)
    volume = abs(signed) if oriented else float(step.prod()) * len(fine) / FINE**3
    if jitter:
        rng = np.random.default_rng(seed)
        moved = positions + rng.uniform(-jitter, jitter, positions.shape) * step
        # Keep a jittered particle only where its test point is inside, too.
        index = np.clip(((moved - low) / (step / FINE)).astype(np.int64), 0, counts * FINE - 1)
        keep = fine_inside[index[:, 0], index[:, 1], index[:, 2]]
        positions = np.where(keep[:, None], moved, positions)
    return InteriorSample(
        positions=positions,
        volumes=shares * (volume / shares.sum()),
        contact_radii=np.minimum(0.5 * spacing, _surface_distance(points, triangles, positions, spacing)),
    )


def _too_few(count: int, spacing: float, extent: Array) -> InputError:
    return InputError(
        f"mesh of {extent[0]:g} x {extent[1]:g} x {extent[2]:g} gets {count} particles at a spacing of {spacing:g}, "
        f"fewer than {MIN_PARTICLES}: use a finer grid (solver option grid), a larger similarity scale, or a "
        "larger mesh"
    )


def _validated(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> tuple[Array, Faces]:
    """Vertices merged by place and faces without zero-area ones."""
    points = np.asarray(vertices, dtype=np.float64)
    triangles = np.asarray(faces)
    if points.ndim != 2 or points.shape[1:] != (3,) or len(points) == 0:
        raise InputError(f"vertices has shape {points.shape}: give (V, 3) with V above 0")
    if triangles.ndim != 2 or triangles.shape[1:] != (3,) or len(triangles) == 0:
        raise InputError(f"faces has shape {triangles.shape}: give triangles (T, 3) with T above 0")
    if not np.issubdtype(triangles.dtype, np.integer):
        raise InputError(f"faces has type {triangles.dtype}: give whole numbers")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(f"vertices[{bad[0]}] is {points[bad[0]].tolist()}: remove NaN and infinite coordinates")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise InputError(
            f"faces name vertex {int(triangles.max())} and lowest {int(triangles.min())}: the mesh has {len(points)}"
        )
    unique, inverse = np.unique(points, axis=0, return_inverse=True)
    merged = inverse.reshape(-1)[triangles].astype(np.int64)
    distinct = (merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])
    merged = merged[distinct]
    if len(merged) == 0:
        raise InputError("faces have no area: give a mesh whose triangles have three different corners")
    return unique, merged


def _check_closed(triangles: Faces) -> bool:
    """Whether the faces are consistently oriented. Raises InputError when an edge has an odd number of faces."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    forward = edges[:, 0] < edges[:, 1]
    _, inverse, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    open_edges = int((count % 2 == 1).sum())
    if open_edges:
        raise InputError(
            f"mesh is not closed: {open_edges} of {len(count)} edges have an odd number of faces; fill its holes "
            "(in Blender: Mesh > Clean Up > Fill Holes)"
        )
    balance = np.bincount(inverse.reshape(-1), weights=np.where(forward, 1.0, -1.0))
    return bool((balance == 0).all())


def _signed_volume(points: Array, triangles: Faces) -> float:
    """Volume by the divergence theorem, about the mesh's own centre for precision."""
    corners = points[triangles] - points.mean(axis=0)
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def _inside_lattice(
    points: Array, triangles: Faces, low: Array, step: Array, counts: NDArray[np.int64], oriented: bool
) -> NDArray[np.bool_]:
    """Which points ``low + (i + 0.5) step`` lie inside. Scan lines along z.

    The lines are shifted by a millionth of a step, lest they run through edges between two faces.
    """
    nx, ny, nz = (int(n) for n in counts)
    winding = np.zeros((nx * ny, nz + 1), dtype=np.int16)
    corners = (points[triangles] - low) / step - 0.5
    corners[..., 0] -= 3.1e-6
    corners[..., 1] -= 4.7e-6
    first = np.clip(np.ceil(corners[..., :2].min(axis=1)), 0, [nx, ny]).astype(np.int64)
    last = np.clip(np.floor(corners[..., :2].max(axis=1)), -1, [nx - 1, ny - 1]).astype(np.int64)
    wide = np.maximum(last - first + 1, 0)
    lines = wide[:, 0] * wide[:, 1]
    for batch in _batches(lines, 4_000_000):
        number = lines[batch]
        face = np.repeat(np.arange(len(batch)), number)
        order = np.arange(len(face)) - np.repeat(np.cumsum(number) - number, number)
        width = wide[batch][face, 1]
        i = first[batch][face, 0] + order // width
        j = first[batch][face, 1] + order % width
        a, b, c = (corners[batch][face, n] for n in range(3))
        area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
        wa = (b[:, 0] - i) * (c[:, 1] - j) - (b[:, 1] - j) * (c[:, 0] - i)
        wb = (c[:, 0] - i) * (a[:, 1] - j) - (c[:, 1] - j) * (a[:, 0] - i)
        wc = (a[:, 0] - i) * (b[:, 1] - j) - (a[:, 1] - j) * (b[:, 0] - i)
        sign = np.sign(area)
        hit = (sign != 0) & (wa * sign >= 0) & (wb * sign >= 0) & (wc * sign >= 0)
        total = (wa + wb + wc)[hit]
        z = (wa[hit] * a[hit, 2] + wb[hit] * b[hit, 2] + wc[hit] * c[hit, 2]) / total
        # A crossing at z changes the winding number of all points below it.
        k = np.clip(np.ceil(z), 0, nz).astype(np.int64)
        np.add.at(winding, (i[hit] * ny + j[hit], k), (sign[hit] if oriented else np.ones(len(k))).astype(np.int16))
    from_above = np.cumsum(winding[:, ::-1], axis=1, dtype=np.int16)[:, ::-1][:, 1:]
    inside = from_above != 0 if oriented else from_above % 2 == 1
    return np.asarray(inside.reshape(nx, ny, nz))


def _batches(sizes: NDArray[np.int64], limit: int) -> list[NDArray[np.int64]]:
    """Indices of ``sizes`` above 0 in runs whose sizes add up to about ``limit``."""
    used = np.flatnonzero(sizes)
    group = np.cumsum(sizes[used]) // limit
    return [used[group == g] for g in np.unique(group)]


def _cover_thin_parts(positions: Array, fine: Array, low: Array, step: Array, counts: NDArray[np.int64]) -> Array:
    """Add a particle to each lattice cell with inside test points that no particle is near to."""
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
    """Distance of ``positions`` to the plane of the nearest face, inf beyond ``spacing``."""
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
