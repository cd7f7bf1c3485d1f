# SPDX-License-Identifier: MIT
"""Splats sampled on a mesh: flat discs spread evenly over its surface, in its colours, without gaps. No Taichi."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy import ndimage
from scipy.spatial import cKDTree

from ..errors import InputError
from ..mpm.geometry.triangles import SurfaceSamples, face_normals, sample_surface
from ..scene.textured_mesh import TexturedMesh
from .splats import MIN_SCALE, Splats

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

MAX_COUNT = 2_000_000
PLACES = 16
"""Surface samples for each splat, which takes the one nearest to the centroid of its cell."""
ROUNDS = 6
"""Iterations of Lloyd's algorithm; more hardly change the result."""
NORMAL_WEIGHT = 1.5
"""Spacings added to the distance of two samples whose normals differ by 60 degrees: both sides of a thin sheet get
splats."""

WIDTH = 0.75
"""Standard deviation along the surface, over the square root of a splat's cell area: an even distribution transmits at
most 3 % of light."""
THICKNESS = 0.1
"""Standard deviation across the surface, over the one along it."""
OPACITY = 0.97


@dataclass(frozen=True, eq=False)
class Texture:
    """Texture of a mesh. uv: (V, 2) of each vertex, origin at the bottom left; picture: (h, w, 3) uint8 sRGB, repeated
    beyond 0 to 1."""

    uv: Array
    picture: NDArray[np.uint8]

    @staticmethod
    def of(mesh: TexturedMesh) -> Texture | None:
        """Return the texture of a mesh file, or None. Raises InputError when its image is damaged."""
        if mesh.uv is None or mesh.picture is None:
            return None
        try:
            with Image.open(io.BytesIO(mesh.picture), formats=("PNG", "JPEG")) as image:
                return Texture(mesh.uv, np.asarray(image.convert("RGB")))
        except (OSError, UnidentifiedImageError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise InputError(f"texture of the mesh: not a readable image ({error}): export the mesh again") from None

    def at(self, uv: Array) -> Array:
        """Return (n, 3) sRGB colours, 0 to 1, at ``uv`` (n, 2), interpolated bilinearly."""
        height, width = self.picture.shape[:2]
        rows, columns = (1.0 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5
        values = self.picture.astype(np.float32) / 255
        return np.stack(
            [
                ndimage.map_coordinates(values[..., i], [rows, columns], order=1, mode="grid-wrap").astype(np.float64)
                for i in range(3)
            ],
            axis=1,
        )


def splats_on_mesh(vertices: Array, faces: Faces, colours: Array | Texture, count: int, *, seed: int = 0) -> Splats:
    """Return ``count`` splats on the surface of ``vertices`` (V, 3) m and ``faces`` (T, 3), uniform by area.

    They are centroids of cells of equal size (Lloyd 1982 over a dense sampling), flat along the surface with their
    third axis along the normal, as wide as their cell and almost opaque, so that together they hide what is behind.
    Each has the mean colour of its cell. colours: (V, 3) sRGB of the vertices, 0 to 1, or a texture.

    Deterministic. Raises InputError on a mesh without area, on colours that do not fit it and on a count out of range.
    """
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    _check(vertices, faces, colours, count)
    normals, areas = face_normals(vertices[faces])
    area = float(areas.sum())
    if not (np.isfinite(area) and area > 0):
        raise InputError(f"splats on a mesh: its area is {area:g} m²: give a mesh with finite corners and some area")
    places = sample_surface(vertices, faces, max(PLACES * count, 64))
    normal = normals[places.faces]
    chosen, cell = _evenly(places.places, normal, count, np.sqrt(area / count), np.random.default_rng(seed))
    share = np.bincount(cell, minlength=count) * area / len(cell)
    # The area of a cell of few samples is known only to one sample.
    side = np.sqrt(np.maximum(share, area / len(cell)))
    return Splats(
        centres=places.places[chosen],
        scales=np.maximum(side[:, None] * np.array([WIDTH, WIDTH, WIDTH * THICKNESS]), MIN_SCALE),
        rotations=_third_axis_along(normal[chosen]),
        opacities=np.full(count, OPACITY),
        colours=_means(_colours(places, faces, colours), cell, count, chosen),
    )


def _check(vertices: Array, faces: Faces, colours: Array | Texture, count: int) -> None:
    if not 1 <= count <= MAX_COUNT:
        raise InputError(f"splats on a mesh: count is {count!r}: give a whole number from 1 to {MAX_COUNT}")
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,) or not len(faces):
        raise InputError(
            f"splats on a mesh: vertices have shape {vertices.shape} and faces {faces.shape}: give (V, 3) and (T, 3)"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"splats on a mesh: faces refer to vertex {faces.max()} of {len(vertices)}: export it again")
    given = colours.uv if isinstance(colours, Texture) else np.asarray(colours)
    if given.shape != (len(vertices), 2 if isinstance(colours, Texture) else 3) or not np.isfinite(given).all():
        raise InputError(
            f"splats on a mesh: its colours have shape {given.shape}, or are not finite: give (V, 3) from 0 to 1, or a "
            f"texture with uv (V, 2), V = {len(vertices)}"
        )


def _evenly(
    places: Array, normals: Array, count: int, spacing: float, random: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return indices (count,) of the ``places`` (n, 3) that the splats take, and the cell (n,) of each place."""
    points = np.concatenate([places, NORMAL_WEIGHT * spacing * normals], axis=1)
    # Places come in the order of the triangles: one of each run is a good initial guess.
    ends = np.linspace(0, len(points), count + 1).astype(np.int64)
    middles = points[ends[:-1] + random.integers(0, np.maximum(np.diff(ends), 1))]
    for _ in range(ROUNDS):
        _, cell = cKDTree(middles).query(points)
        sizes = np.bincount(cell, minlength=count)
        sums = np.stack([np.bincount(cell, values, minlength=count) for values in points.T], axis=1)
        middles = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], middles)
    chosen = _each_its_own(cKDTree(points), middles)
    _, cell = cKDTree(points[chosen]).query(points)
    return chosen, cell.astype(np.int64)


def _each_its_own(tree: cKDTree, middles: Array) -> NDArray[np.int64]:
    """Return indices (count,) of the places of ``tree`` nearest to ``middles`` (count, d), each used once."""
    near = tree.query(middles, k=min(4, tree.n))[1].reshape(len(middles), -1)
    chosen = near[:, 0].copy()
    for rank in range(1, near.shape[1]):
        _, first = np.unique(chosen, return_index=True)
        twice = np.setdiff1d(np.arange(len(chosen)), first)
        chosen[twice] = near[twice, rank]
    return np.asarray(chosen, dtype=np.int64)


def _colours(places: SurfaceSamples, faces: Faces, colours: Array | Texture) -> Array:
    corners = faces[places.faces]
    if isinstance(colours, Texture):
        return colours.at(np.einsum("nc,nci->ni", places.weights, colours.uv[corners]))
    return np.asarray(np.einsum("nc,nci->ni", places.weights, np.asarray(colours, dtype=np.float64)[corners]))


def _means(values: Array, cell: NDArray[np.int64], count: int, chosen: NDArray[np.int64]) -> Array:
    """Return (count, 3) means over cells; an empty cell has the value at its splat."""
    sizes = np.bincount(cell, minlength=count)
    sums = np.stack([np.bincount(cell, values[:, i], minlength=count) for i in range(3)], axis=1)
    return np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], values[chosen])


def _third_axis_along(normals: Array) -> Array:
    """Return (N, 4) quaternions w, x, y, z of the shortest rotations from z to the unit ``normals`` (N, 3)."""
    x, y, z = normals.T
    turns = np.stack([1 + z, -y, x, np.zeros_like(x)], axis=1)
    # A half turn has no unique axis.
    turns[z < -1 + 1e-9] = (0.0, 1.0, 0.0, 0.0)
    return np.asarray(turns / np.linalg.norm(turns, axis=1, keepdims=True))
