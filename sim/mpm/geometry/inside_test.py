# SPDX-License-Identifier: MIT
"""What lies inside a closed mesh, and what bounds it. No Taichi; vectorised numpy, deterministic.

A point is inside where the winding number along its vertical line is not zero, so that overlapping parts add up; or
where it is odd, if the faces are not consistently oriented.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .triangles import Array, Faces, batches, check_closed, face_normals, ranges, signed_volume

OFF_FACE = 1e-6
"""Distance in front of and behind a face at which inside and outside are tested, over the mesh's size."""

SHIFTS = ((3.1e-6, 4.7e-6), (-5.3e-6, 2.9e-6), (4.3e-6, -6.1e-6))
"""Shifts of the vertical lines in lattice steps, so that they miss the edges between two faces; the next where one
still hits."""

# Weights of a point inside a triangle that no regular mesh has on an edge's shadow.
INSIDE_WEIGHTS = np.array([0.314159, 0.271828, 0.414013])


def inside_lattice(
    points: Array, triangles: Faces, low: Array, step: Array, counts: NDArray[np.int64], oriented: bool
) -> NDArray[np.bool_]:
    """Return which points ``low + (i + 0.5) step`` lie inside. Scan lines along z.

    The lines are shifted by a few millionths of a step; a line along which the crossings do not add up ran through an
    edge all the same and is scanned again beside.
    """
    nx, ny, nz = (int(n) for n in counts)
    inside = np.zeros((nx * ny, nz), dtype=np.bool_)
    todo = np.ones(nx * ny, dtype=np.bool_)
    for shift in SHIFTS:
        winding = _crossings(points, triangles, low, step, counts, oriented, shift)
        from_above = np.cumsum(winding[:, ::-1], axis=1, dtype=np.int16)[:, ::-1]
        del winding
        odd = from_above[:, 0] != 0 if oriented else from_above[:, 0] % 2 == 1
        found = from_above[:, 1:] != 0 if oriented else from_above[:, 1:] % 2 == 1
        inside = found if todo.all() else np.where(todo[:, None], found, inside)
        todo &= odd
        if not todo.any():
            break
    return inside.reshape(nx, ny, nz)


def _crossings(
    points: Array,
    triangles: Faces,
    low: Array,
    step: Array,
    counts: NDArray[np.int64],
    oriented: bool,
    shift: tuple[float, float],
) -> NDArray[np.int16]:
    """Return the change of the winding number (nx*ny, nz + 1) below each height of each line."""
    nx, ny, nz = (int(n) for n in counts)
    winding = np.zeros(nx * ny * (nz + 1), dtype=np.int16)
    corners = (points[triangles] - low) / step - 0.5
    corners[..., :2] -= shift
    first = np.clip(np.ceil(corners[..., :2].min(axis=1)), 0, [nx, ny]).astype(np.int64)
    last = np.clip(np.floor(corners[..., :2].max(axis=1)), -1, [nx - 1, ny - 1]).astype(np.int64)
    wide = np.maximum(last - first + 1, 0)
    lines = wide[:, 0] * wide[:, 1]
    for batch in batches(lines, 500_000):
        face, order = ranges(np.zeros(len(batch), dtype=np.int64), lines[batch])
        width = wide[batch][face, 1]
        i = first[batch][face, 0] + order // width
        j = first[batch][face, 1] + order % width
        hit, sign, z = _vertical_hits(corners[batch][face], i, j)
        # A crossing at z changes the winding number of all points below it.
        k = np.clip(np.ceil(z), 0, nz).astype(np.int64)
        change = (sign if oriented else np.ones(len(k))).astype(np.int16)
        np.add.at(winding, (i[hit] * ny + j[hit]) * (nz + 1) + k, change)
    return winding.reshape(nx * ny, nz + 1)


