# SPDX-License-Identifier: MIT
"""Clean up masks: specks, pinholes, contact shadows, mixed pixels and stair-steps."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.segmentation import watershed

from ...srgb import cielab
from .box_crop import is_smoother
from .mask_geometry import enclosed_holes, largest_component, shrunk, touching

Mask = NDArray[np.bool_]

SHADE = (0.28, 0.9)
"""Range of a contact shadow's brightness over that of the lit ground: below is the crease itself or a black object."""

HOLE, SLOT, LONG = 0.05, 0.02, 0.25
"""Width of a hole over the object's size from which the background may show through it; of a slot, as between the back
and the seat of a chair; and the least length of that. Letters on a cover are shorter."""

COLOURED = 60.0
"""Saturation, of 255, that a contact shadow may have over that of the lit ground, at least."""

BOX_CORNERS, CORNER_CUT, BOX_OVERLAP = 6, 0.015, 0.96
"""A box' outline: most corners, how far off they may be over its length, and the least overlap with them."""
BESIDE = 8.0
"""Median distance in CIELAB, row by row, from the background beside above which a hole shows something else: 0.4 to 6
was measured in a strap, a handle, between slats, legs and limbs, 10 to 16 for a dial, a stripe and a shaded side."""
MARKS, MARK, MARK_SIZE = 5, 2.5, 0.008
"""Marks from which a region is a printed face and no hole: numerals on a dial, dots and letters; distance of their
colours from any of the background's, over ``likeness``; and their least extent over the object's size. What shows
through a hole is the background, which has no marks of its own there."""
PRINT_SHARE = 0.25
"""Largest share of a box that is a print: the opening of a frame is larger."""


def smooth_outline(mask: Mask, sigma: float | None = None) -> Mask:
    """Return ``mask`` without stair-steps and hairs: Gaussian blur, threshold at one half.

    sigma: pixels; None depends on the mask's size (0.8 to 2.5), so that thin straps survive.
    """
    if sigma is None:
        sigma = float(np.clip(np.sqrt(mask.sum()) / 200.0, 0.8, 2.5))
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred > 0.5)


def surrounding_ring(mask: Mask, width: int) -> Mask:
    """Return background within ``width`` pixels outside of ``mask``, holes excluded."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
    binary = mask.astype(np.uint8)
    return np.asarray((cv2.dilate(binary, kernel) > 0) & ~mask & ~enclosed_holes(mask))


def fill_holes(pixels: NDArray[np.uint8], mask: Mask) -> Mask:
    """Return ``mask`` with pinholes and prints filled; holes stay open only where the background shows through.

    A label on a carton may have the ground's colour: nothing shows through a box. pixels: (H, W, 3) sRGB.
    """
    holes = enclosed_holes(mask)
    if not holes.any() or is_box_with_print(mask, holes):
        return mask | holes
    return mask | (holes & ~see_through(pixels, mask, holes, slots=True))


def is_box_with_print(mask: Mask, holes: Mask) -> bool:
    """Return whether ``mask`` with its ``holes`` (H, W), not empty, is the outline of a box, and they are too small for
    a frame's."""
    filled = (mask | holes).astype(np.uint8)
    area = int(filled.sum())
    hull = cv2.convexHull(cv2.findNonZero(filled))
    corners = cv2.approxPolyDP(hull, CORNER_CUT * cv2.arcLength(hull, True), True)
    if len(corners) > BOX_CORNERS or int(holes.sum()) > PRINT_SHARE * area:
        return False
    drawn = np.zeros_like(filled)
    cv2.fillConvexPoly(drawn, corners, 1)
    return bool((drawn & filled).sum() > BOX_OVERLAP * (drawn | filled).sum())


