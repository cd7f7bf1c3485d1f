# SPDX-License-Identifier: MIT
"""A mesh that a physical body carries, and its last touch: no face in the foreground. No Taichi.

The points of a body leave an obstacle to a hundredth of a grid cell. A mesh bound to them follows by interpolation,
whose error is larger, and a flat face between two vertices may cut into a bulge. That is taken out by projection: where
a face is in the obstacle, its corners are moved along the gradient of the signed distance, by least squares for every
place of it and so that neighbours move alike, until none is. That changes the volume by no more than the layer it
lifts, which is as thin as the interpolation is good.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix

from ...errors import InputError
from ...mpm.colliders import Surface
from ...mpm.distance import DistanceLattice
from ...skinning.binding import bind, deform
from .step import PhysicalBody

Array = NDArray[np.float64]

ORDER = 4
"""Parts of a triangle's side between the places of it that are looked at."""

ROUNDS = 60
"""Times that faces are moved at most."""

CLEARANCE = 0.02
"""Lattice spacings that faces keep from the surface: of the order of what is between the lattice and the surface."""

SPREAD = 3
"""Rings of neighbours that go along with a vertex that is moved."""


class CarriedMesh:
    """A mesh (vertices (V, 3), faces (T, 3), world metres) bound to a body as the body was at its start.

    Raises InputError where the mesh is larger than the body by a tenth of its size: it is of another object then.
    """

    def __init__(self, surface: Surface, body: PhysicalBody) -> None:
        self._surface, self._body = surface, body
        rest = body.rest
        low, high = rest.min(axis=0), rest.max(axis=0)
        reach = 0.1 * float((high - low).max())
        if not ((surface.vertices > low - reach) & (surface.vertices < high + reach)).all():
            raise InputError("carried mesh: it reaches far beyond the body's points: give the mesh of the same object")
        self._binding = bind(surface.vertices, rest)

    def now(self) -> Surface:
        """The mesh as the body's particles carry it."""
        body = self._body
        return Surface(
            vertices=deform(self._binding, body.particles, body.particle_gradients), faces=self._surface.faces
        )

    def cleared(self) -> Surface:
        """The same without what is left of it in the obstacles, which must be at rest; see ``cleared``."""
        return cleared(self.now(), self._body.lattices)


def cleared(surface: Surface, lattices: Sequence[DistanceLattice]) -> Surface:
    """A mesh with its faces moved out of where ``lattices`` are negative.

    Meant for what a simulation leaves, a small part of a grid cell; what is deeper moves, too, but bends the mesh.
    """
    vertices = surface.vertices.copy()
    i, j = (n.ravel() for n in np.meshgrid(np.arange(ORDER + 1), np.arange(ORDER + 1), indexing="ij"))
    held = i + j <= ORDER
    shares = np.stack([ORDER - i - j, i, j], axis=1)[held] / ORDER
    neighbours = _neighbours(len(vertices), surface.faces)
    for lattice in lattices:
        for _ in range(ROUNDS):
            moved = _lifted(vertices, surface.faces, shares, lattice)
            if moved is None:
                break
            vertices = vertices + _spread(moved, neighbours)
    return Surface(vertices=vertices, faces=surface.faces)


def _lifted(vertices: Array, faces: NDArray[np.int64], shares: Array, lattice: DistanceLattice) -> Array | None:
    """Ways (V, 3) that take the faces out of the lattice's inside, as far as each place of them asks; None: none is."""
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
    # One place alone is lifted by the least squares of its three corners; where several ask, their mean.
    ways = (lack[lack > 0] / (weights**2).sum(axis=1))[:, None] * away
    owner = faces[near[face]].ravel()
    total = np.stack(
        [np.bincount(owner, (weights**2 * ways[:, k, None]).ravel(), len(vertices)) for k in range(3)], axis=1
    )
    weight = np.bincount(owner, weights.ravel(), len(vertices))
    return np.asarray(total / np.maximum(weight, 1e-12)[:, None])


def _spread(ways: Array, neighbours: csr_matrix) -> Array:
    """Ways (V, 3) that fade out over the neighbours of those that are moved, which keep at least their own."""
    own = np.linalg.norm(ways, axis=1) > 0
    result = ways
    for _ in range(SPREAD):
        result = np.where(own[:, None], ways, 0.5 * (neighbours @ result))
    return result


def _neighbours(count: int, faces: NDArray[np.int64]) -> csr_matrix:
    """The matrix (V, V) that takes the mean over the vertices that share an edge with each."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([ends, ends[:, ::-1]])
    linked = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    linked.data[:] = 1.0
    degree = np.maximum(np.asarray(linked.sum(axis=1)).ravel(), 1.0)
    return csr_matrix(coo_matrix((1.0 / degree, (np.arange(count), np.arange(count)))).tocsr() @ linked)
