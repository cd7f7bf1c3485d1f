# SPDX-License-Identifier: MIT
"""How much of the photo around an object is still right, fading as the object leaves the place where it stood.

Two fades. The photo's own shadow goes when the object's contact has moved. The rim, a few pixels around the mask that
still show some of the object itself, goes as soon as the outline there has moved by a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

FADE_START = 0.004
FADE_END = 0.08
"""Displacement of the contact over the object's size between which the photo's shadow gives way to the rendered one.
Below the first a body has merely settled; at the second its shadow has visibly left."""

RIM_SHARE = 0.006
"""Width of the rim over the longer side of the image; lenses and sharpening spread an outline about so far."""

RIM_FADE_PX = (0.25, 1.5)
"""Movement of the outline on the image, in pixels, between which the rim gives way."""

CONTACT_HEIGHT = 0.15
"""Share of an object's height, from its lowest point, that counts as its contact."""


def contact_vertices(rest: NDArray[np.floating], up: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which of the vertices ``rest`` (V, 3) lie at the foot of the object, along the unit vector ``up``."""
    heights = np.asarray(rest) @ np.asarray(up)
    low = heights.min()
    return np.asarray(heights <= low + CONTACT_HEIGHT * max(float(np.ptp(heights)), 1e-9))


def contact_displacement(
    rest: NDArray[np.floating], now: NDArray[np.floating], contact: NDArray[np.bool_], size: float
) -> float:
    """Mean displacement of the contact over ``size``, both in metres: 0 at rest, 1 one object size away."""
    return float(np.linalg.norm(np.asarray(now)[contact] - np.asarray(rest)[contact], axis=1).mean()) / size


def rest_weight(displacement: float) -> float:
    """1 at rest, 0 when gone, smooth between (``displacement`` as ``contact_displacement`` gives it)."""
    return float(_fade(np.asarray(displacement), FADE_START, FADE_END))


def _fade(value: NDArray[np.floating], start: float, end: float) -> NDArray[np.float64]:
    """1 up to ``start``, 0 from ``end``, smooth between."""
    t = np.clip((np.asarray(value, dtype=np.float64) - start) / (end - start), 0.0, 1.0)
    return 1.0 - t * t * (3.0 - 2.0 * t)


def influence(places: Sequence[NDArray[np.bool_]]) -> NDArray[np.float32]:
    """Whose shadow a pixel shows (N, H, W), summing to 1 over the N objects, by nearness to their ``places`` (H, W).

    An object without any pixel counts nowhere, unless none has one.
    """
    nearness = []
    for place in places:
        if not place.any():
            nearness.append(np.zeros(place.shape, np.float32))
            continue
        distance = cv2.distanceTransform((~place).astype(np.uint8), cv2.DIST_L2, 5)
        nearness.append(1.0 / (1.0 + distance.astype(np.float32)) ** 2)
    stack = np.stack(nearness)
    total = stack.sum(axis=0, keepdims=True)
    even = np.full_like(stack, 1.0 / len(places))
    return np.where(total > 0, stack / np.maximum(total, 1e-12), even).astype(np.float32)


def rest_map(shares: NDArray[np.float32], weights: Sequence[float]) -> NDArray[np.float32]:
    """The weight w of each pixel (H, W) from ``influence`` (N, H, W) and the objects' ``rest_weight`` (N).

    Exactly 1 when all are at rest, which the sum of rounded shares need not be.
    """
    moved = 1.0 - np.asarray(weights, dtype=np.float32)
    return np.clip(1.0 - np.tensordot(moved, shares, axes=1), 0.0, 1.0).astype(np.float32)


def rim_strength(mask: NDArray[np.bool_], others: NDArray[np.bool_]) -> NDArray[np.float32]:
    """How much of the object with ``mask`` its rim shows (H, W), 0 to 1; ``others`` (H, W) are never rim."""
    strength = np.zeros(mask.shape, np.float32)
    if mask.any():
        width = max(2.0, RIM_SHARE * max(mask.shape))
        distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
        rim = (distance <= width) & ~mask & ~others
        strength[rim] = _fade(np.asarray(distance[rim], dtype=np.float64), width / 2, width)
    return strength


class Rim:
    """The pixels around one object's mask that still show some of it, and which of its vertices each belongs to."""

    def __init__(self, strength: NDArray[np.float32], rest_px: NDArray[np.floating]) -> None:
        """``strength`` (H, W): how much of the object a pixel shows; ``rest_px`` (V, 2) are its vertices in pixels."""
        self._rest_px = np.asarray(rest_px, dtype=np.float64)
        self._pixels = np.nonzero(strength > 0)
        rows, columns = self._pixels
        self._strength = strength[self._pixels].astype(np.float64)
        known = np.isfinite(self._rest_px).all(axis=1)
        self._known = np.nonzero(known)[0]
        if len(self._known):
            _, nearest = KDTree(self._rest_px[known]).query(np.stack([columns + 0.5, rows + 0.5], axis=1))
            self._vertex = self._known[nearest]

    def apply(self, at_rest: NDArray[np.float32], now_px: NDArray[np.floating]) -> None:
        """Lower ``at_rest`` (H, W) in place where the vertices, now at ``now_px`` (V, 2), have moved."""
        if not len(self._known):
            return
        moved = np.linalg.norm(np.asarray(now_px) - self._rest_px, axis=1)[self._vertex]
        weight = _fade(np.nan_to_num(moved, nan=np.inf, posinf=1e9), *RIM_FADE_PX)
        at_rest[self._pixels] *= (1.0 - self._strength * (1.0 - weight)).astype(np.float32)
