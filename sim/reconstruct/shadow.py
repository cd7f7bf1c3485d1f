# SPDX-License-Identifier: MIT
"""Shadows that objects cast on the ground, and the hole that both leave (PhysGen3D, supplement A.2).

Ground that is darker than a threshold and connected with the object is its shadow. The paper uses one fixed grey
value; here the threshold follows the brightness of the ground around each object, because a dark table is darker
in the light than a white one in the shade.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .mask_cleanup import enclosed_holes

Mask = NDArray[np.bool_]

SHADOW_RATIO = 0.80
"""Ground below this fraction of its lit brightness is shadow."""


def ground_brightness(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Grey values 0 to 255 (H, W) without grain and the finest texture."""
    grey = cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY).astype(np.float32)
    sigma = max(1.0, max(grey.shape) / 500.0)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma), dtype=np.float32)


def find_shadow(
    grey: NDArray[np.float32],
    mask: Mask,
    others: Mask,
    *,
    horizon_row: float,
    fixed_threshold: float | None = None,
) -> Mask:
    """The shadow (H, W) that the object in ``mask`` casts on the ground, without the object.

    grey: from ``ground_brightness``. others: all other objects. horizon_row: pixels; nothing above is ground.
    fixed_threshold: grey value 0 to 255 in place of the adaptive threshold.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    height, width = rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1
    reach = round(0.7 * max(height, width))
    region = np.zeros_like(mask)
    # The lower part of the object and below: what is dark higher up stands behind it, a wall for instance.
    top = max(round(rows[-1] - 0.22 * height - 0.05 * width), int(np.ceil(horizon_row)), 0)
    region[
        top : rows[-1] + reach // 2,
        max(0, columns[0] - reach) : columns[-1] + reach,
    ] = True
    near = max(3, round(0.04 * np.sqrt(mask.sum())))
    ground = region & ~mask & ~others
    if not ground.any():
        return np.zeros_like(mask)
    threshold = SHADOW_RATIO * _lit_ground(grey, ground) if fixed_threshold is None else fixed_threshold
    dark = (grey < threshold) & ground
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * near + 1, 2 * near + 1))
    grain = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * (near // 3) + 1,) * 2)
    dark = cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_OPEN, grain) > 0
    # The seam between object and shadow is a mixture of both colours: bridge it.
    bridge = (cv2.dilate(mask.astype(np.uint8), grain, iterations=2) > 0) & ground
    _, labels = cv2.connectedComponents((mask | dark | bridge).astype(np.uint8), connectivity=8)
    own = np.unique(labels[mask])
    shadow = np.isin(labels, own[own > 0]) & (dark | (bridge & (cv2.dilate(dark.astype(np.uint8), kernel) > 0)))
    closed = cv2.morphologyEx((shadow | mask).astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    return np.asarray(closed & ground & (dark | shadow))


def _lit_ground(grey: NDArray[np.float32], ground: Mask) -> NDArray[np.float32]:
    """Brightness that the ground would have without shadow: a plane through its brighter half, by least squares."""
    y, x = np.nonzero(ground)
    step = max(1, len(y) // 20_000)
    y, x = y[::step], x[::step]
    values = grey[y, x].astype(np.float64)
    centre = np.array([x.mean(), y.mean()])
    scale = max(float(np.ptp(x)), float(np.ptp(y)), 1.0)
    basis = np.column_stack([np.ones(len(x)), (x - centre[0]) / scale, (y - centre[1]) / scale])
    keep = values >= np.percentile(values, 40)
    fit = np.linalg.lstsq(basis[keep], values[keep], rcond=None)[0]
    for _ in range(3):
        residual = values - basis @ fit
        spread = max(2.0, 1.48 * float(np.median(np.abs(residual[keep]))))
        keep = np.abs(residual) < 2.0 * spread
        if keep.sum() < 20:
            break
        fit = np.linalg.lstsq(basis[keep], values[keep], rcond=None)[0]
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(np.float32)
    plane = fit[0] + fit[1] * (columns - centre[0]) / scale + fit[2] * (rows - centre[1]) / scale
    return np.asarray(np.clip(plane, values.min(), values.max()), dtype=np.float32)


def object_holes(masks: Sequence[Mask], shadows: Sequence[Mask], dilation: float) -> list[Mask]:
    """What each object leaves behind: mask and shadow, dilated, but never over another object.

    dilation: side of the kernel in pixels of this photo. An object's hole may reach another object's shadow.
    """
    side = max(1, round(dilation)) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    holes = []
    for index, (mask, shadow) in enumerate(zip(masks, shadows, strict=True)):
        hole = cv2.dilate((mask | shadow).astype(np.uint8), kernel) > 0
        # What is left of the photo inside a strap would stand there as an island.
        hole |= enclosed_holes(hole)
        for other, blocked in enumerate(masks):
            if other != index:
                hole &= ~(blocked & ~mask)
        holes.append(np.asarray(hole))
    return holes
