# SPDX-License-Identifier: MIT
"""A filling kept within the light and the colours that are seen around its hole."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

PERCENTILES = (2.0, 98.0)
SLACK = 0.02
"""Logarithm by which the slow part of a filling may leave the range of its surroundings."""
RIM = 0.35
"""How far around a hole light is compared, over the hole's size."""
SLOW = 0.06
"""Blur in which it is compared, over the hole's size."""
PIXELS = 60_000
"""Of the copy on which this is done."""

# Lightness, and two differences of colours: a glow of one colour may keep within each channel's own range.
AXES = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, -1.0, 0.0], [0.5, 0.5, -1.0]], dtype=np.float32)


def bounded(logs: Picture, hole: Mask, known: Mask) -> Picture:
    """``logs`` (h, w, 3), of a filled picture, without glow or gloom in ``hole`` that is not seen around it.

    known: what is true around the hole.
    """
    scale = min(1.0, float(np.sqrt(PIXELS / hole.size)))
    size = (max(8, round(hole.shape[1] * scale)), max(8, round(hole.shape[0] * scale)))
    small = cv2.resize(logs, size, interpolation=cv2.INTER_AREA) @ AXES.T
    cut, seen = (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) for mask in (hole, known))
    side = float(np.sqrt(max(float(cut.sum()), 1.0)))
    away = cv2.distanceTransform((cut < 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    rim = (seen > 0.9) & (away <= max(RIM * side, 4.0))
    inside = cut > 0.5
    if rim.sum() < 30 or not inside.any():
        return logs
    around, own = _slow(small, seen > 0.9, SLOW * side), _slow(small, inside, SLOW * side)
    low, high = np.percentile(around[rim], PERCENTILES, axis=0)
    change = np.clip(own, low - SLACK, high + SLACK) - own
    change = np.where(inside[..., None], change, 0.0).astype(np.float32) @ np.linalg.inv(AXES).T.astype(np.float32)
    if not change.any():
        return logs
    # Carried over the border of the hole, so that enlarging it mixes in no zero.
    change = _slow(change, inside, max(0.5 * SLOW * side, 1.0))
    whole = cv2.resize(change, (hole.shape[1], hole.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.where(hole[..., None], logs + whole, logs), dtype=np.float32)


def _slow(values: Picture, where: Mask, blur: float) -> Picture:
    """``values`` (h, w, 3) averaged over those ``where``."""
    weight = where.astype(np.float32)
    blur = max(blur, 0.8)
    total = cv2.GaussianBlur(np.ascontiguousarray(values * weight[..., None], dtype=np.float32), (0, 0), blur)
    return np.asarray(total / np.maximum(cv2.GaussianBlur(weight, (0, 0), blur), 1e-4)[..., None], dtype=np.float32)
