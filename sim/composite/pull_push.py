# SPDX-License-Identifier: MIT
"""Values at surface points as smooth images, by pull-push interpolation."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

CELLS = 160
"""Cells across the longer side: the values are smooth, and mesh vertices are denser."""


def spread_values(
    pixels: NDArray[np.floating], depth: NDArray[np.floating], values: NDArray[np.floating], size: tuple[int, int]
) -> NDArray[np.float32]:
    """Return a smooth map (H, W) with ``values`` (N,) at ``pixels`` (N, 2), of the nearest in ``depth`` (N,) per cell.

    size: width and height. Points behind the camera or far outside the image are ignored; without any, the map is 0.
    """
    width, height = size
    cell = max(2.0, max(size) / CELLS)
    columns, rows = int(np.ceil(width / cell)) + 2, int(np.ceil(height / cell)) + 2
    with np.errstate(invalid="ignore"):
        x, y = np.floor(pixels[:, 0] / cell) + 1, np.floor(pixels[:, 1] / cell) + 1
        inside = (depth > 0) & (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    if not inside.any():
        return np.zeros((height, width), np.float32)
    order = np.nonzero(inside)[0][np.argsort(-depth[inside], kind="stable")]
    grid = np.zeros((rows, columns), np.float32)
    known = np.zeros((rows, columns), np.float32)
    at = y[order].astype(int), x[order].astype(int)
    grid[at] = values[order]
    known[at] = 1.0
    full = cv2.resize(
        fill_gaps(grid, known), (round(columns * cell), round(rows * cell)), interpolation=cv2.INTER_LINEAR
    )
    start = round(cell)
    return np.ascontiguousarray(full[start : start + height, start : start + width])


def fill_gaps(values: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return ``values`` (h, w) with gaps, where ``known`` (h, w) is 0 and not 1, filled from coarser means by pull-push
    (Gortler et al. 1996, section 3.4)."""
    if bool(known.all()) or max(values.shape) == 1:
        return values
    half = (max(1, -(-values.shape[1] // 2)), max(1, -(-values.shape[0] // 2)))
    weight = cv2.resize(known, half, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(values * known, half, interpolation=cv2.INTER_AREA) / np.maximum(weight, 1e-9)
    coarse = fill_gaps(mean.astype(np.float32), (weight > 0).astype(np.float32))
    wide = cv2.resize(coarse, values.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(known > 0, values, wide).astype(np.float32)
