# SPDX-License-Identifier: MIT
"""Silhouettes of a mesh in a view, by points spread over its surface: a few milliseconds, whatever the mesh is like."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera

Points = NDArray[np.float64]
Faces = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Spread:
    """Points on a surface. places: (n, 3); faces: (n) on which triangle; weights: (n, 3) of its corners."""

    places: Points
    faces: NDArray[np.int64]
    weights: Points


def spread(vertices: Points, faces: Faces, count: int) -> Spread:
    """``count`` points spread evenly over the triangles; the same for equal meshes."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    random = np.random.default_rng(0)
    chosen = np.sort(random.choice(len(faces), size=count, p=areas / areas.sum()))
    pair = random.random((count, 2))
    folded = pair.sum(axis=1) > 1
    pair[folded] = 1 - pair[folded]
    weights = np.column_stack([1 - pair.sum(axis=1), pair])
    return Spread(np.einsum("nc,nci->ni", weights, vertices[faces[chosen]]), chosen, weights)


@dataclass(frozen=True)
class Window:
    """A part of the photo at a coarser scale. left, top: photo pixels of its corner; cell: photo pixels of its pixels.

    target: (h, w) what the silhouette should be; open: (h, w) where nobody knows.
    """

    left: float
    top: float
    cell: float
    target: Mask
    open: Mask

    @staticmethod
    def around(seen: Mask, unknown: Mask, side: int) -> Window:
        """The window around ``seen`` (H, W) with half its size as a border, the object ``side`` pixels large in it."""
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        extent = max(len(range(rows[0], rows[-1] + 1)), len(range(columns[0], columns[-1] + 1)))
        cell, pad = extent / side, 0.5 * extent
        left, top = columns[0] - pad, rows[0] - pad
        size = (
            round((columns[-1] + 1 - columns[0] + 2 * pad) / cell),
            round((rows[-1] + 1 - rows[0] + 2 * pad) / cell),
        )
        matrix = np.array([[cell, 0, left + cell / 2 - 0.5], [0, cell, top + cell / 2 - 0.5]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP

        def shrunk(mask: Mask, beyond: float) -> Mask:
            smooth = cv2.blur(mask.astype(np.float32), (max(1, round(cell)),) * 2)
            return np.asarray(cv2.warpAffine(smooth, matrix, size, flags=flags, borderValue=beyond) > 0.5)

        # What lies beyond the photo's border nobody knows either.
        return Window(float(left), float(top), float(cell), shrunk(seen, 0.0), shrunk(unknown, 1.0))

    def cells(self, pixels: Points) -> tuple[NDArray[np.int64], NDArray[np.int64], Mask]:
        """Rows and columns (n) of photo ``pixels`` (n, 2+), and which of them lie inside."""
        columns = np.floor((pixels[:, 0] - self.left) / self.cell)
        rows = np.floor((pixels[:, 1] - self.top) / self.cell)
        height, width = self.target.shape
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        return rows[inside].astype(np.int64), columns[inside].astype(np.int64), np.asarray(inside)

    def silhouette(self, camera: Camera, places: Points) -> Mask:
        """Where (h, w) the camera sees ``places`` (n, 3), small gaps between points closed."""
        seen = camera.project(places)
        rows, columns, _ = self.cells(np.where(seen[:, 2:] > 0, seen, np.inf))
        picture = np.zeros(self.target.shape, dtype=np.uint8)
        picture[rows, columns] = 1
        return np.asarray(cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0)

    def overlap(self, found: Mask) -> float:
        """Intersection over union of ``found`` (h, w) with the target, where it is known."""
        known = ~self.open
        union = int(((found | self.target) & known).sum())
        return int((found & self.target & known).sum()) / max(1, union)
