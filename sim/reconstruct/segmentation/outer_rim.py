# SPDX-License-Identifier: MIT
"""Thin rims around a mask that the colour models gave to the background: pages around a cover, a card's white edge.

Models of colour are learned over the whole crop, so white pages count as ground where a white wall stands somewhere
else. Here each pixel beside the outline is compared with what lies just beyond, at the same place: a rim is unlike it,
is no shade of it, and ends at a sharp edge of its own after a small and even way. Ground goes on, a mirror image fades,
and a halo of the camera's sharpening is two or three pixels wide.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...srgb import cielab
from .box_crop import edge_crest, edge_strength, small_copy
from .mask_geometry import Mask, grown, touching

Values = NDArray[np.float32]

SIDE = 900
"""Longest side in pixels of the copy on which rims are searched."""
REACH = 0.06
"""Largest width of a rim over the object's size."""
LEAST_WIDTH, LEAST_PIXELS = 0.008, 3.0
"""Least median width over the object's size, and in pixels of the copy."""
LONG = 0.2
"""Least length of a rim over the object's size."""
BEYOND = (1.2, 1.7, 2.3)
"""Where the ground is looked at, over the reach, away from the outline."""
ASIDE = (-1.0, 0.0, 1.0)
"""The same along the outline."""
UNLIKE = 12.0
"""Least distance in CIELAB from all of that."""
SHARP, SHARP_SHARE = 2.5, 0.75
"""Gradient of an edge, in CIELAB units per pixel, and the share of the rim's outer border that lies on one."""
EVEN = 10.0
"""Largest median deviation in CIELAB of a rim's pixels from its median colour."""
MOST = 0.2
"""Largest area of all rims over the object's."""
SEAM = 2.0
"""Pixels of the copy by which the outline may be off."""
FAINT = 3.0
"""Distance in CIELAB from the ground above which a pixel between two parts of a rim, and of its colour, belongs to
it."""


def outer_rim(pixels: NDArray[np.uint8], mask: Mask, closed: Mask) -> Mask:
    """Return the rim (H, W) of the object ``mask`` in ``pixels`` (H, W, 3) sRGB; mostly there is none.

    closed: (H, W) pixels that may not belong to it. It touches the mask.
    """
    nothing = np.zeros_like(mask)
    if not mask.any():
        return nothing
    copy = small_copy(mask.shape, SIDE)
    found = _rim(copy.pixels(pixels), copy.mask(mask), copy.mask(closed))
    if not found.any():
        return nothing
    whole = copy.enlarged(found)
    # Pixels where the colours of rim and object mix are unlike both.
    seam = 2 * max(1, round(1.5 / copy.scale)) + 1
    joined = cv2.morphologyEx((whole | mask).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((seam, seam), np.uint8)) > 0
    return np.asarray(joined & ~mask & ~closed & (cv2.dilate(whole.astype(np.uint8), np.ones((seam, seam))) > 0))


def _rim(pixels: NDArray[np.uint8], mask: Mask, barred: Mask) -> Mask:
    """``outer_rim`` of the small copy."""
    nothing = np.zeros_like(mask)
    extent = float(np.sqrt(mask.sum()))
    reach, least = REACH * extent, max(LEAST_PIXELS, LEAST_WIDTH * extent)
    if reach < 1.5 * least:
        return nothing
    lab = cielab(pixels, blur=0.8)
    away = np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5), dtype=np.float32)
    band = ~mask & ~barred & (away <= reach)
    apart = _apart(lab, away, mask | barred, band, reach)
    # What is thinner than a rim is a halo, or colours that mix along the outline.
    side = round(least)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    candidates = cv2.morphologyEx((band & (apart > UNLIKE)).astype(np.uint8), cv2.MORPH_OPEN, disc)
    sharp = edge_crest(edge_strength(lab)) > SHARP
    _, labels = cv2.connectedComponents(candidates, connectivity=8)
    rim = nothing.copy()
    for index, window in enumerate(ndimage.find_objects(labels), start=1):
        rows, columns = (slice(max(0, s.start - 1), s.stop + 1) for s in window)
        part = (labels == index)[rows, columns]
        if float(np.hypot(*part.shape)) < LONG * extent or away[rows, columns][part].min() > 3.0:
            continue
        if _ends(part, away[rows, columns], sharp[rows, columns], reach) and _even(lab[rows, columns], part):
            rim[rows, columns] |= part
    if not rim.any():
        return nothing
    rim = _continued(lab, away, mask, rim, np.where(band, apart, 0.0))
    return rim if rim.sum() < MOST * mask.sum() else nothing


