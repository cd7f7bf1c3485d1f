# SPDX-License-Identifier: MIT
"""Many straight-sided things of a kind: blocks, dominoes, dice, bars of chocolate.

Stacked or in a row they are one contour, like round things that touch. Each is a region of one colour whose outline is
a quadrilateral, and no part of one larger thing is there five times in the same size and apart from the photo's border.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.segmentation import felzenszwalb

from ..reconstruct_options import Proposal
from .mask_geometry import Mask, grown
from .proposal_features import copy_of, lab_of
from .round_things import larger_thing_seen, score_of_room

Pixels = NDArray[np.uint8]

SIDE = 480
"""Longest side in pixels of the copy that is searched."""
SCALES = (60.0, 180.0, 500.0)
"""Scales of Felzenszwalb & Huttenlocher's segmentation ("Efficient graph-based image segmentation", IJCV 2004)."""
LEAST_AREA, MOST_AREA = 0.0015, 0.06
"""Area of a block over the photo's."""
SOLID, FILLED, COARSE = 0.88, 0.85, 0.03
"""Area of a region over its convex hull's; area of the hull over the smallest rectangle's around it, or of its coarse
polygon of four corners over its own, from which it is a quadrilateral: a circle has 0.79 and 0.64. Coarseness over the
hull's perimeter."""
LOOSER = 0.88
"""Factor of both shares for what is alike to enough blocks: a highlight or a leaning side dents an outline."""
AREA, LENGTH, WIDTH = 1.5, 1.3, 1.4
"""Largest ratios of areas, long and short sides of two blocks of a kind."""
OVERLAP = 0.3
"""Share of the smaller of two regions' sides by which they overlap in both directions if they are of the same block."""
STEP, BESIDE, OUTLINED = 8.0, 3, 0.8
"""Step of colour in CIELAB across an outline, over pixels that far beside it, and the share of the outline that has it:
JPEG's squares and the gap between two blocks have less."""
FEWEST = 5
"""Blocks from which a photo is one of many of a kind."""
COVER = 0.02
"""Share of the photo that all of them cover at least."""
COLOUR, REACH, ELSEWHERE = 6.0, 4, 0.5
"""Difference in CIELAB from a block's median colour, and pixels around the blocks; largest area elsewhere of such
colours over that of the blocks. Floors of six patterns had 1.8 to 7, since squares, dots and tiles go on where they are
too small, cut or hidden; stacked blocks, dominoes and stripes of balls 0 to 0.5."""
MARGIN = 0.06
"""Margin of a box around a block, over its longer side."""
ABOVE, OVER, LOADED = 0.4, 0.1, 0.79
"""Gap to a block above over its own height up to which, and share of the narrower one's width above the other from
which that may rest on it; score of what carries another, which would be left in the air."""


class Block(NamedTuple):
    """A quadrilateral on the copy. contour: (n, 1, 2) pixels. box: x0, y0, x1, y1. clear: whether it is one by itself,
    not only beside others."""

    contour: NDArray[np.int32]
    area: float
    length: float
    width: float
    box: tuple[int, int, int, int]
    clear: bool


def _regions(small: Pixels) -> Iterator[Mask]:
    """Yield the regions (h, w) of ``small`` (h, w, 3) that may be blocks: of one colour, and lighter or darker than
    what is around them."""
    least, most = LEAST_AREA * small.shape[0] * small.shape[1], MOST_AREA * small.shape[0] * small.shape[1]
    smooth = np.asarray(cv2.bilateralFilter(small, 5, 30.0, 3.0), dtype=np.uint8)
    for scale in SCALES:
        regions = np.asarray(felzenszwalb(smooth, scale=scale, sigma=0.6, min_size=40))
        areas = np.bincount(regions.ravel())
        for index in np.flatnonzero((areas > least) & (areas < most)):
            yield regions == index
    # Across a strong edge Felzenszwalb's regions are a pixel wide.
    stable = cv2.MSER.create(min_area=round(least), max_area=round(most))
    for points in stable.detectRegions(cv2.cvtColor(smooth, cv2.COLOR_RGB2GRAY))[0]:
        mask = np.zeros(small.shape[:2], dtype=bool)
        columns, rows = np.asarray(points, dtype=np.int64).T
        mask[rows, columns] = True
        yield mask


