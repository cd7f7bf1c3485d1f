# SPDX-License-Identifier: MIT
"""Closed meshes of signed distance fields: marching cubes, then every vertex moved onto the surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from .fields import Array, Field, Triple

BLOCK = 4
"""Lattice points along a side of what is looked at together: far from the surface one value stands for all."""
SLACK = 1.2
"""Blocks whose middle is within so many of their sides of the surface are looked at: the farthest point of a block and
one lattice step beyond are 0.9 away, and fields may overstate distances a little."""
POLISH = 2


def meshed(field: Field, low: Triple, high: Triple, spacing: float) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (T, 3), wound outwards, of the surface of ``field`` within the box.

    spacing: metres between the lattice's points. What is thinner than two of them is lost; a surface that leaves the
    box is cut open, so give a box with room.
    """
    side = BLOCK * spacing
    # A shift that nobody models in keeps flat faces off the lattice's planes, where marching cubes makes slivers.
    origin = np.array(low) - side * np.array([1.0137, 1.0271, 1.0093])
    blocks = np.ceil((np.array(high) - origin) / side).astype(np.int64) + 1
    index = np.stack(np.meshgrid(*(np.arange(n) for n in blocks), indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = np.stack(np.meshgrid(*(np.arange(BLOCK),) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    coarse = field(origin + (index * BLOCK + (BLOCK - 1) / 2) * spacing)
    values = np.repeat(coarse[:, None], BLOCK**3, axis=1)
    near = np.abs(coarse) < SLACK * side
    points = origin + (index[near, None] * BLOCK + offsets) * spacing
    values[near] = field(points.reshape(-1, 3)).reshape(-1, BLOCK**3)
    lattice = values.reshape(*blocks, BLOCK, BLOCK, BLOCK).transpose(0, 3, 1, 4, 2, 5).reshape(blocks * BLOCK)
    vertices, faces, _, _ = marching_cubes(lattice, 0.0, gradient_direction="descent")
    placed = origin + vertices.astype(np.float64) * spacing
    return _polished(field, placed, spacing), faces.astype(np.int64)


def gradient(field: Field, points: Array, step: float) -> Array:
    """(N, 3) central differences."""
    shifts = step * np.eye(3)
    return np.stack([(field(points + s) - field(points - s)) / (2 * step) for s in shifts], axis=1)


def _polished(field: Field, points: Array, spacing: float) -> Array:
    """Newton's steps onto the surface along the slope found first, no farther than a third of a lattice cell.

    Farther, triangles would fold where the slope has a crease.
    """
    slope = gradient(field, points, 0.05 * spacing)
    slope /= np.maximum((slope**2).sum(axis=1, keepdims=True), 0.25)
    reach = spacing / 3 / np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
    moved = np.zeros(len(points))
    for _ in range(POLISH):
        moved = np.clip(moved - field(points + moved[:, None] * slope), -reach, reach)
    return points + moved[:, None] * slope
