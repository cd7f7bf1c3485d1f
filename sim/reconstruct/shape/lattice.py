# SPDX-License-Identifier: MIT
"""Primitives as meshes of even quadrilaterals: the surface of a lattice of cubes, carried onto the body.

Sharper than what marching cubes cuts, and exact in volume. The bend in the photo's plane that makes the outline the
object's own moves the vertices; the base stays on the ground.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..view.camera import ground_depth
from .crop import Crop
from .mesh import BodyMesh, standing_mesh
from .primitives import Box, Primitive, Revolved, Sphere
from .warp import Fitting

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

NARROW = 0.25
"""Width of the strip along an edge over that of other quadrilaterals: smooth shading stays flat up to it."""
FEWEST = 4
"""Quadrilaterals along each edge of the lattice, at least."""


def cube_surface(counts: tuple[int, int, int]) -> tuple[NDArray[np.int64], Faces]:
    """Lattice coordinates (V, 3) and triangles (T, 3), outward, of the surface of a block of ``counts`` cubes."""
    shape = tuple(n + 1 for n in counts)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    quads = []
    for axis in range(3):
        for end in (0, counts[axis]):
            face = np.take(grid, end, axis=axis)
            # np.take keeps the order of the other two axes: x, z for axis 1.
            if axis == 1:
                face = np.swapaxes(face, 0, 1)
            index = np.ravel_multi_index(tuple(np.moveaxis(face, -1, 0)), shape)
            a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
            quad = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
            quads.append(quad if end else quad[:, ::-1])
    quad = np.concatenate(quads)
    used, renumbered = np.unique(quad, return_inverse=True)
    quad = renumbered.reshape(-1, 4)
    at = np.stack(np.unravel_index(used, shape), axis=-1)
    # The shorter diagonal cannot be known here; alternate them, so that no direction is preferred.
    even = (at[quad[:, 0]].sum(axis=1) % 2 == 0)[:, None]
    one = np.where(even, quad[:, [0, 1, 2]], quad[:, [1, 2, 3]])
    two = np.where(even, quad[:, [0, 2, 3]], quad[:, [1, 3, 0]])
    return at, np.concatenate([one, two])


def primitive_mesh(primitive: Primitive, target: int) -> tuple[Points, Faces]:
    """Vertices (V, 3), about ``target``, and triangles (T, 3) of a closed primitive, world units."""
    extents = _extents(primitive)
    # A block of a × b × c cubes has about 2 (ab + bc + ca) vertices on its surface.
    a, b, c = extents
    cell = np.sqrt(2.0 * (a * b + b * c + c * a) / target)
    counts = tuple(max(FEWEST, round(float(e / cell))) for e in extents)
    at, faces = cube_surface((counts[0], counts[1], counts[2]))
    unit = np.stack([_spaced(counts[i], primitive)[at[:, i]] for i in range(3)], axis=-1)
    if isinstance(primitive, Box):
        across, along = primitive.axes
        ground = 0.5 * (primitive.width * unit[:, :1] * across + primitive.depth * unit[:, 1:2] * along)
        foot = np.array([primitive.x, primitive.y])
        return np.column_stack([foot + ground, primitive.height * (unit[:, 2] + 1.0) / 2.0]), faces
    if isinstance(primitive, Sphere):
        bent = np.tan(unit * np.pi / 4.0)
        points = primitive.centre + primitive.axes * bent / np.linalg.norm(bent, axis=1, keepdims=True)
        return np.column_stack([points[:, :2], np.maximum(points[:, 2], 0.0)]), faces
    assert isinstance(primitive, Revolved)
    heights, radii = np.array(primitive.heights), np.array(primitive.radii)
    z = primitive.height * (unit[:, 2] + 1.0) / 2.0
    radius = np.interp(z, heights, radii)
    # A square becomes a disc: rings by the larger coordinate, the angle along each side even.
    ring = np.abs(unit[:, :2]).max(axis=1)
    bent = np.tan(unit[:, :2] / np.maximum(ring, 1e-12)[:, None] * np.pi / 4.0)
    direction = bent / np.maximum(np.linalg.norm(bent, axis=1, keepdims=True), 1e-12)
    ground = np.array([primitive.x, primitive.y]) + (ring * radius)[:, None] * direction
    return np.column_stack([ground, z]), faces


def _extents(primitive: Primitive) -> tuple[float, float, float]:
    if isinstance(primitive, Box):
        return primitive.width, primitive.depth, primitive.height
    if isinstance(primitive, Sphere):
        return (primitive.radius * np.pi / 2.0,) * 3
    assert isinstance(primitive, Revolved)
    side = float(np.mean(primitive.radii)) * np.pi / 2.0
    return side, side, primitive.height


def _spaced(count: int, primitive: Primitive) -> Points:
    """Lattice planes (count + 1,) from -1 to 1: even, but narrow at the ends of what has edges."""
    if isinstance(primitive, Sphere):
        return np.linspace(-1.0, 1.0, count + 1)
    steps = np.ones(count)
    steps[[0, -1]] = NARROW
    return np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum() * 2.0 - 1.0


def bent_mesh(camera: Camera, crop: Crop, primitive: Primitive, fitted: Fitting, target: int) -> BodyMesh:
    """``primitive`` with the outline of ``crop`` as far as ``fitted`` carries it, standing on the ground."""
    vertices, faces = primitive_mesh(primitive, target)
    projected = camera.project(vertices)
    at = projected[:, :2] - np.array([crop.left + 0.5, crop.top + 0.5])
    move = np.stack(
        [ndimage.map_coordinates(fitted.shift[..., i], at[:, ::-1].T, order=1, mode="nearest") for i in (0, 1)], axis=-1
    )
    # The shift leads from the object to the primitive; the vertices go the other way.
    pixels = projected[:, :2] - move
    depth = projected[:, 2]
    before, after = (ground_depth(camera, camera.rays(p)) for p in (projected[:, :2], pixels))
    low = np.clip(1.0 - vertices[:, 2] / primitive.height, 0.0, 1.0)
    with np.errstate(invalid="ignore"):
        slid = np.where(np.isfinite(after) & np.isfinite(before), after / before, 1.0)
    depth = depth * (1.0 + low * (slid - 1.0))
    on_ground = vertices[:, 2] <= 1e-9 * primitive.height
    depth = np.where(on_ground, after, np.minimum(depth, after))
    return standing_mesh(camera, pixels, depth, faces)
