# SPDX-License-Identifier: MIT
"""Surfaces seated in others and on the ground, and moved out of others where they penetrate.

The points of a body leave an obstacle to a hundredth of a grid cell. A mesh bound to them follows by interpolation,
whose error is larger, and a flat face between two vertices may cut into a bulge. That is removed by projection: where a
face is in the obstacle, its corners move along the gradient of the signed distance, by least squares for every sample
of the face and smoothed over neighbours, until none is. The volume changes by no more than the layer that is lifted, as
thin as the interpolation is good.

Deformable parts are seated in the fixed ones, and on the ground, so that a composition stands under gravity. The
optimisation ends where nothing penetrates, with some air left between the parts and a base that is as uneven as its
particles. A rigid ring then slides down its finger until the air is used up, and a head rocks on its neck. What is soft
would lie against its neighbour on the whole area of contact and bulge beside it. So vertices near another part move out
along their normals by up to a thickness well below what the image shows: in the contact until the air is closed,
beside it by all of the thickness more than that, which makes a groove that the other part sits in: a wall measured
from the surface without its air would be thinner where there was more air, and none where the part narrows. A base
within the thickness of the ground becomes flat.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import cKDTree

from ...mpm.colliders import Surface
from ...mpm.geometry.signed_distance import DistanceLattice
from ...mpm.geometry.triangles import area_normals
from ...scene.model import Ground
from ...smoothstep import smoothstep

Array = NDArray[np.float64]

FACE_SUBDIVISIONS = 4
"""Subdivisions of a triangle's side at whose points penetration is tested."""

MAX_ITERATIONS = 60
"""Iterations of the correction for each obstacle."""

CLEARANCE = 0.02
"""Lattice spacings that faces keep from the surface: of the order of the lattice's error."""

SMOOTHING_RINGS = 3
"""Rings of neighbours over which a correction is smoothed."""


def resolve_penetration(surface: Surface, lattices: Sequence[DistanceLattice]) -> Surface:
    """Return ``surface`` with its faces moved out of where ``lattices`` are negative.

    Meant for the residual penetration of a simulation, a small fraction of a grid cell; deeper penetration is removed,
    too, but distorts the mesh.
    """
    vertices = surface.vertices.copy()
    i, j = (
        n.ravel()
        for n in np.meshgrid(np.arange(FACE_SUBDIVISIONS + 1), np.arange(FACE_SUBDIVISIONS + 1), indexing="ij")
    )
    held = i + j <= FACE_SUBDIVISIONS
    shares = np.stack([FACE_SUBDIVISIONS - i - j, i, j], axis=1)[held] / FACE_SUBDIVISIONS
    neighbours = _neighbour_means(len(vertices), surface.faces)
    for lattice in lattices:
        for _ in range(MAX_ITERATIONS):
            moved = _face_corrections(vertices, surface.faces, shares, lattice)
            if moved is None:
                break
            vertices = vertices + _smoothed(moved, neighbours)
    return Surface(vertices=vertices, faces=surface.faces)


def _face_corrections(
    vertices: Array, faces: NDArray[np.int64], shares: Array, lattice: DistanceLattice
) -> Array | None:
    """Return displacements (V, 3), metres, that move the faces out of the lattice's inside; None where none is."""
    corners = vertices[faces]
    reach = np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    near = np.flatnonzero(lattice.at(corners.mean(axis=1))[0] < reach + lattice.spacing)
    places = np.einsum("sb,tbc->tsc", shares, corners[near])
    distance, slope = lattice.at(places.reshape(-1, 3))
    lack = CLEARANCE * lattice.spacing - distance
    if not (lack > 0.5 * CLEARANCE * lattice.spacing).any():
        return None
    face, place = np.divmod(np.flatnonzero(lack > 0), len(shares))
    weights = shares[place]
    away = slope[lack > 0] / np.maximum(np.linalg.norm(slope[lack > 0], axis=1), 1e-9)[:, None]
    # A single sample is moved by least squares over its three corners; several are averaged.
    ways = (lack[lack > 0] / (weights**2).sum(axis=1))[:, None] * away
    owner = faces[near[face]].ravel()
    total = np.stack(
        [np.bincount(owner, (weights**2 * ways[:, k, None]).ravel(), len(vertices)) for k in range(3)], axis=1
    )
    weight = np.bincount(owner, weights.ravel(), len(vertices))
    return np.asarray(total / np.maximum(weight, 1e-12)[:, None])


