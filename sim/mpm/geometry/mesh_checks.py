# SPDX-License-Identifier: MIT
"""Checks of a surface before it is filled or hit: closed, thick enough, without self-intersections. No Taichi.

Vectorised numpy, deterministic. World metres.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...errors import InputError
from ..colliders import Surface
from .inside_test import bounding_faces
from .triangles import Array, Faces, batches, bisected, bounding_box, check_closed, face_normals, ranges, validated

MAX_PAIRS = 200_000
"""Number of face pairs that are tested for intersection."""

MAX_NEIGHBOURS = 20_000_000
"""Maximum number of neighbouring pairs from which these are drawn."""

THIN_SAMPLES = 2000
"""Number of points at which a surface's thickness is measured."""

THIN_SHARE = 0.02
"""Share of a surface that may be thin without a warning."""


ALL_OVER = 0.75
"""Share of a surface behind which a body is thin that is thin all over: a sheet or a rod but for its rims."""


def check_surface(
    surface: Surface, *, name: str, cell_size: float | None = None, least_thickness: float | None = None
) -> tuple[str, ...]:
    """Return warnings about a surface of a body or collider called ``name``, in sentences; nothing is changed.

    cell_size: metres; says in addition where the surface is thinner than that.
    least_thickness: metres; of what is thin all over it says so below this only, None: below ``cell_size``.

    Raises InputError where it cannot be used at all: no faces with area, not closed, no volume.
    """
    try:
        points, triangles = validated(surface.vertices, surface.faces)
        bounding_box(points[triangles])
        oriented = check_closed(triangles)
        found = bounding_faces(points, triangles)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    recalculate = "in Blender: Mesh > Normals > Recalculate Outside"
    unite = "unite them (in Blender: Boolean modifier, Union, Self Intersection)"
    warnings = []
    if not oriented:
        warnings.append(
            f"{name}: faces are not consistently oriented, {found.reversed} of {len(triangles)} look inward; what lies "
            f"between an even number of walls counts as outside ({recalculate})"
        )
    elif found.reversed:
        warnings.append(
            f"{name}: {found.reversed} of {found.parts} parts are inside out; they are taken as if they were not "
            f"({recalculate})"
        )
    if found.buried:
        warnings.append(f"{name}: {found.buried} of {found.parts} parts lie inside others and are ignored; delete them")
    if found.overlapping:
        what = "the surface lies inside itself in part" if found.parts == 1 else "some parts overlap others"
        warnings.append(f"{name}: {what}; what overlaps counts twice in the mass: {unite}")
    crossing, tested, total = _crossing_faces(points, triangles)
    if crossing:
        warnings.append(f"{name}: the surface crosses itself at {crossing} or more pairs of faces: {unite}")
    if tested < total:
        warnings.append(
            f"{name}: {tested} of about {total} pairs of neighbouring faces were tested for crossings; the mesh is "
            "very dense or tangled: simplify it (in Blender: Decimate or Remesh modifier)"
        )
    if cell_size is not None:
        depths = inward_depths(points, found.triangles, cell_size)
        share = float(np.isfinite(depths).mean())
        thickness = _thickness(depths)
        if thickness is not None and least_thickness is not None:
            if thickness < least_thickness:
                warnings.append(
                    f"{name}: {thickness:.2g} m thick, {thickness / cell_size:.2g} grid cells of {cell_size:.2g} m; "
                    f"other soft objects may sink into it or pass: make it {least_thickness:.2g} m thick or more, "
                    f"or bake with a finer quality, with cells {thickness / least_thickness:.2g} times as large or less"
                )
        elif share > THIN_SHARE:
            warnings.append(
                f"{name}: {100 * share:.0f} % of the surface is thinner than a grid cell of {cell_size:g} m; contact "
                "there is inexact: thicken it or bake with a finer quality"
            )
    return tuple(warnings)


