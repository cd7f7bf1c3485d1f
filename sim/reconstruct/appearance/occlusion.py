# SPDX-License-Identifier: MIT
"""Which points light from far away reaches past surfaces: a depth map for each direction.

Williams, Casting Curved Shadows on Curved Surfaces (SIGGRAPH 1978), filtered over four cells as by Reeves, Salesin and
Cook, Rendering Antialiased Shadows with Depth Maps (SIGGRAPH 1987). The map is drawn by many points on the surfaces.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

CELLS = 64
"""Along the longer side of what is asked about."""
SLACK = 1.5
"""Cells by which a surface may lie before a point and still be the point's own."""


def around(direction: Points) -> tuple[Points, Points]:
    """Two unit vectors (3,) at right angles to the unit vector ``direction`` (3,) and to each other."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(helper, direction)
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)


class Occluders:
    """Shadows on ``points`` (N, 3) with unit ``normals`` (N, 3) by surfaces that ``surface`` (M, 3) covers densely."""

    def __init__(self, surface: Points, points: Points, normals: Points) -> None:
        self._surface = surface
        cell = max(float(np.ptp(points, axis=0).max()), 1e-12) / CELLS
        self._cell = cell
        # Away from the surface, or a point would lie in its own shadow.
        self._points = points + SLACK * cell * normals

    def reached(self, direction: Points) -> NDArray[np.float64]:
        """Share (N,) of light from the unit vector ``direction`` (3,) that reaches each point past the surfaces."""
        first, second = around(direction)
        axes, cell = np.stack([first, second, direction]), self._cell
        local, places = self._surface @ axes.T, self._points @ axes.T
        low = places[:, :2].min(axis=0) - 2 * cell
        columns, rows = (int(v) + 4 for v in np.ptp(places[:, :2], axis=0) / cell)
        at = np.floor((local[:, :2] - low) / cell).astype(np.int64)
        inside = (at[:, 0] >= 0) & (at[:, 0] < columns) & (at[:, 1] >= 0) & (at[:, 1] < rows)
        lowest = float(min(places[:, 2].min(), local[:, 2].min())) - 4 * cell
        depth = np.full(rows * columns, lowest, dtype=np.float64)
        np.maximum.at(depth, at[inside, 1] * columns + at[inside, 0], local[inside, 2])
        grid = depth.reshape(rows, columns).astype(np.float32)
        closed = cv2.morphologyEx(grid, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
        flat = np.asarray(closed, dtype=np.float64).ravel()
        x, y = ((places[:, :2] - low) / cell - 0.5).T
        column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        right, lower = x - column, y - row
        index = row * columns + column
        limit = places[:, 2] + SLACK * cell
        open_to = np.zeros(len(places))
        for step, share in (
            (0, (1 - right) * (1 - lower)),
            (1, right * (1 - lower)),
            (columns, (1 - right) * lower),
            (columns + 1, right * lower),
        ):
            open_to += share * (flat[index + step] <= limit)
        return open_to
