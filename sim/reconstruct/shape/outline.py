# SPDX-License-Identifier: MIT
"""The outline of an object as points with weights, for fits in the photo's plane."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

GUESSED = 0.1
"""Weight of outline that is a guess, because something stands before it."""
BORDER = 1.5
"""Outline nearer than this to the photo's border, in pixels, is where the photo ends and not the object."""


@dataclass(frozen=True)
class Outline:
    """Points evenly along the outline of a mask.

    points: (n, 2) photo pixels; weights: (n,) 0 where nothing is known to 1; size: square root of the area in pixels.
    """

    points: Points
    weights: NDArray[np.float64]
    size: float

    def thinned(self, count: int) -> Outline:
        """About ``count`` of the points."""
        step = max(1, len(self.points) // count)
        return Outline(self.points[::step], self.weights[::step], self.size)


def outline_of(full: Mask, seen: Mask | None = None, count: int = 400) -> Outline:
    """The outer outline of ``full`` (H, W), which must not be empty, as about ``count`` points.

    Outline that borders on what is in ``full`` but not in ``seen`` weighs less, and at the photo's border nothing.
    """
    contours, _ = cv2.findContours(full.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(contours, key=cv2.contourArea)[:, 0, :].astype(np.float64)
    # Centres of border pixels lie half a pixel within the outline; smoothed and moved out by that.
    loop = longest + 0.5
    smooth = ndimage.gaussian_filter1d(loop, 1.0, axis=0, mode="wrap") if len(loop) > 8 else loop
    tangent = np.roll(smooth, -1, axis=0) - np.roll(smooth, 1, axis=0)
    length = np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    normal = np.column_stack([tangent[:, 1], -tangent[:, 0]]) / length
    area = float(cv2.contourArea(longest.astype(np.float32), oriented=True))
    smooth = smooth + 0.5 * normal * (1.0 if area > 0 else -1.0)
    smooth = smooth[_even(smooth, count)]
    height, width = full.shape
    x, y = smooth[:, 0], smooth[:, 1]
    inner = (x > BORDER) & (y > BORDER) & (x < width - BORDER) & (y < height - BORDER)
    weights = inner.astype(np.float64)
    hidden = full & ~seen if seen is not None else np.zeros_like(full)
    if hidden.any():
        reach = ndimage.binary_dilation(hidden, iterations=2)
        rows, columns = np.clip(y.astype(int), 0, height - 1), np.clip(x.astype(int), 0, width - 1)
        weights *= np.where(reach[rows, columns], GUESSED, 1.0)
    return Outline(points=smooth, weights=weights, size=float(np.sqrt(full.sum())))


def _even(loop: Points, count: int) -> NDArray[np.int64]:
    """Indices of about ``count`` points of the closed ``loop`` (n, 2), evenly by length."""
    steps = np.linalg.norm(np.diff(loop, axis=0, append=loop[:1]), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
    wanted = np.linspace(0.0, along[-1], min(count, len(loop)))
    return np.unique(np.searchsorted(along, wanted).clip(0, len(loop) - 1))


def hull_polygon(pixels: Points) -> Points:
    """The convex hull (m, 2) of ``pixels`` (n, 2)."""
    index = cv2.convexHull(pixels.astype(np.float32), returnPoints=False)[:, 0]
    return pixels[index]


def distance_to_convex(points: Points, polygon: Points) -> NDArray[np.float64]:
    """Signed distance (n,) of ``points`` (n, 2) to a convex ``polygon`` (m, 2), positive inside."""
    start = polygon
    edge = np.roll(polygon, -1, axis=0) - start
    squared = np.maximum((edge**2).sum(axis=1), 1e-12)
    offset = points[:, None, :] - start[None]
    along = np.clip((offset * edge).sum(axis=-1) / squared, 0.0, 1.0)
    distance = np.linalg.norm(offset - along[..., None] * edge, axis=-1).min(axis=1)
    cross = edge[:, 0] * offset[..., 1] - edge[:, 1] * offset[..., 0]
    inside = (cross >= 0).all(axis=1) | (cross <= 0).all(axis=1)
    return np.where(inside, distance, -distance)
