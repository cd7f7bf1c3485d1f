# SPDX-License-Identifier: MIT
"""Closed triangle meshes: checks, normals, distances, subdivision, samples. No Taichi; deterministic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

MAX_PIECES = 8_000_000
"""Maximum number of pieces that a surface is subdivided into, about 1 GB of memory."""


def validated(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> tuple[Array, Faces]:
    """Return the vertices with coincident ones merged, and the faces without those that repeat a vertex."""
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


def check_closed(triangles: Faces) -> bool:
    """Return whether the faces are consistently oriented. Raises InputError when an edge has an odd number of faces."""
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


def signed_volume(points: Array, triangles: Faces) -> float:
    """Return the volume by the divergence theorem, about the mesh's own centre for precision."""
    corners = points[triangles] - points.mean(axis=0)
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def face_normals(corners: Array) -> tuple[Array, Array]:
    """Return unit normals (T, 3), zero where a face has no area, and areas (T,) of corners (T, 3, 3)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    return normals / np.where(lengths > 0, lengths, 1.0)[:, None], 0.5 * lengths


def area_normals(vertices: Array, faces: Faces) -> Array:
    """Return the sum (V, 3) of the normals of each vertex' faces, each as long as twice its face's area.

    vertices: (V, 3); faces: (T, 3), counter-clockwise from outside.
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    summed = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(summed, faces[:, corner], across)
    return summed


def batches(sizes: NDArray[np.int64], limit: int) -> list[NDArray[np.int64]]:
    """Return indices of ``sizes`` above 0 in runs whose sizes add up to about ``limit``."""
    used = np.flatnonzero(sizes)
    group = np.cumsum(sizes[used]) // limit
    return np.split(used, np.flatnonzero(np.diff(group)) + 1) if len(used) else []


def ranges(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the run of each element, and its value, for the runs ``start, start + 1, ...`` of ``count`` numbers."""
    run = np.repeat(np.arange(len(counts)), counts)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(counts) - counts, counts) + starts[run]


def bisected(corners: Array, longest: float, *, box: tuple[Array, Array] | None = None) -> tuple[Array, Faces]:
    """Return triangles (P, 3, 3) with no edge above ``longest`` that cover ``corners`` (T, 3, 3), and their source.

    The longest edge is halved until it is short enough: neighbours are cut alike, so their corners coincide. ``box``
    (low, high): what lies beyond it is left out. Raises InputError where it takes too many.
    """
    done, owners = [corners[:0]], [np.zeros(0, dtype=np.int64)]
    owner = np.arange(len(corners), dtype=np.int64)
    # No triangle has a larger area than the equilateral one.
    least = 0.0 if box is not None else float(face_normals(corners)[1].sum()) / (0.25 * 3**0.5 * longest**2)
    total, faces = 0, len(corners)
    while len(corners):
        if box is not None:
            near = ((corners.max(axis=1) >= box[0]) & (corners.min(axis=1) <= box[1])).all(axis=1)
            corners, owner = corners[near], owner[near]
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        which = lengths.argmax(axis=1)
        long = lengths.max(axis=1) > longest
        done.append(corners[~long])
        owners.append(owner[~long])
        total += len(done[-1])
        if max(least, total + 2 * int(long.sum())) > MAX_PIECES:
            raise InputError(
                f"surface of {faces} faces needs more than {MAX_PIECES:,} pieces at this spacing: give a larger "
                "spacing or a simpler surface"
            )
        rows = np.arange(int(long.sum()))
        cut, which, owner = corners[long], which[long], owner[long]
        a, b, c = cut[rows, which], cut[rows, (which + 1) % 3], cut[rows, (which + 2) % 3]
        middle = 0.5 * (a + b)
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        owner = np.concatenate([owner, owner])
    return np.concatenate(done), np.concatenate(owners)


@dataclass(frozen=True)
class SurfaceSamples:
    """Points on a surface. places: (n, 3); faces: (n) their triangles; weights: (n, 3) barycentric."""

    places: Array
    faces: NDArray[np.int64]
    weights: Array


def sample_surface(vertices: Array, faces: Faces, count: int) -> SurfaceSamples:
    """Return ``count`` points evenly over the triangles; deterministic."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    random = np.random.default_rng(0)
    chosen = np.sort(random.choice(len(faces), size=count, p=areas / areas.sum()))
    pair = random.random((count, 2))
    folded = pair.sum(axis=1) > 1
    pair[folded] = 1 - pair[folded]
    weights = np.column_stack([1 - pair.sum(axis=1), pair])
    return SurfaceSamples(np.einsum("nc,nci->ni", weights, vertices[faces[chosen]]), chosen, weights)


def squared_distances(places: Array, corners: Array) -> Array:
    """Return the squared distance (N,) of each point (N, 3) to its own, maybe degenerate, triangle (N, 3, 3)."""
    p = [np.ascontiguousarray(places[:, k]) for k in range(3)]
    v = [[np.ascontiguousarray(corners[:, n, k]) for k in range(3)] for n in range(3)]
    e = [[v[(n + 1) % 3][k] - v[n][k] for k in range(3)] for n in range(3)]
    w = [[p[k] - v[n][k] for k in range(3)] for n in range(3)]
    normal = _cross(e[0], e[1])
    normal2 = _dot(normal, normal)
    best = np.full(len(places), np.inf)
    above = np.ones(len(places), dtype=np.bool_)
    longest = np.zeros(len(places))
    for n in range(3):
        edge2 = _dot(e[n], e[n])
        longest = np.maximum(longest, edge2)
        t = np.clip(_dot(w[n], e[n]) / np.where(edge2 > 0, edge2, 1.0), 0.0, 1.0)
        rest = [w[n][k] - t * e[n][k] for k in range(3)]
        best = np.minimum(best, _dot(rest, rest))
        above &= _dot(_cross(normal, e[n]), w[n]) >= 0
    # A sliver's normal is noise; its edges say it all.
    above &= normal2 > 1e-20 * longest**2
    height = _dot(normal, w[0])
    return np.where(above, height * height / np.where(above, normal2, 1.0), best)


def _dot(a: list[Array], b: list[Array]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: list[Array], b: list[Array]) -> list[Array]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def bounding_box(mesh: Array) -> tuple[Array, Array]:
    """Return low corner and extent of a mesh's bounding box. Raises InputError where it is flat."""
    low = mesh.min(axis=(0, 1))
    extent = mesh.max(axis=(0, 1)) - low
    if not extent.min() > 1e-12 * extent.max():
        raise InputError(
            f"mesh has no volume (bounding box {extent[0]:g} x {extent[1]:g} x {extent[2]:g}): give it thickness"
        )
    return low, extent


def checked_places(points: NDArray[np.floating]) -> Array:
    """Return ``points`` as (N, 3) doubles. Raises InputError for another shape or numbers that are not finite."""
    places = np.asarray(points, dtype=np.float64)
    if places.ndim != 2 or places.shape[1:] != (3,) or not np.isfinite(places).all():
        raise InputError(f"points have shape {places.shape}: give finite (N, 3)")
    return places
