# SPDX-License-Identifier: MIT
"""Feet and hands of another colour at the ends of a mask's limbs, such as white feet of a red toy on a grey sill.

Colours lose them where the ground is nearly as pale. But a limb does not end where its colour changes: at its end is a
part of about its width, of even colour, closed by edges against everything else, and nothing of its colour lies beyond.
Ground beside a thing touches it along a broad side instead.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .contour_evidence import (
    APART,
    CLOSED,
    CREST,
    FINE,
    SEAM,
    STANDS_OUT,
    is_shade_of,
    joined_with,
    thick_regions,
)
from .mask_cleanup import ring_around
from .mask_proposals import BoxCrop, crop_around_box, edge_strength

Mask = NDArray[np.bool_]

LEAST, MOST = 0.003, 0.06
"""Area of such a part over the mask's. Feet of a toy had 0.005 to 0.013."""
WIDTH = 0.04
"""Least width of such a part over the mask's size."""
LIMB = 2.0
"""Largest width of the mask near the part over the part's, with its seam: 1.1 to 1.9 for limbs, 3 (the most that is
looked at) for a broad side."""
REACH = 1.5
"""How far into the mask its width is looked at, over the same width: the inscribed circle at a broad side is as wide as
twice that."""
SHARED = (0.28, 0.6)
"""Share of its contour that such a part has in common with the mask: neither a touch nor a pocket. Feet and hands had
0.31 to 0.56, blades of grass, twigs and a dark corner of a room 0.13 to 0.26."""
ALIKE = 0.15
"""Largest share of what lies beyond that has the part's colour."""


def limb_ends(pixels: NDArray[np.uint8], box: tuple[int, int, int, int], mask: Mask, others: Mask) -> Mask:
    """Return what ``mask`` (h, w) lacks at the ends of its limbs, with the seams between.

    pixels: (h, w, 3) sRGB. box: x0, y0, x1, y1 around the object. others: (h, w) what is certainly no part of it. Cost:
    about a second.
    """
    height, width = mask.shape
    scale = min(1.0, FINE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    own, other = (
        np.asarray(cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_AREA)) > 0.5
        for part in (mask, others)
    )
    x0, y0, x1, y1 = (round(v * scale) for v in box)
    view = crop_around_box(small, (x0, y0, max(x1, x0 + 1), max(y1, y0 + 1)), other)
    if own.sum() < 400:
        return np.zeros_like(mask)
    regions = thick_regions(view.pixels, max(20, int(0.001 * own.sum())))
    crest = np.asarray(cv2.dilate(edge_strength(view.lab), np.ones((3, 3), np.uint8)), dtype=np.float32)
    depth = _depth(own)
    found = np.zeros_like(own)
    for index in np.unique(regions[ring_around(own, SEAM) & view.inside]):
        region = (regions == index) & ~own & ~other
        # What goes on outside of the box is ground.
        if region.any() and not (region & ~view.inside).any():
            part = _largest(region)
            if _ends_limb(view, part, own, depth, crest):
                found |= part
    if not found.any():
        return np.zeros_like(mask)
    near = cv2.dilate(found.astype(np.uint8), np.ones((2 * SEAM + 1, 2 * SEAM + 1), np.uint8)) > 0
    added = joined_with(own, found) & near & ~own & view.inside
    large = cv2.resize(added.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
    return np.asarray(large) & ~mask & ~others


def _largest(region: Mask) -> Mask:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=4)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def _depth(mask: Mask) -> NDArray[np.float32]:
    """Distance (h, w) of the pixels of ``mask`` from its outline; the picture's border is one."""
    inside = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray(inside[1:-1, 1:-1], dtype=np.float32)


def _ends_limb(view: BoxCrop, part: Mask, mask: Mask, depth: NDArray[np.float32], crest: NDArray[np.float32]) -> bool:
    """Whether ``part`` (h, w) is the end of a limb of ``mask``, see the module. depth: of ``mask``; crest: (h, w)."""
    area, size = float(mask.sum()), float(np.sqrt(mask.sum()))
    width = 2.0 * float(_depth(part).max())
    if not LEAST * area <= float(part.sum()) <= MOST * area or width < WIDTH * size:
        return False
    near_mask = cv2.dilate(mask.astype(np.uint8), np.ones((2 * SEAM - 1, 2 * SEAM - 1), np.uint8)) > 0
    rim = ring_around(part, 1)
    own = rim & ~near_mask
    if not SHARED[0] < float((rim & near_mask).sum()) / float(rim.sum()) < SHARED[1]:
        return False
    if (crest[own] > CREST).mean() <= CLOSED or np.median(crest[own]) <= STANDS_OUT * CREST:
        return False
    limb = ring_around(part, round(REACH * (width + SEAM))) & mask
    if not limb.any() or 2.0 * float(depth[limb].max()) >= LIMB * (width + SEAM):
        return False
    inner = cv2.erode(part.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    beyond = ring_around(part, 5) & ~ring_around(part, 2) & ~near_mask & ~view.others
    if inner.sum() < 10 or beyond.sum() < 10:
        return False
    colour, outside = np.median(view.lab[inner], axis=0), view.lab[beyond]
    if (np.linalg.norm(outside - colour, axis=1) < APART).mean() >= ALIKE:
        return False
    return not is_shade_of(colour, np.median(outside, axis=0))