def open_holes(pixels: NDArray[np.uint8], mask: Mask, *, within: Mask | None = None) -> Mask:
    """Return ``mask`` without interior regions that look like the background beside it: inside a handle, a strap.

    GrabCut includes them when the box holds so much background that it is learned as an object colour. pixels: (H, W,
    3) sRGB. within: (H, W) where such regions are looked for, everywhere by default.
    """
    area = int(mask.sum())
    lab = cielab(np.asarray(cv2.GaussianBlur(pixels, (0, 0), 1.0), dtype=np.uint8))
    ring = surrounding_ring(mask, max(4, round(0.12 * np.sqrt(area))))
    inner = shrunk(mask, 2) if within is None else shrunk(mask, 2) & within
    near, inside = lab[ring], lab[inner]
    if len(near) < 50 or len(inside) < 50:
        return mask.copy()
    alike = np.zeros_like(mask)
    alike[inner] = cKDTree(near[:: max(1, len(near) // 2000)]).query(inside, distance_upper_bound=6.0)[0] < 6.0
    side = 2 * max(1, round(0.02 * np.sqrt(area))) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    closed = cv2.morphologyEx(alike.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    candidates = (cv2.morphologyEx(closed, cv2.MORPH_OPEN, kernel) > 0) & mask
    opened = see_through(pixels, mask, candidates, likeness=8.0, share=0.9)
    # More than half of the object is not a hole but an object of the ground's colour.
    return mask & ~opened if opened.sum() < 0.5 * area else mask.copy()


def see_through(
    pixels: NDArray[np.uint8],
    mask: Mask,
    regions: Mask,
    *,
    likeness: float = 14.0,
    share: float = 0.85,
    slots: bool = False,
) -> Mask:
    """Return the connected parts of ``regions`` through which the background shows.

    Most of their pixels (``share``, 0 to 1) look like the ground beside the object at about the same height, within
    ``likeness`` (CIELAB delta E), they are as rough as it, without marks, and wider than a letter printed on a cover.
    slots: also narrow and long ones, of half of that likeness.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(regions.astype(np.uint8), connectivity=4)
    result = np.zeros_like(mask)
    area = int(mask.sum())
    size = float(np.sqrt(area))
    lab = cielab(pixels)
    ring = surrounding_ring(mask | regions, max(4, round(0.12 * np.sqrt(area))))
    for index in range(1, count):
        region = labels == index
        width = 2.0 * float(cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, 3).max())
        long = max(stats[index, cv2.CC_STAT_WIDTH], stats[index, cv2.CC_STAT_HEIGHT]) > LONG * size
        narrow = width < HOLE * size
        if stats[index, cv2.CC_STAT_AREA] < 0.004 * area or (narrow and not (slots and long and width > SLOT * size)):
            continue
        like = 0.5 * likeness if narrow else likeness
        top, height = int(stats[index, cv2.CC_STAT_TOP]), int(stats[index, cv2.CC_STAT_HEIGHT])
        rows = slice(max(0, top - height), top + 2 * height)
        near = lab[rows][ring[rows]]
        if len(near) < 20:
            continue
        inside = lab[region]
        # Some hundred samples of each are enough.
        near, inside = near[:: max(1, len(near) // 600)], inside[:: max(1, len(inside) // 600)]
        colours = cKDTree(near)
        distances = colours.query(inside)[0]
        apart = float(np.linalg.norm(np.median(near, axis=0) - np.median(inside, axis=0)))
        if (distances < like).mean() > share and apart < 1.5 * like and _as_beside(lab, region, ring):
            beside = np.zeros_like(mask)
            beside[rows] = ring[rows]
            if not is_smoother(lab[..., 0], region, beside) and not _has_marks(lab, region, colours, like, size):
                result |= region
    return result


def _has_marks(lab: NDArray[np.float32], region: Mask, colours: cKDTree, like: float, size: float) -> bool:
    """Whether ``MARKS`` or more marks lie in ``region`` (H, W), unlike the background's ``colours``.

    size: the object's, in pixels. What touches the region's outline is the object's, not a mark.
    """
    inside = shrunk(region | enclosed_holes(region), 2)
    unlike = np.zeros_like(region)
    unlike[inside] = colours.query(lab[inside], distance_upper_bound=MARK * like)[0] > MARK * like
    _, labels, stats, _ = cv2.connectedComponentsWithStats(unlike.astype(np.uint8), connectivity=8)
    outer = np.unique(labels[inside & ~shrunk(inside)])
    large = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) >= max(3.0, MARK_SIZE * size)
    large[0] = large[outer] = False
    return int(large.sum()) >= MARKS


def _as_beside(lab: NDArray[np.float32], region: Mask, ring: Mask) -> bool:
    """Whether ``region`` has the colours of the background ``ring`` (both H, W) left and right of it, row by row.

    A pale dial or a clay's side is like some ground somewhere near; what shows through goes on in the same rows. Rows
    without background beside them say nothing.
    """
    middle = shrunk(region, 2)
    if middle.sum() < 20:
        middle = region
    apart = []
    for row in np.flatnonzero(middle.any(axis=1)):
        rows = slice(max(0, row - 2), row + 3)
        own, beside = lab[row][middle[row]], lab[rows][ring[rows]]
        if len(own) > 2 and len(beside) > 5:
            apart.append(float(np.linalg.norm(np.median(own, axis=0) - np.median(beside, axis=0))))
    return len(apart) < 3 or float(np.median(apart)) < BESIDE


def settle_outline(pixels: NDArray[np.uint8], mask: Mask, *, band: int = 3, contrast: float = 25.0) -> Mask:
    """Return ``mask`` with its outline where object and background mix half and half.

    GrabCut assigns mixed pixels to the object, which then shows a rim of background when it moves. Within ``band``
    pixels of the outline each pixel is compared with the local mean colours of object and background; where these
    differ by less than ``contrast`` (grey values), the outline is unchanged.
    """
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    binary = mask.astype(np.uint8)
    core = cv2.erode(binary, kernel, borderValue=0) > 0
    outside = cv2.dilate(binary, kernel) == 0
    colours = pixels.astype(np.float32)
    front, has_front = _local_mean(colours, core, 1.5 * band)
    back, has_back = _local_mean(colours, outside, 1.5 * band)
    difference = front - back
    length = np.linalg.norm(difference, axis=2)
    alpha = ((colours - back) * difference).sum(axis=2) / np.maximum(length**2, 1.0)
    decided = ~core & ~outside & has_front & has_back & (length > contrast)
    return np.asarray(np.where(decided, alpha > 0.5, mask))


def _local_mean(colours: NDArray[np.float32], where: Mask, sigma: float) -> tuple[NDArray[np.float32], Mask]:
    """Gaussian mean (H, W, 3) of ``colours`` over ``where``, and where it is defined (H, W)."""
    weight = where.astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    mean = cv2.GaussianBlur(colours * weight[..., None], (0, 0), sigma) / np.maximum(total, 1e-6)[..., None]
    return np.asarray(mean, dtype=np.float32), np.asarray(total > 0.02)


def drop_ground_shadow(pixels: NDArray[np.uint8], mask: Mask, *, most: float = 0.1) -> Mask:
    """Return ``mask`` without the contact shadow that GrabCut includes as a dark part of the object.

    Where an object meets the ground there is a dark crease. A watershed on darkness, from the object's interior and
    from the ground, meets there: pixels on the ground's side are shadow if they are also coloured like shaded ground
    (not paler, of a similar hue). Only the lower part of the object near its outline is considered, and if more than
    the fraction ``most`` of the mask would be removed, it is unchanged.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    if len(rows) == 0:
        return mask.copy()
    area = int(mask.sum())
    low = np.zeros_like(mask)
    low[rows[-1] - np.ptp(rows) // 3 :] = True
    ground = surrounding_ring(mask, max(4, round(0.15 * np.sqrt(area)))) & low
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    band = mask & low & (depth < 0.12 * np.sqrt(area))
    if ground.sum() < 50 or not band.any() or (band == mask).all():
        return mask.copy()
    hue, saturation, value = cv2.split(cv2.cvtColor(cv2.GaussianBlur(pixels, (0, 0), 1.5), cv2.COLOR_RGB2HSV))
    markers = np.where(mask & ~band, 1, np.where(mask, 0, 2))
    reached = (watershed(255 - value, markers) == 2) & band
    lit_hue, lit_saturation, lit = (float(np.median(channel[ground])) for channel in (hue, saturation, value))
    apart = np.abs((hue.astype(np.float32) - lit_hue + 90.0) % 180.0 - 90.0)
    brightness = value.astype(np.float32) / max(lit, 1.0)
    # Light reflected into a shadow by the ground takes on its colour: darker is also redder on wood.
    # White ground has no hue to compare; its shadow has hardly any colour either, as dark wood before it has.
    similar = (apart < 4.0 + 12.0 * (1.0 - brightness)) & (saturation > lit_saturation - 15)
    similar &= saturation < lit_saturation + max(COLOURED, 2.0 * lit_saturation)
    # Under the object, the crease lies above its shadow in the photo.
    height = max(3, round(0.12 * np.sqrt(area)))
    above = cv2.erode(value, np.ones((height, 1), np.uint8), anchor=(0, height - 1))
    shaded = similar & (brightness > SHADE[0]) & (brightness < SHADE[1]) & (above < 0.7 * value.astype(np.float32))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    shadow = cv2.morphologyEx((reached & shaded).astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    shadow = touching(shadow, cv2.dilate((~mask).astype(np.uint8), kernel) > 0)
    cleaned = largest_component(mask & ~shadow)
    removed = area - int(cleaned.sum())
    return cleaned if 0 < removed <= most * area else mask.copy()
