# SPDX-License-Identifier: MIT
"""Tetrahedral mesh of a closed surface: a lattice of cells, stretched along the rays from its centre.

A box becomes the lattice itself, a sphere the lattice inflated to a sphere, any star-shaped surface something between.
Where the surface is itself that of a lattice, its resolution is used, so that nodes and vertices coincide.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...errors import InputError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Cells3 = tuple[int, int, int]

CELLS_ACROSS = 7.0
"""Cells along the mean extent, unless the surface is that of a lattice."""

MOST_CELLS = 1600
"""Boxes of six tetrahedra; a finer surface gets a coarser lattice."""

LEAST_ACROSS = 4
"""Boxes that a coarser lattice keeps across the thinnest side: three bend and ring so unlike a finer one that the
difference says nothing of the finer one's error."""

SLIVER = 0.05
"""Smallest over median cell volume below which the diagonals are flipped."""


@dataclass(frozen=True, kw_only=True)
class BodyMesh:
    """nodes: (N, 3) m, rest frame. cells: (C, 4) nodes of each tetrahedron, positively oriented. lattice: boxes a side.

    shapes: (C, 3, 3) inverse of the edge matrix: F = (x1 - x0, x2 - x0, x3 - x0) shapes. volumes: (C,) m³.
    """

    nodes: Array
    cells: Indices
    shapes: Array
    volumes: Array
    lattice: Cells3

    @property
    def centres(self) -> Array:
        """Return the cell centres (C, 3)."""
        return np.asarray(self.nodes[self.cells].mean(axis=1))

    def node_volumes(self) -> Array:
        """Return the nodal volumes (N,) m³: a quarter of each adjacent cell."""
        found = np.zeros(len(self.nodes))
        np.add.at(found, self.cells, np.repeat(self.volumes[:, None] / 4, 4, axis=1))
        return found

    def faces(self) -> Indices:
        """Return the surface faces (F, 3): those that belong to one cell only."""
        every = np.sort(np.concatenate([self.cells[:, c] for c in itertools.combinations(range(4), 3)]), axis=1)
        found, count = np.unique(every, axis=0, return_counts=True)
        return np.asarray(found[count == 1])

    def node_areas(self) -> Array:
        """Return the nodal surface areas (N,) m²: a third of each adjacent face."""
        faces, found = self.faces(), np.zeros(len(self.nodes))
        edges = self.nodes[faces[:, 1:]] - self.nodes[faces[:, :1]]
        areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
        np.add.at(found, faces, np.repeat(areas[:, None] / 3, 3, axis=1))
        return found

    def locate(self, points: Array) -> tuple[Indices, Array]:
        """Return nodes (K, 4) and weights (K, 4) of ``points`` (K, 3), extrapolated from the nearest cell outside."""
        _, near = cKDTree(self.centres).query(points, k=min(40, len(self.cells)))
        near = np.asarray(near).reshape(len(points), -1)
        away = points[:, None] - self.nodes[self.cells[near, 0]]
        inner = np.einsum("kcij,kcj->kci", self.shapes[near], away)
        weights = np.concatenate([1 - inner.sum(axis=2, keepdims=True), inner], axis=2)
        best = weights.min(axis=2).argmax(axis=1)
        rows = np.arange(len(points))
        return self.cells[near[rows, best]], weights[rows, best]


def body_mesh(vertices: Array, faces: Indices, *, lattice: Cells3 | None = None) -> BodyMesh:
    """Return a mesh of the closed surface ``vertices`` (V, 3), ``faces`` (F, 3); ``lattice``: boxes along each axis.

    A surface that is not closed, or not star-shaped about the centre of its bounds, is replaced by its convex hull.
    Raises InputError when it has no volume.
    """
    surface = trimesh.Trimesh(vertices, faces, process=False)
    whole = trimesh.Trimesh(vertices, faces, process=True)
    if not whole.is_watertight or whole.volume <= 0 or not _star_shaped(surface):
        surface = trimesh.Trimesh(vertices, faces, process=True).convex_hull
    if surface.volume <= 1e-15:
        raise InputError("the mesh has no volume: give a closed surface")
    if lattice is None:
        lattice = _own_lattice(surface) or _default_lattice(np.ptp(surface.vertices, axis=0))
    return _tetrahedra(_nodes(surface, lattice), lattice, surface)


def coarser(mesh: BodyMesh, surface_vertices: Array, faces: Indices, *, factor: float) -> BodyMesh:
    """Return the same body with cells larger by ``factor``, by less where it is thin: see ``LEAST_ACROSS``."""
    across = min(mesh.lattice)
    factor = min(factor, max(across / LEAST_ACROSS, across / (across - 1)))
    nx, ny, nz = (max(2, round(n / factor)) for n in mesh.lattice)
    return body_mesh(surface_vertices, faces, lattice=(nx, ny, nz))


def extrapolated(fine: BodyMesh, coarse: BodyMesh) -> float:
    """Return the error of a motion on ``fine`` over its difference from that on ``coarse``: 0.8 where cells are 1.5
    times as wide. Errors are of second order in the cells (Richardson's extrapolation)."""
    ratio = float(np.cbrt(len(fine.cells) / len(coarse.cells)))
    return 1.0 / (ratio**2 - 1.0)


def _middle(surface: trimesh.Trimesh) -> tuple[Array, Array]:
    low, high = np.asarray(surface.vertices.min(axis=0)), np.asarray(surface.vertices.max(axis=0))
    return (low + high) / 2, (high - low) / 2


def _star_shaped(surface: trimesh.Trimesh) -> bool:
    centre, _ = _middle(surface)
    corners = surface.vertices[surface.faces] - centre
    return bool((np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0).all())