def _crossing_faces(points: Array, triangles: Faces) -> tuple[int, int, int]:
    """Return the intersecting pairs of faces without a common vertex, the pairs tested, and about how many there are.

    Faces that only touch do not cross.
    """
    mesh = points[triangles]
    low, high = mesh.min(axis=1), mesh.max(axis=1)
    size = float(np.ptp(mesh.reshape(-1, 3), axis=0).max())
    area = face_normals(mesh)[1]
    longest = np.linalg.norm(np.roll(mesh, -1, axis=1) - mesh, axis=2).max(axis=1)
    cell = max(2 * float(np.median(longest)), size / 200)
    while (4 * area / cell**2 + 2 * longest / cell).sum() > 2_000_000 + 2 * len(triangles):
        cell *= 2
    pieces, owner = bisected(mesh, cell)
    start = mesh.min(axis=(0, 1))
    number = int(size / cell) + 1
    first = np.floor((pieces.min(axis=1) - start) / cell).astype(np.int64)
    wide = np.floor((pieces.max(axis=1) - start) / cell).astype(np.int64) - first + 1
    piece, order = ranges(np.zeros(len(pieces), dtype=np.int64), wide.prod(axis=1))
    i = first[piece, 0] + order // (wide[piece, 1] * wide[piece, 2])
    j = first[piece, 1] + order // wide[piece, 2] % wide[piece, 1]
    k = first[piece, 2] + order % wide[piece, 2]
    # A triangle counts once in a cell, in however many pieces it is there.
    inhabitants = np.unique(((i * number + j) * number + k) * len(triangles) + owner[piece])
    in_cell, entries = np.divmod(inhabitants, len(triangles))
    begin = np.flatnonzero(np.concatenate([[True], np.diff(in_cell) != 0]))
    count = np.diff(np.append(begin, len(entries)))
    later = np.repeat(begin + count, count) - np.arange(len(entries)) - 1
    every = max(1, -(-int(later.sum()) // MAX_NEIGHBOURS))
    looked = later.copy()
    looked[np.arange(len(entries)) % every != 0] = 0
    keys: list[Faces] = []
    for batch in batches(looked, 1_000_000):
        one, second = ranges(batch + 1, looked[batch])
        a, b = entries[batch[one]], entries[second]
        near = ((low[a] <= high[b]) & (low[b] <= high[a])).all(axis=1)
        a, b = a[near], b[near]
        apart = (triangles[a][:, :, None] != triangles[b][:, None, :]).all(axis=(1, 2))
        keys.append(np.unique(a[apart] * len(triangles) + b[apart]))
    pairs = np.unique(np.concatenate(keys)) if keys else np.zeros(0, dtype=np.int64)
    total = len(pairs) * every
    if len(pairs) > MAX_PAIRS:
        pairs = pairs[np.linspace(0, len(pairs) - 1, MAX_PAIRS).astype(np.int64)]
    beyond = _normals_beyond(triangles, mesh)
    crossing = 0
    for begin_at in range(0, len(pairs), 50_000):
        a, b = np.divmod(pairs[begin_at : begin_at + 50_000], len(triangles))
        hit = np.zeros(len(a), dtype=np.bool_)
        for one, other in ((a, b), (b, a)):
            for n in range(3):
                hit |= _pierces(mesh[one, n], mesh[one, (n + 1) % 3], mesh[other], beyond[other], 1e-9 * size)
        crossing += int(hit.sum())
    return crossing, len(pairs), total


def _normals_beyond(triangles: Faces, mesh: Array) -> Array:
    """Return the normals (T, 3, 3) of the faces across the edges, corner to corner; 0 unless there is just one."""
    normals = face_normals(mesh)[0]
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    _, edge, count = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.reshape(-1), kind="stable")
    two = (np.cumsum(count) - count)[count == 2]
    one, other = order[two], order[two + 1]
    # Faces that run through their edge the same way look to different sides.
    sense = np.where(ends[one, 0] == ends[other, 0], -1.0, 1.0)[:, None]
    result = np.zeros((3 * len(triangles), 3))
    result[one], result[other] = sense * normals[other // 3], sense * normals[one // 3]
    return result.reshape(-1, 3, 3)


def _pierces(start: Array, end: Array, corners: Array, beyond: Array, least: float) -> NDArray[np.bool_]:
    """Return which segments (N, 3) pass through their triangles (N, 3, 3) by more than the length ``least``.

    beyond: (N, 3, 3) normals of the faces beyond the edges. A segment through an edge goes through the surface where
    it goes through both faces the same way; else it touches a ridge.
    """
    normals = face_normals(corners)[0]
    before = np.einsum("ni,ni->n", normals, start - corners[:, 0])
    after = np.einsum("ni,ni->n", normals, end - corners[:, 0])
    result = (before * after < 0) & (np.minimum(np.abs(before), np.abs(after)) > least)
    some = np.flatnonzero(result)
    share = before[some] / (before[some] - after[some])
    way = end[some] - start[some]
    place = start[some] + share[:, None] * way
    for n in range(3):
        corner = corners[some, n]
        across = np.cross(normals[some], corners[some, (n + 1) % 3] - corner)
        length = np.linalg.norm(across, axis=1)
        within = np.einsum("ni,ni->n", across, place - corner) / np.where(length > 0, length, 1.0)
        also = np.einsum("ni,ni->n", beyond[some, n], way) * np.sign(after[some] - before[some]) > least
        result[some] &= within > np.where(also, -least, least)
    return result


def thickness_of(points: Array, outward: Faces, limit: float) -> float | None:
    """Return the thickness in metres of a closed surface that is thin all over, None where it is not below ``limit``.

    points, outward: see ``thin_share``. The median of what is straight inward from places all over the surface.
    """
    corners = points[outward]
    area = float(face_normals(corners)[1].sum())
    volume = abs(float(np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum())) / 6
    # A sheet is 2 V / A thick, a rod twice as thick: most bodies need no closer look.
    if not area > 0 or 2 * volume / area > limit:
        return None
    return _thickness(inward_depths(points, outward, limit))


def _thickness(depths: Array) -> float | None:
    thin = np.isfinite(depths)
    return float(np.median(depths[thin])) if thin.mean() >= ALL_OVER else None


def thin_share(points: Array, outward: Faces, cell_size: float) -> float:
    """Return the share of a closed surface, 0 to 1, behind which the body is thinner than ``cell_size`` metres.

    points: (V, 3); outward: (T, 3), see ``bounding_faces``. Raises InputError on a cell size that is not above 0.
    """
    return float(np.isfinite(inward_depths(points, outward, cell_size)).mean())


def inward_depths(points: Array, outward: Faces, cell_size: float) -> Array:
    """Return how far in metres it is to the other side (S,), inf where it is farther than ``cell_size``.

    Measured straight inward from 2000 places spread evenly over the surface, or fewer where that is too much work.
    """
    if not (math.isfinite(cell_size) and cell_size > 0):
        raise InputError(f"cell_size is {cell_size!r}: give metres above 0")
    corners = points[outward]
    size = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    normals, area = face_normals(corners)
    # Farther than the body is large there is nothing to find.
    cell_size = min(cell_size, 2 * size)
    number = np.arange(THIN_SAMPLES)
    face = np.searchsorted(np.cumsum(area), (number + 0.5) / THIN_SAMPLES * area.sum())
    face = np.minimum(face, len(area) - 1)
    root, other = np.sqrt((0.5 + number * 0.7548776662466927) % 1.0), (0.5 + number * 0.5698402909980532) % 1.0
    weights = np.stack([1 - root, root * (1 - other), root * other], axis=1)
    start = np.einsum("nk,nkc->nc", weights, corners[face])
    end = start - cell_size * normals[face]
    pieces, owner = bisected(corners, max(cell_size, size / 100))
    centre = pieces.mean(axis=1)
    radius = float(np.linalg.norm(pieces - centre[:, None], axis=2).max())
    tree = cKDTree(centre)
    middle, reach = 0.5 * (start + end), 0.5 * cell_size + radius
    work = tree.query_ball_point(middle, reach, return_length=True)
    every = max(1, -(-int(work.sum()) // MAX_NEIGHBOURS))
    looked = np.arange(0, THIN_SAMPLES, every)
    depths = np.full(THIN_SAMPLES, np.inf)
    for begin in range(0, len(looked), 100):
        some = looked[begin : begin + 100]
        lists = tree.query_ball_point(middle[some], reach)
        ray = np.repeat(some, [len(entry) for entry in lists])
        piece = np.concatenate([np.asarray(entry, dtype=np.int64) for entry in lists])
        distinct = owner[piece] != face[ray]
        ray, piece = ray[distinct], piece[distinct]
        beyond = np.repeat(normals[owner[piece], None], 3, axis=1)
        hit = _pierces(start[ray], end[ray], pieces[piece], beyond, 1e-9 * size)
        ray, hit_pieces = ray[hit], pieces[piece[hit]]
        across = face_normals(hit_pieces)[0]
        height = np.einsum("ni,ni->n", across, start[ray] - hit_pieces[:, 0])
        slope = np.einsum("ni,ni->n", across, normals[face[ray]])
        np.minimum.at(depths, ray, np.abs(height / np.where(slope != 0, slope, 1.0)))
    return depths[looked]
