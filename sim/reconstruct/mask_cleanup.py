# SPDX-License-Identifier: MIT
"""From what GrabCut finds to the silhouette of one thing: no specks, no pinholes, no shadow, no stairs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def largest_component(mask: Mask) -> Mask:
    """The largest 8-connected part of ``mask``; an empty mask stays empty."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count <= 1:
        return mask.copy()
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def smooth_outline(mask: Mask, sigma: float | None = None) -> Mask:
    """``mask`` with its stair-steps and hairs removed: Gaussian blur, cut at one half.

    sigma: pixels; None goes by the mask's size (0.8 to 2.5), so that thin straps survive.
    """
    if sigma is None:
        sigma = float(np.clip(np.sqrt(mask.sum()) / 200.0, 0.8, 2.5))
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred > 0.5)


def surrounding_ring(mask: Mask, width: int) -> Mask:
    """Background within ``width`` pixels outside of ``mask``, holes excluded."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
    binary = mask.astype(np.uint8)
    return np.asarray((cv2.dilate(binary, kernel) > 0) & ~mask & ~enclosed_holes(mask))


def enclosed_holes(mask: Mask) -> Mask:
    """Background that does not reach the border of the image (4-connected)."""
    padded = np.pad((~mask).astype(np.uint8), 1, constant_values=1)
    _, labels = cv2.connectedComponents(padded, connectivity=4)
    return np.asarray((labels != labels[0, 0]) & (padded > 0))[1:-1, 1:-1]


def fill_holes(pixels: NDArray[np.uint8], mask: Mask, *, small: float = 0.004, likeness: float = 14.0) -> Mask:
    """``mask`` without pinholes; large holes stay open only where the background shows through them.

    pixels: (H, W, 3) sRGB. small: holes below this fraction of the mask's area are always filled, 0 to 1.
    likeness: CIELAB distance (delta E) up to which a colour counts as the background's.
    A hole is see-through when most of its pixels look like the ground next to the object at the same height, and it
    is wider than a letter printed on a cover.
    """
    holes = enclosed_holes(mask)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8), connectivity=4)
    result = mask.copy()
    if count <= 1:
        return result
    area = int(mask.sum())
    lab = cv2.cvtColor(pixels.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    ring = surrounding_ring(mask, max(4, round(0.12 * np.sqrt(area))))
    for index in range(1, count):
        hole = labels == index
        size = int(stats[index, cv2.CC_STAT_AREA])
        width = 2.0 * float(cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 3).max())
        narrow = width < 0.05 * np.sqrt(area)
        if size < small * area or narrow or not _shows_background(lab, hole, ring, stats[index], likeness):
            result |= hole
    return result


def _shows_background(
    lab: NDArray[np.float32], hole: Mask, ring: Mask, stats: NDArray[np.int32], likeness: float
) -> bool:
    top, height = int(stats[cv2.CC_STAT_TOP]), int(stats[cv2.CC_STAT_HEIGHT])
    rows = slice(max(0, top - height), top + 2 * height)
    near = lab[rows][ring[rows]]
    if len(near) < 20:
        return False
    inside = lab[hole]
    # Up to 300 colours of each tell as much as all of them, in a small distance matrix.
    near, inside = near[:: max(1, len(near) // 300)], inside[:: max(1, len(inside) // 300)]
    nearest = np.linalg.norm(inside[:, None] - near[None], axis=2).min(axis=1)
    return bool((nearest < likeness).mean() > 0.85)


def drop_ground_shadow(pixels: NDArray[np.uint8], mask: Mask, *, most: float = 0.1) -> Mask:
    """``mask`` without the contact shadow that GrabCut takes for a dark part of the object.

    A shadow keeps the ground's chromaticity and only loses brightness. Only the lower part of the object, reached
    from its outline, is looked at, and at most the fraction ``most`` of the mask is taken away.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    if len(rows) == 0:
        return mask.copy()
    top, bottom = int(rows[0]), int(rows[-1])
    low = np.zeros_like(mask)
    low[bottom - (bottom - top) // 3 :] = True
    area = int(mask.sum())
    ground = surrounding_ring(mask, max(4, round(0.15 * np.sqrt(area)))) & low
    if ground.sum() < 50:
        return mask.copy()
    linear = (cv2.GaussianBlur(pixels, (0, 0), 1.2).astype(np.float32) / 255.0) ** 2.2 + 1e-4
    brightness = linear.sum(axis=2)
    chroma = linear / brightness[..., None]
    reference = np.median(chroma[ground], axis=0)
    spread = np.percentile(np.linalg.norm(chroma[ground] - reference, axis=1), 75)
    like_ground = np.linalg.norm(chroma - reference, axis=2) < np.clip(2.5 * spread, 0.03, 0.09)
    darker = brightness < 0.85 * np.median(brightness[ground])
    suspect = mask & low & like_ground & darker
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    suspect = cv2.morphologyEx(suspect.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    outside = ~mask & low
    reached = largest_reaching(suspect, outside)
    cleaned = cv2.morphologyEx((mask & ~reached).astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    # Opening must not thin what was never suspected, a strap for instance.
    cleaned |= mask & ~cv2.dilate(reached.astype(np.uint8), kernel, iterations=3).astype(bool)
    cleaned = largest_component(cleaned)
    removed = area - int(cleaned.sum())
    return cleaned if 0 < removed <= most * area else mask.copy()


def largest_reaching(candidates: Mask, target: Mask) -> Mask:
    """Those 8-connected parts of ``candidates`` that touch ``target``."""
    _, labels = cv2.connectedComponents(candidates.astype(np.uint8), connectivity=8)
    touching = cv2.dilate(target.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    reached = np.unique(labels[touching & candidates])
    return np.asarray(np.isin(labels, reached[reached > 0]))
