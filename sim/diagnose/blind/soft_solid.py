# SPDX-License-Identifier: MIT
"""Blocks, beams and balls of linear tetrahedra: a mesh and the sparse operators of its finite elements."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Five tetrahedra of a cell; the mirror image next to it, so that faces match.
_EVEN = ((0, 1, 2, 4), (3, 1, 7, 2), (5, 1, 4, 7), (6, 2, 7, 4), (1, 2, 4, 7))
_ODD = ((1, 0, 5, 3), (2, 0, 3, 6), (4, 0, 6, 5), (7, 3, 5, 6), (0, 3, 6, 5))


@dataclass(frozen=True, kw_only=True)
class Solid:
    """N nodes, M tetrahedra. nodes: (N, 3) m; tetrahedra: (M, 4); faces: (F, 3) of the surface, outward.

    volume: (M,) m³. gradient: (3M, N) sparse, row j M + e gives the derivative along axis j in element e.
    share: (N,) m³ of each node. spacing: m, of the grid it came from.
    """

    nodes: Array
    tetrahedra: NDArray[np.int64]
    faces: NDArray[np.int64]
    volume: Array
    gradient: sp.csr_array
    share: Array
    spacing: float

    @property
    def centres(self) -> Array:
        """(M, 3) m, of the elements."""
        return np.asarray(self.nodes[self.tetrahedra].mean(axis=1))


def block(size: tuple[float, float, float], cells: tuple[int, int, int]) -> Solid:
    """A block of ``size`` m about the origin in ``cells`` cells along x, y, z."""
    axes = [np.linspace(-s / 2, s / 2, n + 1) for s, n in zip(size, cells, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return _solid(nodes, _tetrahedra(cells), size[0] / cells[0])


def ball(radius: float, cells: int) -> Solid:
    """A ball of ``radius`` m: a cube of ``cells`` cells along each edge, an even number, pushed out to a sphere.

    Odd numbers leave tetrahedra that are flat at the places of the cube's corners.
    """
    line = np.linspace(-1, 1, cells + 1)
    nodes = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    length = np.abs(nodes).max(axis=1, keepdims=True)
    outward = nodes / np.maximum(length, 1e-12)
    # Each shell of the cube becomes a sphere, its nodes spread evenly (Nowell's map): corners do not crowd.
    x2, y2, z2 = (outward**2).T
    shape = np.column_stack(
        [
            np.sqrt(np.maximum(1 - y2 / 2 - z2 / 2 + y2 * z2 / 3, 0)),
            np.sqrt(np.maximum(1 - x2 / 2 - z2 / 2 + x2 * z2 / 3, 0)),
            np.sqrt(np.maximum(1 - x2 / 2 - y2 / 2 + x2 * y2 / 3, 0)),
        ]
    )
    return _solid(radius * length * outward * shape, _tetrahedra((cells, cells, cells)), 2 * radius / cells)


def _tetrahedra(cells: tuple[int, int, int]) -> NDArray[np.int64]:
    nx, ny, nz = cells
    number = np.arange((nx + 1) * (ny + 1) * (nz + 1)).reshape(nx + 1, ny + 1, nz + 1)
    found = []
    for i, j, k in itertools.product(range(nx), range(ny), range(nz)):
        corner = [number[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)] for c in range(8)]
        found += [[corner[c] for c in tet] for tet in (_ODD if (i + j + k) % 2 == 0 else _EVEN)]
    return np.array(found, dtype=np.int64)


def _solid(nodes: Array, tetrahedra: NDArray[np.int64], spacing: float) -> Solid:
    edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    signed = np.linalg.det(edges) / 6
    turned = tetrahedra.copy()
    turned[signed < 0, 2:] = turned[signed < 0][:, [3, 2]]
    edges = nodes[turned[:, 1:]] - nodes[turned[:, :1]]
    volume = np.linalg.det(edges) / 6
    slopes = np.linalg.inv(edges)  # column a: gradient of the shape function of corner a + 1
    slopes = np.concatenate([-slopes.sum(axis=2, keepdims=True), slopes], axis=2)  # (M, 3, 4)
    count = len(turned)
    rows = np.arange(3 * count).reshape(3, count).T[:, :, None]
    rows = np.broadcast_to(rows, (count, 3, 4))
    columns = np.broadcast_to(turned[:, None, :], (count, 3, 4))
    gradient = sp.csr_array((slopes.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * count, len(nodes)))
    share = np.bincount(turned.ravel(), weights=np.repeat(volume / 4, 4), minlength=len(nodes))
    return Solid(
        nodes=nodes,
        tetrahedra=turned,
        faces=_surface(turned),
        volume=volume,
        gradient=gradient,
        share=share,
        spacing=spacing,
    )


def _surface(tetrahedra: NDArray[np.int64]) -> NDArray[np.int64]:
    """Faces that belong to one tetrahedron only, outward."""
    faces = np.concatenate([tetrahedra[:, list(c)] for c in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return np.asarray(faces[first[count == 1]])


def surface_mesh(solid: Solid) -> tuple[Array, NDArray[np.int64]]:
    """The surface alone: (V, 3) m and (F, 3)."""
    used, faces = np.unique(solid.faces, return_inverse=True)
    return solid.nodes[used], faces.reshape(-1, 3)
