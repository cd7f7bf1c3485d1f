# SPDX-License-Identifier: MIT
"""Which points of the ground a direction of light reaches past the objects.

A shadow on a plane is a parallel projection, so it is drawn from above, in the plane's own coordinates: many points of
the objects' surfaces slide down along the light onto a grid, and gaps below a cell are closed. Perspective comes in
only when the grid is looked up at the points that the photo shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

CELLS = 320
"""Along the grid's longer side; an object is some fifty of them large."""
SURFACE_POINTS = 16_000
"""On each object: several a cell, also in a shadow three times as long as the object is high."""
MIN_COSINE = 0.1
"""Light lower than 6° over the ground is left out: its shadows are longer than the ground that is looked at."""


def surface_points(vertices: Points, faces: NDArray[np.integer], count: int = SURFACE_POINTS) -> Points:
    """Points (count, 3) evenly over the surface of ``vertices`` (V, 3), ``faces`` (T, 3); the same ones every time."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    random = np.random.default_rng(0)
    if not area.sum() > 0:
        return np.asarray(vertices[random.integers(0, len(vertices), count)])
    chosen = random.choice(len(faces), count, p=area / area.sum())
    u, v = random.random((2, count, 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    return np.asarray(a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen])


class Caster:
    """Shadows of surfaces at points of the ground, the plane z = 0."""

    def __init__(self, surfaces: Sequence[Points], ground: Points) -> None:
        """surfaces: points (M, 3) on each object. ground: points (N, 2) that are asked about."""
        surface = np.concatenate(surfaces)
        self._surface = np.column_stack([surface[:, :2], np.maximum(surface[:, 2], 0.0)])
        low, high = ground.min(axis=0), ground.max(axis=0)
        self._cell = max(float((high - low).max()) / CELLS, 1e-12)
        self._low = low - 2 * self._cell
        self._shape = tuple(int(v) for v in np.ceil((high - low) / self._cell)[::-1] + 5)
        at = ((ground - self._low) / self._cell - 0.5).astype(np.float32)
        # OpenCV looks up at most 32767 points a row.
        self._count, columns = len(at), 1024
        padded = -(-max(self._count, 1) // columns) * columns
        x, y = (np.pad(at[:, i], (0, padded - self._count)).reshape(-1, columns) for i in (0, 1))
        self._x, self._y = x, y

    def _shadow(self, direction: Points) -> NDArray[np.float32]:
        """The shadow (rows, columns) of light from the unit vector ``direction`` (3,) on the grid: 1 inside."""
        slide = direction[:2] / direction[2]
        flat = (self._surface[:, :2] - self._surface[:, 2:] * slide - self._low) / self._cell
        column, row = np.floor(flat).astype(np.int64).T
        inside = (row >= 0) & (row < self._shape[0]) & (column >= 0) & (column < self._shape[1])
        grid = np.zeros(self._shape, dtype=np.uint8)
        grid[row[inside], column[inside]] = 1
        closed = cv2.morphologyEx(grid, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        # The outline of points in whole cells, without its stairs.
        return np.asarray(cv2.blur(closed.astype(np.float32), (3, 3)))

    def reaching(self, directions: Points, weights: Points) -> NDArray[np.float64]:
        """Share (N,) of light from unit vectors ``directions`` (D, 3) that reaches the points past the objects.

        weights: (D,) how much each gives to open ground; what comes from below 6° is left out.
        """
        use = (directions[:, 2] >= MIN_COSINE) & (weights > 0)
        if not use.any():
            return np.ones(self._count)
        shares = weights[use] / weights[use].sum()
        blocked = np.zeros(self._shape, dtype=np.float32)
        for direction, share in zip(directions[use], shares, strict=True):
            blocked += np.float32(share) * self._shadow(direction)
        seen = cv2.remap(blocked, self._x, self._y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return 1.0 - np.clip(seen.reshape(-1)[: self._count].astype(np.float64), 0.0, 1.0)


def sun_disc(direction: Points, angle: float, count: int) -> tuple[Points, Points]:
    """Unit vectors (count, 3) over a sun of diameter ``angle`` (rad) about ``direction`` (3,), and their weights.

    Evenly over a flat disc, as Cycles has it (radius tan(angle / 2), intern/cycles/kernel/light/distant.h), in
    sunflower order; a weight is the cosine on the ground.
    """
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(helper, direction)
    first /= np.linalg.norm(first)
    second = np.cross(direction, first)
    number = np.arange(count)
    radius = math.tan(min(angle, 2.8) / 2.0) * np.sqrt((number + 0.5) / count)
    turn = number * math.pi * (3.0 - math.sqrt(5.0))
    found = direction + radius[:, None] * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found, np.maximum(found[:, 2], 0.0)


def even_sky(count: int = 160) -> tuple[Points, Points]:
    """Unit vectors (count, 3) of a sky that is three times as bright at the zenith as at the horizon (CIE overcast
    sky, CIE S 011), and their weights (count,) on the ground. Spread with the cosine, in sunflower order.
    """
    number = np.arange(count)
    height = np.sqrt(1.0 - (number + 0.5) / count)
    turn = number * math.pi * (3.0 - math.sqrt(5.0))
    flat = np.sqrt(1.0 - height**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height]), 1.0 + 2.0 * height
