# SPDX-License-Identifier: MIT
"""A filling as sharp and as grainy as what is seen around its hole."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

BANDS = (1.0, 2.0)
"""Blurs in pixels between which details are compared."""
GAINS = (0.6, 1.8)
"""Details are weakened and strengthened by no more than this."""
REACH = 0.2
"""Blur over which their strength is averaged, over the hole's size."""


def as_grainy(picture: Picture, hole: Mask, known: Mask) -> Picture:
    """``picture`` (h, w, 3) with the details in ``hole`` as strong as in its ``known`` surroundings nearby."""
    reach = max(4.0, REACH * float(np.sqrt(hole.sum())))
    result, finer = np.zeros_like(picture), picture
    inner = cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    if inner.sum() < 100:
        return picture
    for blur in BANDS:
        coarser = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur), dtype=np.float32)
        detail = finer - coarser
        size = np.asarray(np.abs(detail).mean(axis=-1), dtype=np.float32)
        # By mean sizes and a cut at large ones: a few edges make no grain.
        size = np.minimum(size, np.float32(4.0 * float(np.median(size[inner])) + 0.5))
        wanted, has = _local(size, inner, reach), _local(size, hole, reach)
        gain = np.clip(wanted / np.maximum(has, 1e-2), *GAINS)
        result += np.where(hole[..., None], gain[..., None] * detail, detail)
        finer = coarser
    return np.asarray(result + finer, dtype=np.float32)


def _local(values: NDArray[np.float32], where: Mask, blur: float) -> NDArray[np.float32]:
    """Mean of ``values`` (h, w) ``where``, near each pixel."""
    scale = min(1.0, 6.0 / blur)
    size = (max(4, round(where.shape[1] * scale)), max(4, round(where.shape[0] * scale)))
    weight = where.astype(np.float32)
    total, share = (
        cv2.GaussianBlur(cv2.resize(part, size, interpolation=cv2.INTER_AREA), (0, 0), blur * scale)
        for part in (np.asarray(values * weight, dtype=np.float32), weight)
    )
    # Deep inside nothing known is near: the mean of all stands in.
    mean = float(values[where].mean())
    local = (total + 1e-3 * mean) / (share + 1e-3)
    return np.asarray(
        cv2.resize(local, (where.shape[1], where.shape[0]), interpolation=cv2.INTER_LINEAR), dtype=np.float32
    )