def _vertical_hits(
    corners: Array, x: NDArray[np.number], y: NDArray[np.number]
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return which vertical lines (N,) cross their triangles (N, 3, 3); of those the face's sense and the height."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    wa = (b[:, 0] - x) * (c[:, 1] - y) - (b[:, 1] - y) * (c[:, 0] - x)
    wb = (c[:, 0] - x) * (a[:, 1] - y) - (c[:, 1] - y) * (a[:, 0] - x)
    wc = (a[:, 0] - x) * (b[:, 1] - y) - (a[:, 1] - y) * (b[:, 0] - x)
    sign = np.sign(area)
    hit = (sign != 0) & (wa * sign >= 0) & (wb * sign >= 0) & (wc * sign >= 0)
    hit &= wa + wb + wc != 0
    total = (wa + wb + wc)[hit]
    z = (wa[hit] * a[hit, 2] + wb[hit] * b[hit, 2] + wc[hit] * c[hit, 2]) / total
    return hit, sign[hit], z


def winding_numbers(places: Array, corners: Array, oriented: bool) -> NDArray[np.int64]:
    """Return winding numbers (N,) of a closed mesh with triangle corners (T, 3, 3) at points (N, 3); 0 is outside.

    Where the faces are not consistently oriented, 0 or 1.
    """
    middle = corners.reshape(-1, 3).mean(axis=0)
    corners, places = corners - middle, places - middle
    size = float(np.abs(corners).max())
    winding = np.zeros(len(places), dtype=np.int64)
    todo = np.arange(len(places))
    for shift in ((0.0, 0.0), (3.1e-9, 4.7e-9), (-5.3e-9, 2.9e-9)):
        found, sound = _winding_numbers(places[todo] + [shift[0] * size, shift[1] * size, 0.0], corners, oriented)
        winding[todo] = found
        todo = todo[~sound]
        if len(todo) == 0:
            break
    return winding


def _winding_numbers(places: Array, corners: Array, oriented: bool) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return winding numbers at points, and for which of them the vertical line was consistent."""
    low = places[:, :2].min(axis=0)
    extent = np.maximum(np.ptp(places[:, :2], axis=0), 1e-300)
    bottom, top = corners[..., :2].min(axis=1), corners[..., :2].max(axis=1)
    near = ((top >= low) & (bottom <= low + extent)).all(axis=1)
    corners, bottom, top = corners[near], bottom[near], top[near]
    bins = int(np.clip(np.sqrt(len(places)), 1, 512))
    while True:
        first = np.clip((bottom - low) / extent * bins, 0, bins - 1).astype(np.int64)
        wide = np.clip((top - low) / extent * bins, 0, bins - 1).astype(np.int64) - first + 1
        entries = wide[:, 0] * wide[:, 1]
        if bins == 1 or entries.sum() <= 8 * (len(places) + len(corners)):
            break
        bins = (bins + 1) // 2
    cell = np.clip((places[:, :2] - low) / extent * bins, 0, bins - 1).astype(np.int64)
    key = cell[:, 0] * bins + cell[:, 1]
    by_bin = np.argsort(key, kind="stable")
    begin = np.searchsorted(key[by_bin], np.arange(bins * bins + 1))
    face, order = ranges(np.zeros(len(corners), dtype=np.int64), entries)
    bin_of = (first[face, 0] + order // wide[face, 1]) * bins + first[face, 1] + order % wide[face, 1]
    count = begin[bin_of + 1] - begin[bin_of]
    above, total = np.zeros(len(places)), np.zeros(len(places))
    for batch in batches(count, 1_000_000):
        entry, slot = ranges(begin[bin_of[batch]], count[batch])
        place = by_bin[slot]
        hit, sign, z = _vertical_hits(corners[face[batch[entry]]], places[place, 0], places[place, 1])
        place = place[hit]
        weight = sign if oriented else np.ones(len(sign))
        total += np.bincount(place, weights=weight, minlength=len(places))
        above += np.bincount(place, weights=weight * (z > places[place, 2]), minlength=len(places))
    if oriented:
        return above.astype(np.int64), total == 0
    return above.astype(np.int64) % 2, total % 2 == 0


def sides(corners: Array, mesh: Array, oriented: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the winding number of ``mesh`` just in front of each triangle (N, 3, 3), and just behind it."""
    normals = face_normals(corners)[0]
    middle = np.einsum("k,tkc->tc", INSIDE_WEIGHTS, corners)
    off = OFF_FACE * float(np.ptp(mesh.reshape(-1, 3), axis=0).max()) * normals
    both = winding_numbers(np.concatenate([middle + off, middle - off]), mesh, oriented)
    return both[: len(corners)], both[len(corners) :]


@dataclass(frozen=True, kw_only=True, eq=False)
class Boundary:
    """Faces of a closed mesh that bound its inside, oriented outward."""

    triangles: Faces
    """(B, 3)"""

    parts: int
    """Number of connected parts of the whole mesh."""

    reversed: int
    """Number of parts whose faces pointed inward; in a mesh that is not consistently oriented, of faces."""

    buried: int
    """Number of parts inside others, which are left out."""

    overlapping: int
    """Number of parts with some faces on the boundary and some inside other parts, or inside themselves."""


def boundary(points: Array, triangles: Faces, oriented: bool, *, samples: int = 20_000) -> Boundary:
    """Return the faces that bound the inside, oriented outward. Tests every face, or about ``samples``, evenly.

    Oriented meshes are turned part by part; where faces are not consistently oriented, each face for itself.
    """
    first, second = triangles[:, 0], triangles[:, 1]
    # Not at the top: Blender plays bakes without SciPy.
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix(
        (
            np.ones(2 * len(triangles), dtype=np.int8),
            (np.concatenate([first, second]), np.concatenate([second, triangles[:, 2]])),
        ),
        shape=(len(points), len(points)),
    )
    _, labels = connected_components(links, directed=False)
    _, part = np.unique(labels[first], return_inverse=True)
    part = part.reshape(-1)
    parts = int(part.max()) + 1
    mesh = points[triangles]
    if not oriented:
        front, back = sides(mesh, mesh, oriented)
        turn = front > back
        bound = front != back
        result = np.where(turn[:, None], triangles[:, ::-1], triangles)[bound]
        return Boundary(triangles=result, parts=parts, reversed=int(turn.sum()), buried=0, overlapping=0)
    area = face_normals(mesh)[1]
    order = np.argsort(part, kind="stable")
    size = np.bincount(part)
    rank = np.empty(len(part), dtype=np.int64)
    rank[order] = ranges(np.zeros(parts, dtype=np.int64), size)[1]
    every = max(1, -(-len(triangles) // samples))
    # The first of every part is looked at, and its largest face, which is least likely to be without area.
    largest = np.lexsort((-area, part))[np.cumsum(size) - size]
    chosen = np.union1d(np.flatnonzero(rank % every == 0), largest)
    front, back = sides(mesh[chosen], mesh, oriented)
    before, behind = front != 0, back != 0

    def share(which: NDArray[np.bool_]) -> Array:
        return np.bincount(part[chosen], weights=area[chosen] * which, minlength=parts)

    outward, inward, within = share(behind & ~before), share(before & ~behind), share(before & behind)
    # Where faces only touch, the number is 1 on either side.
    doubly = share(before & behind & (np.maximum(np.abs(front), np.abs(back)) > 1))
    bounds = outward + inward > 0
    turned = bounds & (inward > outward)
    result = np.where(turned[part][:, None], triangles[:, ::-1], triangles)[bounds[part]]
    return Boundary(
        triangles=result,
        parts=parts,
        reversed=int(turned.sum()),
        buried=int((~bounds & (within > 0)).sum()),
        overlapping=int((bounds & (doubly > 1e-3 * (outward + inward + within))).sum()),
    )


def bounding_faces(points: Array, triangles: Faces) -> Boundary:
    """Return the faces that bound the inside, turned outward. Raises InputError for an open or flat mesh."""
    found = boundary(points, triangles, check_closed(triangles))
    extent = np.ptp(points[triangles].reshape(-1, 3), axis=0)
    volume = signed_volume(points, found.triangles)
    if not abs(volume) > 1e-9 * face_normals(points[triangles])[1].sum() ** 1.5:
        raise InputError(
            f"mesh has no volume (bounding box {extent[0]:g} x {extent[1]:g} x {extent[2]:g}, volume {volume:g}): "
            "give it thickness"
        )
    return found
