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

from .box_crop import FINE, crop_around_box, edge_crest, edge_strength, small_copy
from .mask_geometry import Mask, grown, ring_around
from .part_contour import CLOSED, STANDS_OUT, PartContour, joined_with, thick_regions

SEAM = 4
"""Pixels of the copy between a limb and its end in which their colours are mixed."""
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
    copy = small_copy(mask.shape, FINE)
    own, other = copy.mask(mask), copy.mask(others)
    view = crop_around_box(copy.pixels(pixels), copy.box(box), other)
    if own.sum() < 400:
        return np.zeros_like(mask)
    regions = thick_regions(view.pixels, max(20, int(0.001 * own.sum())))
    crest = edge_crest(edge_strength(view.lab))
    depth, seam = _depth(own), grown(own, SEAM - 1)
    found = np.zeros_like(own)
    for index in np.unique(regions[ring_around(own, SEAM) & view.inside]):
        region = (regions == index) & ~own & ~other
        # What goes on outside of the box is ground.
        if region.any() and not (region & ~view.inside).any():
            part = _largest(region)
            if _ends_limb(PartContour(view, part, seam, crest), own, depth):
                found |= part
    if not found.any():
        return np.zeros_like(mask)
    near = grown(found, SEAM)
    added = joined_with(own, found) & near & ~own & view.inside
    return copy.enlarged(added) & ~mask & ~others


def _largest(region: Mask) -> Mask:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=4)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def _depth(mask: Mask) -> NDArray[np.float32]:
    """Distance (h, w) of the pixels of ``mask`` from its outline; the picture's border is one."""
    inside = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray(inside[1:-1, 1:-1], dtype=np.float32)


def _ends_limb(contour: PartContour, mask: Mask, depth: NDArray[np.float32]) -> bool:
    """Whether the part is the end of a limb of ``mask`` (h, w), see the module. depth: (h, w) of ``mask``."""
    part, area = contour.part, float(mask.sum())
    width = 2.0 * float(_depth(part).max())
    if not LEAST * area <= float(part.sum()) <= MOST * area or width < WIDTH * float(np.sqrt(area)):
        return False
    if not (SHARED[0] < contour.shared < SHARED[1] and contour.on_edges > CLOSED and contour.sharpness > STANDS_OUT):
        return False
    limb = ring_around(part, round(REACH * (width + SEAM))) & mask
    if not limb.any() or 2.0 * float(depth[limb].max()) >= LIMB * (width + SEAM):
        return False
    return contour.going_on < ALIKE and not contour.is_shade
