# SPDX-License-Identifier: MIT
"""How much of the photo's own shadow is still right: per object, fading as it leaves the place where it stood."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

FADE_START = 0.004
FADE_END = 0.35
"""Displacement of the contact over the object's size between which the photo's shadow gives way to the rendered one.
Below the first a body has merely settled; at the second its shadow has visibly left."""

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
    t = min(max((displacement - FADE_START) / (FADE_END - FADE_START), 0.0), 1.0)
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