def _block(mask: Mask, lab: NDArray[np.float32]) -> Block | None:
    """The region ``mask`` (h, w) as a block; None unless it is a quadrilateral that ends at its outline."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = np.asarray(max(contours, key=cv2.contourArea), dtype=np.int32)
    area, hull = cv2.contourArea(contour), cv2.convexHull(contour)
    if area < 20.0 or area < LOOSER * SOLID * cv2.contourArea(hull):
        return None
    sides, whole = cv2.minAreaRect(hull)[1], cv2.contourArea(hull)
    corners = cv2.approxPolyDP(hull, COARSE * cv2.arcLength(hull, True), True)
    filled = max(whole / max(1.0, sides[0] * sides[1]), cv2.contourArea(corners) / whole if len(corners) == 4 else 0.0)
    x, y, across, down = cv2.boundingRect(contour)
    cut = x <= 1 or y <= 1 or x + across >= mask.shape[1] - 1 or y + down >= mask.shape[0] - 1
    if cut or filled < LOOSER * FILLED or _outlined(contour, lab) < OUTLINED:
        return None
    clear = area >= SOLID * whole and filled >= FILLED
    return Block(contour, area, max(sides), min(sides), (x, y, x + across, y + down), clear)


def _outlined(contour: NDArray[np.int32], lab: NDArray[np.float32]) -> float:
    """Share of ``contour`` (n, 1, 2) at which the colour of ``lab`` (h, w, 3) steps by more than ``STEP``."""
    points = contour[:, 0, :].astype(np.float32)
    ahead, behind = np.roll(points, -BESIDE, axis=0), np.roll(points, BESIDE, axis=0)
    along = ahead - behind
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.maximum(np.linalg.norm(along, axis=1), 1e-6)[:, None]
    height, width = lab.shape[:2]
    sides = []
    for side in (-BESIDE, BESIDE):
        at = np.rint(points + side * normal).astype(np.int64)
        sides.append(lab[np.clip(at[:, 1], 0, height - 1), np.clip(at[:, 0], 0, width - 1)])
    return float((np.linalg.norm(sides[0] - sides[1], axis=1) > STEP).mean())


def _same(first: Block, other: Block) -> bool:
    """Whether two regions are of the same block."""
    a, b = first.box, other.box
    shares = [(min(a[i + 2], b[i + 2]) - max(a[i], b[i])) / min(a[i + 2] - a[i], b[i + 2] - b[i]) for i in (0, 1)]
    return min(shares) > OVERLAP


def _alike(first: Block, other: Block) -> bool:
    pairs = ((first.area, other.area, AREA), (first.length, other.length, LENGTH), (first.width, other.width, WIDTH))
    return all(max(a, b) < most * min(a, b) for a, b, most in pairs)


def blocks_of_a_kind(pixels: Pixels) -> tuple[list[Block], float]:
    """Return the blocks of ``pixels`` (H, W, 3) on the copy that is searched, largest first, and the photo's size over
    the copy's; no blocks unless there are at least ``FEWEST`` of a kind that make up the photo.
    """
    small = copy_of(pixels, SIDE)
    lab = lab_of(small)
    found = [item for item in (_block(mask, lab) for mask in _regions(small)) if item is not None]
    found.sort(key=lambda item: (not item.clear, -item.area, item.box))
    best: list[Block] = []
    for seed in found:
        kept: list[Block] = []
        for item in found:
            if _alike(seed, item) and not any(_same(item, other) for other in kept):
                kept.append(item)
        if sum(item.clear for item in kept) >= FEWEST:
            best = max(best, kept, key=len)
    best.sort(key=lambda item: (-item.area, item.box))
    covered = sum(item.area for item in best) / (small.shape[0] * small.shape[1])
    if covered < COVER or _is_pattern(best, lab):
        return [], 1.0
    return best, pixels.shape[1] / small.shape[1]


def _is_pattern(blocks: Sequence[Block], lab: NDArray[np.float32]) -> bool:
    """Whether much of ``lab`` (h, w, 3) beside the ``blocks`` has their colours: a pattern of the ground or a wall."""
    covered = np.zeros(lab.shape[:2], dtype=np.uint8)
    nearest = np.full(lab.shape[:2], np.inf, dtype=np.float32)
    for item in blocks:
        own = np.zeros_like(covered)
        cv2.drawContours(own, [item.contour], -1, 1, cv2.FILLED)
        covered |= own
        np.minimum(nearest, np.linalg.norm(lab - np.median(lab[own > 0], axis=0), axis=2), out=nearest)
    elsewhere = (nearest < COLOUR) & ~grown(covered > 0, REACH)
    return int(elsewhere.sum()) > ELSEWHERE * int(covered.sum())


def alike_blocks(pixels: Pixels, seen: Sequence[tuple[Mask, float]], least: float) -> list[Proposal]:
    """Return the blocks of a photo ``pixels`` (H, W, 3) of many of a kind, those with most room first; empty unless it
    is one. seen, least: as ``round_things`` has them.
    """
    found, across = blocks_of_a_kind(pixels)
    if not found:
        return []
    small = copy_of(pixels, SIDE)
    covered = np.zeros(small.shape[:2], dtype=np.uint8)
    cv2.drawContours(covered, [item.contour for item in found], -1, 1, cv2.FILLED)
    if larger_thing_seen(seen, least, covered > 0, float(np.median([item.area for item in found])), lab_of(small)):
        return []
    down = pixels.shape[0] / small.shape[0]
    scored = [(_score(item, found), item) for item in found]
    scored.sort(key=lambda pair: (-pair[0], -pair[1].area, -pair[1].box[3], pair[1].box[0]))
    result = []
    for score, item in scored:
        margin = MARGIN * item.length + 1.0
        x0, y0 = max(0, round((item.box[0] - margin) * across)), max(0, round((item.box[1] - margin) * down))
        x1 = min(pixels.shape[1], round((item.box[2] + margin) * across))
        y1 = min(pixels.shape[0], round((item.box[3] + margin) * down))
        result.append(Proposal((float(x0), float(y0), float(x1), float(y1)), score))
    return result


def _score(item: Block, found: Sequence[Block]) -> float:
    """Score of ``item`` among the blocks ``found`` by the room that it has; low where another may rest on it."""
    gap = float("inf")
    left, top, right, bottom = item.box
    for other in found:
        if other is item:
            continue
        x0, y0, x1, y1 = other.box
        gap = min(gap, float(np.hypot(max(left - x1, x0 - right, 0), max(top - y1, y0 - bottom, 0))))
        over = (min(right, x1) - max(left, x0)) / min(right - left, x1 - x0)
        if over > OVER and abs(top - y1) < ABOVE * (bottom - top):
            return LOADED
    return score_of_room(gap, item.width)
