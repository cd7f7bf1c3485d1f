# SPDX-License-Identifier: MIT
"""Velocity of a surface that deforms, at the points of its distance lattice, for friction on it. No Taichi."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..colliders import Surface
from ..geometry.signed_distance import DistanceLattice
from ..geometry.triangles import bisected

Array = NDArray[np.float64]

PIECE = 0.7
"""Longest edge, in spacings of the lattice, of the pieces of surface whose middles stand for it."""

BAND = 2.0
"""Spacings from the surface within which points of the lattice have a velocity: the 8 around any place of it do."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Footing:
    """Where on a surface the points of a lattice that are near it have their nearest place.

    shape: of the lattice. nodes: (N,) their numbers, C order. corners: (N, 3) vertices of the triangle of each.
    weights: (N, 3) barycentric.
    """

    shape: tuple[int, ...]
    nodes: NDArray[np.int64]
    corners: NDArray[np.int64]
    weights: Array

    def velocities(self, vertices: Array) -> NDArray[np.float32]:
        """Velocities (nx, ny, nz, 3) at the points of the lattice where those of the vertices are (V, 3); 0 far off."""
        found = np.zeros((int(np.prod(self.shape)), 3), dtype=np.float32)
        found[self.nodes] = np.einsum("nc,ncd->nd", self.weights, vertices[self.corners])
        return found.reshape(*self.shape, 3)


def footing_of(lattice: DistanceLattice, surface: Surface) -> Footing:
    """Return the footing of ``lattice`` on the ``surface`` whose distances it has, to about a third of its spacing."""
    mesh = surface.vertices[surface.faces]
    pieces, owner = bisected(mesh, PIECE * lattice.spacing)
    nodes = np.flatnonzero(np.abs(lattice.distances.reshape(-1)) <= BAND * lattice.spacing)
    places = lattice.origin + lattice.spacing * np.stack(np.unravel_index(nodes, lattice.distances.shape), axis=1)
    middles = pieces.mean(axis=1)
    nearest = cKDTree(middles).query(places)[1]
    chosen = owner[nearest]
    a, b, c = np.moveaxis(mesh[chosen], 1, 0)
    # Barycentric coordinates of the middle of the piece, which lies in its triangle.
    ab, ac, ap = b - a, c - a, middles[nearest] - a
    bb, bc, cc = ((u * v).sum(axis=1) for u, v in ((ab, ab), (ab, ac), (ac, ac)))
    pb, pc = (ap * ab).sum(axis=1), (ap * ac).sum(axis=1)
    area = np.maximum(bb * cc - bc**2, 1e-300)
    second, third = (cc * pb - bc * pc) / area, (bb * pc - bc * pb) / area
    return Footing(
        shape=lattice.distances.shape,
        nodes=nodes,
        corners=np.asarray(surface.faces[chosen], dtype=np.int64),
        weights=np.clip(np.stack([1 - second - third, second, third], axis=1), 0.0, 1.0),
    )