def _apart(lab: Values, away: Values, covered: Mask, band: Mask, reach: float) -> Values:
    """Least distance (h, w) in CIELAB of pixels of the ``band`` from the ground beyond it, lit or shaded; 0 where none
    is seen."""
    smooth = cv2.GaussianBlur(away, (0, 0), 2.0)
    out = np.stack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)], axis=-1)
    rows, columns = np.nonzero(band)
    normal = out[rows, columns]
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    place, own = np.column_stack([columns, rows]).astype(np.float32), lab[rows, columns]
    least, seen = np.full(len(rows), np.inf, np.float32), np.zeros(len(rows), bool)
    height, width = away.shape
    for further in BEYOND:
        for aside in ASIDE:
            along = np.column_stack([-normal[:, 1], normal[:, 0]])
            at = place + (further * reach - away[rows, columns])[:, None] * normal + aside * reach * along
            x, y = np.round(at).astype(np.int64).T
            shown = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            x, y = x.clip(0, width - 1), y.clip(0, height - 1)
            shown &= ~covered[y, x] & (away[y, x] > reach)
            ground = lab[y, x]
            off = np.linalg.norm(own - ground, axis=1)
            # The same ground in the shade.
            factor = (own[:, 0] + 16.0) / (ground[:, 0] + 16.0)
            tint = np.linalg.norm(own[:, 1:] - factor[:, None] * ground[:, 1:], axis=1)
            shade = (factor < 0.98) & (tint < 6.0 + 0.12 * np.linalg.norm(ground[:, 1:], axis=1))
            least = np.where(shown, np.minimum(least, np.where(shade, 0.0, off)), least).astype(np.float32)
            seen |= shown
    result = np.zeros_like(away)
    result[rows, columns] = np.where(seen, least, 0.0)
    return result


def _ends(part: Mask, away: Values, sharp: Mask, reach: float) -> bool:
    """Whether ``part`` (h, w) ends within ``reach``, at an edge."""
    rim = grown(part) & ~part
    depth = float(np.median(away[part]))
    outer = rim & (away > depth)
    if not outer.any() or (away[outer] > reach - 1.0).mean() > 0.1:
        return False
    return bool(sharp[outer].mean() > SHARP_SHARE)


def _even(lab: Values, part: Mask) -> bool:
    """Whether the inner pixels of ``part`` (h, w) have the colour of one thing."""
    inner = part & (cv2.blur(part.astype(np.float32), (3, 3)) > 0.99)
    colours = lab[inner if inner.sum() >= 10 else part]
    return float(np.median(np.linalg.norm(colours - np.median(colours, axis=0), axis=1))) < EVEN


def _continued(lab: Values, away: Values, mask: Mask, rim: Mask, apart: Values) -> Mask:
    """``rim`` (h, w) with what goes on in its colour, no wider: where it is thinner, and before a wall of nearly its
    colour.

    apart: (h, w) distances from the ground, 0 where there is none.
    """
    # Its own colour is that of the pixels least like the ground; along its borders they are mixed.
    pure = rim & (apart >= np.median(apart[rim]))
    colour, wide = np.median(lab[pure], axis=0), float(np.quantile(away[rim], 0.95)) + SEAM
    off = np.linalg.norm(lab - colour, axis=2)
    alike = ~mask & (away <= wide) & (off < 2.0 * UNLIKE) & (apart > np.maximum(FAINT, off))
    result = rim | touching(np.asarray(alike | rim), rim)
    # Between it and the object lie mixed colours only.
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * (round(wide) // 2) + 1,) * 2)
    both = cv2.morphologyEx((mask | result).astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0
    return np.asarray(both & ~mask & (cv2.dilate(result.astype(np.uint8), disc) > 0))