def _smoothed(ways: Array, neighbours: csr_matrix) -> Array:
    """Return displacements (V, 3) smoothed over neighbours; vertices with their own keep it."""
    own = np.linalg.norm(ways, axis=1) > 0
    result = ways
    for _ in range(SMOOTHING_RINGS):
        result = np.where(own[:, None], ways, 0.5 * (neighbours @ result))
    return result


def _neighbour_means(count: int, faces: NDArray[np.int64]) -> csr_matrix:
    """Return the matrix (V, V) that averages over the vertices that share an edge with each."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([ends, ends[:, ::-1]])
    linked = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    linked.data[:] = 1.0
    degree = np.maximum(np.asarray(linked.sum(axis=1)).ravel(), 1.0)
    return csr_matrix(coo_matrix((1.0 / degree, (np.arange(count), np.arange(count)))).tocsr() @ linked)


REACH = 4.0
"""Thicknesses from another part within which a vertex moves by the whole thickness; none beyond twice that. Several
spacings of a mesh, else the groove has no wall."""

HEAD_ON = 1.2
"""Longest way of a vertex to another part that faces it, over the air there. Beyond, it met an edge."""

ITERATIONS = 30
"""Of the search for how far a vertex may move: each goes as far as the distance to the other part is."""


def seated(
    surface: Surface, others: Sequence[DistanceLattice], *, thickness: float, ground: Ground | None = None
) -> Surface:
    """Return ``surface`` with its vertices near ``others``, and near the ``ground``, moved to lie against them.

    In contacts they move by up to ``thickness`` metres, the air there; beside them by the thickness more than that.
    others: signed distances to the other parts' surfaces, metres. Vertices keep their order.
    """
    vertices = surface.vertices
    normals = area_normals(vertices, surface.faces)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    air = _least_distance(others, vertices)
    weight = smoothstep(air, 2.0 * REACH * thickness, REACH * thickness)
    near = np.flatnonzero(weight > 0)
    room = thickness * weight[near]
    way = _moved_out(others, vertices[near], normals[near], np.zeros(len(near)), room)
    met = way < room
    faced = met & (way <= HEAD_ON * air[near])
    if faced.any():
        closed = way[faced][cKDTree(vertices[near][faced]).query(vertices[near])[1]]
        way = _moved_out(others, vertices[near], normals[near], way, np.where(met, way, room + closed * weight[near]))
    moved = vertices.copy()
    moved[near] += way[:, None] * normals[near]
    resolved = resolve_penetration(Surface(vertices=moved, faces=surface.faces), others)
    return resolved if ground is None else _on_ground(resolved, ground, thickness)


def _moved_out(others: Sequence[DistanceLattice], places: Array, normals: Array, way: Array, room: Array) -> Array:
    """Return how far (N,) in metres ``places`` move along ``normals`` until they meet a surface, by ``room`` at most.

    way: where the search begins.
    """
    for _ in range(ITERATIONS):
        way = np.clip(way + _least_distance(others, places + way[:, None] * normals), 0.0, room)
    return way


def _least_distance(lattices: Sequence[DistanceLattice], points: Array) -> Array:
    """Return the distance (N,) in metres to the nearest of the surfaces, negative inside."""
    return np.asarray(np.min([lattice.at(points)[0] for lattice in lattices], axis=0), dtype=np.float64)


SUNK = 0.02
"""Share of its largest extent by which a part may have sunk into the ground, which is no obstacle while it is composed,
and is still lifted onto it. What reaches deeper is not on the ground, but through it."""


def _on_ground(surface: Surface, ground: Ground, thickness: float) -> Surface:
    """Return ``surface`` flat where it is lower than ``thickness``; heights up to twice that are stretched.

    What reaches deeper than ``SUNK`` stays as it is.
    """
    heights = ground.heights(surface.vertices)
    if heights.min() < -max(2.0 * thickness, SUNK * float(np.ptp(surface.vertices, axis=0).max())):
        return surface
    wanted = np.where(heights < 2.0 * thickness, np.maximum(0.0, 2.0 * (heights - thickness)), heights)
    down = (wanted - heights)[:, None] * np.asarray(ground.unit_normal)
    return Surface(vertices=surface.vertices + down, faces=surface.faces)
