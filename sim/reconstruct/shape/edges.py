# SPDX-License-Identifier: MIT
"""Edges that the photo shows inside an outline: where a box' faces meet."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from .primitives import Box

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

SIDE = 240
"""Pixels along the longer side of the object on the picture in which edges are looked for."""
SAMPLES = 14
"""Points along each edge."""
FACES = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1))
"""Axis and end of the faces that can be seen: all but the base."""
STRONG = 90.0
"""Percentile of the gradient inside the object that counts as an edge."""


class InnerEdges:
    """The gradient inside an object, at ``SIDE`` pixels."""

    def __init__(self, pixels: NDArray[np.uint8], full: Mask, seen: Mask) -> None:
        """pixels: (H, W, 3) sRGB; full, seen: (H, W) outline and visible part; not empty."""
        rows, columns = np.flatnonzero(full.any(axis=1)), np.flatnonzero(full.any(axis=0))
        self._top, self._left = int(rows[0]), int(columns[0])
        window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        height, width = rows[-1] + 1 - rows[0], columns[-1] + 1 - columns[0]
        self._scale = min(1.0, SIDE / max(height, width))
        size = (max(8, round(width * self._scale)), max(8, round(height * self._scale)))
        small = cv2.resize(pixels[window], size, interpolation=cv2.INTER_AREA).astype(np.float64)
        inside = cv2.resize(seen[window].astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
        self._ratio = np.array([size[0] / width, size[1] / height])
        self._inside = ndimage.binary_erosion(inside, iterations=5)
        # The logarithm: a face in the shade differs from a lit one by a factor.
        tone = np.log1p(small.mean(axis=2))
        blurred = [ndimage.gaussian_filter(channel, 1.8) for channel in (tone, *_chroma(small))]
        self._gradients = [np.stack([ndimage.sobel(c, axis=1), ndimage.sobel(c, axis=0)]) for c in blurred]
        strength = np.sqrt(sum((g**2).sum(axis=0) for g in self._gradients))
        values = strength[self._inside]
        self._strong = max(float(np.percentile(values, STRONG)) if len(values) else 0.0, 0.05)

    def missing(self, camera: Camera, box: Box) -> NDArray[np.float64]:
        """0 (a clear edge in the photo) to 1 for each inner edge of ``box``; always three values."""
        corners = box.corners()
        projected = camera.project(corners)
        if not (projected[:, 2] > 1e-6).all():
            return np.ones(3)
        at = (projected[:, :2] - [self._left, self._top]) * self._ratio
        answers = []
        for first, second in _inner_edges(camera, box, corners):
            along = at[second] - at[first]
            length = float(np.linalg.norm(along))
            if length < 6.0:
                continue
            normal = np.array([-along[1], along[0]]) / length
            places = at[first] + np.linspace(0.08, 0.92, SAMPLES)[:, None] * along - 0.5
            where = places[:, ::-1].T
            known = ndimage.map_coordinates(self._inside.astype(np.float64), where, order=1, mode="constant")
            across = np.zeros(SAMPLES)
            for gradient in self._gradients:
                dx, dy = (ndimage.map_coordinates(part, where, order=1, mode="nearest") for part in gradient)
                across += (dx * normal[0] + dy * normal[1]) ** 2
            shown = np.minimum(np.sqrt(across) / self._strong, 1.0)
            if known.sum() < 3.0:
                continue
            share = float((shown * known).sum() / known.sum())
            answers.append((1.0 - share) * min(1.0, length / 40.0))
        return np.array(([*answers, 0.0, 0.0, 0.0])[:3])


def _chroma(small: Points) -> tuple[Points, Points]:
    total = small.sum(axis=2) + 30.0
    return 2.0 * small[..., 0] / total, 2.0 * small[..., 2] / total


def _inner_edges(camera: Camera, box: Box, corners: Points) -> list[tuple[int, int]]:
    """Pairs of corners: edges between two faces that both look at the camera."""
    across, along = box.axes
    away = camera.position - np.array([box.x, box.y, 0.0])
    seen = {
        (0, 0): -(away[:2] @ across) > box.width / 2.0,
        (0, 1): away[:2] @ across > box.width / 2.0,
        (1, 0): -(away[:2] @ along) > box.depth / 2.0,
        (1, 1): away[:2] @ along > box.depth / 2.0,
        (2, 1): away[2] > box.height,
    }
    faces = [face for face in FACES if seen[face]]
    edges = []
    for i, (axis, end) in enumerate(faces):
        for other, other_end in faces[i + 1 :]:
            if axis == other:
                continue
            shared = [c for c in range(8) if (c >> axis & 1) == end and (c >> other & 1) == other_end]
            edges.append((shared[0], shared[1]))
    return edges