def _reach(surface: trimesh.Trimesh, centre: Array, directions: Array) -> Array:
    """Return distances (D,) from ``centre`` to the surface along unit ``directions`` (D, 3)."""
    corners = surface.vertices[surface.faces] - centre
    turned = np.linalg.inv(np.transpose(corners, (0, 2, 1)))
    reach = np.zeros(len(directions))
    for start in range(0, len(directions), 256):
        inside = np.einsum("fij,dj->dfi", turned, directions[start : start + 256])
        hit = inside.min(axis=2) / (np.abs(inside).sum(axis=2) + 1e-300)
        best = np.where(inside.sum(axis=2) > 0, hit, -np.inf).argmax(axis=1)
        reach[start : start + 256] = 1 / inside.sum(axis=2)[np.arange(len(best)), best]
    return reach


def _nodes(surface: trimesh.Trimesh, lattice: Cells3) -> Array:
    centre, half = _middle(surface)
    axes = [np.linspace(-1, 1, n + 1) for n in lattice]
    unit = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    level = np.abs(unit).max(axis=1)
    rays = unit * half / np.where(level > 0, level, 1.0)[:, None]
    length = np.linalg.norm(rays, axis=1)
    ok = level > 1e-9
    out = np.tile(centre, (len(unit), 1))
    directions = rays[ok] / length[ok, None]
    radial = (level[ok] * _reach(surface, centre, directions))[:, None] * directions
    # Towards the centre the plain lattice takes over: stretched all the way in, cells at its edges would be slivers.
    share = np.sqrt(level[ok, None])
    out[ok] += share * radial + (1 - share) * unit[ok] * half
    return np.asarray(out)


def _own_lattice(surface: trimesh.Trimesh) -> Cells3 | None:
    """Return the lattice whose surface vertices are those of the surface; None if none is coarse enough."""
    quads, extent = len(surface.faces) / 4, float(np.ptp(surface.vertices, axis=0).max())
    tree = cKDTree(surface.vertices)
    for nx, ny, nz in itertools.product(range(2, 25), repeat=3):
        if nx * ny + ny * nz + nz * nx != quads or nx * ny * nz > MOST_CELLS:
            continue
        outer = _nodes(surface, (nx, ny, nz))[_on_surface((nx, ny, nz))]
        if len(outer) == len(surface.vertices) and float(tree.query(outer)[0].max()) < 1e-3 * extent:
            return nx, ny, nz
    return None


def _on_surface(lattice: Cells3) -> NDArray[np.bool_]:
    places = np.stack(np.meshgrid(*(np.arange(n + 1) for n in lattice), indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(((places == 0) | (places == np.asarray(lattice))).any(axis=1))


def _default_lattice(extents: Array) -> Cells3:
    size = float(np.cbrt(extents.prod())) / CELLS_ACROSS
    nx, ny, nz = (int(np.clip(round(e / size), 3, 24)) for e in extents)
    return nx, ny, nz


def _tetrahedra(nodes: Array, lattice: Cells3, surface: trimesh.Trimesh) -> BodyMesh:
    """Return six tetrahedra per box around its diagonal (Kuhn's subdivision).

    Diagonals all point the same way or away from the centre: as the surface's own where it is that of a lattice, else
    away from the centre, so that no cell lies flat on two box faces that the surface has made coplanar.
    """
    boxes = np.stack(np.meshgrid(*(np.arange(n) for n in lattice), indexing="ij"), axis=-1).reshape(-1, 3)
    away = _around_diagonals(nodes, lattice, np.where(2 * boxes + 1 >= np.asarray(lattice), 1, -1))
    alike = _around_diagonals(nodes, lattice, np.ones_like(boxes))
    if alike.volumes.min() < SLIVER * float(np.median(alike.volumes)):
        return away
    return alike if _shared_faces(alike, surface) > _shared_faces(away, surface) else away


def _shared_faces(mesh: BodyMesh, surface: trimesh.Trimesh) -> int:
    """Return how many triangles of ``surface`` are faces of cells."""
    extent = float(np.ptp(surface.vertices, axis=0).max())
    distance, nearest = cKDTree(mesh.nodes).query(surface.vertices)
    if float(distance.max()) > 1e-3 * extent:
        return 0
    faces = {tuple(face) for face in mesh.faces().tolist()}
    return sum(tuple(face) in faces for face in np.sort(nearest[surface.faces], axis=1).tolist())


def _around_diagonals(nodes: Array, lattice: Cells3, towards: Indices) -> BodyMesh:
    """Return the subdivision along the box diagonals ``towards`` (boxes, 3), components 1 or -1."""
    _, ny, nz = lattice
    strides = np.array([(ny + 1) * (nz + 1), nz + 1, 1])
    boxes = np.stack(np.meshgrid(*(np.arange(n) for n in lattice), indexing="ij"), axis=-1).reshape(-1, 3)
    first = (boxes + (towards < 0)) @ strides
    steps = towards * strides
    cells = np.concatenate(
        [
            np.stack([first, first + steps[:, i], first + steps[:, i] + steps[:, j], first + steps.sum(axis=1)], axis=1)
            for i, j, _ in itertools.permutations(range(3))
        ]
    )
    edges = np.transpose(nodes[cells[:, 1:]] - nodes[cells[:, :1]], (0, 2, 1))
    turned = np.linalg.det(edges) < 0
    cells[turned] = cells[turned][:, [0, 2, 1, 3]]
    edges = np.transpose(nodes[cells[:, 1:]] - nodes[cells[:, :1]], (0, 2, 1))
    return BodyMesh(
        nodes=nodes,
        cells=cells,
        shapes=np.linalg.inv(edges),
        volumes=np.linalg.det(edges) / 6,
        lattice=lattice,
    )
