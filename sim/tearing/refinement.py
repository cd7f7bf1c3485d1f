# SPDX-License-Identifier: MIT
"""Triangles near cracks made as small as the blocks of matter, with the mesh's own vertices first and unmoved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from .blocks import NEVER, Blocks

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

STEPS = 12
MOST_TRIANGLES = 400_000
"""Beyond, triangles stay as large as they are."""
NEAR = 2.0
"""Distance in sides of a block from a parted one, within which triangles are made smaller."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A mesh whose first V vertices are those ``before``. faces: (T, 3); source: (T,) the triangle each is part of;
    corners: (T, 3, 3) barycentric coordinates in it; parents, weights: (V', 3) vertices before, and shares,
    that each lies
    between."""

    vertices: Array
    before: int
    faces: Indices
    source: Indices
    corners: Array
    parents: Indices
    weights: Array


def touched_near(blocks: Blocks, opens: Indices) -> NDArray[np.bool_]:
    """Return which cells of the lattice have a block in their 3³ neighbourhood that a broken bond belongs to."""
    found = np.zeros(blocks.grid.shape, dtype=np.bool_)
    cells = blocks.cells[np.unique(blocks.bonds[opens < NEVER])]
    found[tuple(cells.T)] = True
    return np.asarray(binary_dilation(found, np.ones((3, 3, 3), np.bool_)))


def refine(vertices: Array, faces: Indices, side: float, touched: NDArray[np.bool_], blocks: Blocks) -> Refined:
    """Return the mesh with edges of at most ``side`` m where cells of ``blocks`` are ``touched``."""
    cells = np.argwhere(touched)
    tree = cKDTree(blocks.origin + (cells + 0.5) * blocks.side)
    source, corners = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3)).copy()
    original, places = faces, vertices
    for _ in range(STEPS):
        ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, of_face = np.unique(ends, axis=0, return_inverse=True)
        of_face = of_face.reshape(3, -1).T
        a, b = places[edges[:, 0]], places[edges[:, 1]]
        length = np.linalg.norm(b - a, axis=1)
        marked = length > side
        away = tree.query(0.5 * (a + b)[marked])[0]
        marked[marked] = away < 0.5 * length[marked] + NEAR * blocks.side
        if not marked.any() or len(faces) > MOST_TRIANGLES:
            break
        middle = np.full(len(edges), -1, dtype=np.int64)
        middle[marked] = len(places) + np.arange(int(marked.sum()))
        places = np.concatenate([places, 0.5 * (a + b)[marked]])
        faces, source, corners = _split(faces, source, corners, middle[of_face])
    parents, weights = np.repeat(np.arange(len(places))[:, None], 3, axis=1), np.tile((1.0, 0.0, 0.0), (len(places), 1))
    added = faces >= len(vertices)
    parents[faces[added]] = original[np.repeat(source, 3).reshape(-1, 3)[added]]
    weights[faces[added]] = corners[added]
    return Refined(
        vertices=places,
        before=len(vertices),
        faces=faces,
        source=source,
        corners=corners,
        parents=parents,
        weights=weights,
    )


def _split(faces: Indices, source: Indices, corners: Array, middle: Indices) -> tuple[Indices, Indices, Array]:
    """Triangles split at the vertices ``middle`` (T, 3) of their edges 01, 12, 20; -1 where an edge stays."""
    count = (middle >= 0).sum(axis=1)
    # Rotate so that of one marked edge it is 01, of two the unmarked one is 20.
    turn = np.where(count == 1, (middle >= 0).argmax(axis=1), np.where(count == 2, (middle < 0).argmax(axis=1) + 1, 0))
    order = (np.arange(3) + turn[:, None]) % 3
    faces, middle = np.take_along_axis(faces, order, axis=1), np.take_along_axis(middle, order, axis=1)
    corners = np.take_along_axis(corners, order[..., None], axis=1)
    six = np.concatenate([faces, middle], axis=1)
    halves = 0.5 * (corners + corners[:, [1, 2, 0]])
    places = np.concatenate([corners, halves], axis=1)
    patterns = {
        0: ((0, 1, 2),),
        1: ((0, 3, 2), (3, 1, 2)),
        2: ((0, 3, 4), (3, 1, 4), (0, 4, 2)),
        3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
    }
    made = []
    for marks, triangles in patterns.items():
        row = np.flatnonzero(count == marks)
        made += [(six[row][:, t], source[row], places[row][:, t]) for t in (list(t) for t in triangles)]
    new_faces, new_source, new_corners = (np.concatenate(parts) for parts in zip(*made, strict=True))
    order = np.argsort(new_source, kind="stable")
    return new_faces[order], new_source[order], new_corners[order]
