# SPDX-License-Identifier: MIT
"""Border ownership: whether an outline in a photo belongs to what it encloses, or to what is in front of that.

A thing hides what is behind it: lines end at its outline, and its sides end at its corners. Where lines go on across
an outline, it is that of light or a print. Where the straight sides of a region go on beyond its corners, they are the
edges of what lies before it, as a bench's slats before the grass in their gap (T-junctions: Guzmán, "Decomposition of a
visual scene into three-dimensional bodies", AFIPS 1968).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .mask_geometry import Mask, grown

Values = NDArray[np.float64]

ACROSS, LEAST_ACROSS_PX = 0.06, 6.0
"""Length on either side of an outline, over the thing's size and in pixels, from which a straight line crosses it."""
LINES_ACROSS, ALL_ACROSS = 2, 0.25
"""Lines that cross an outline, and the sum of their shorter sides over the thing's size, from which it is no outline of
a thing. Of 76 things in photos none had two; boards lit by the sun had 0.36, tableware behind a lattice 1.4."""

SIDE = 0.8
"""Least length of a straight side over the region's size, its area's square root."""
STRAIGHT = (0.03, 2.0)
"""Deviation of a side from a straight line, over the region's size and at least in pixels."""
CORNER_PX, ONWARDS, LEAST_ONWARDS_PX = 3.0, 0.12, 10.0
"""Where what is beyond a corner begins, in pixels; how far it is looked at, over the side's length, and at least."""
CONTRAST = 3.0
"""Least step of lightness across the side there, CIELAB units a pixel."""
ALONG = 0.85
"""Cosine of the angle between that step and the side's normal."""
GOES_ON = 0.6
"""Share of what is looked at beyond a corner on which the side must be seen."""
LEAST_SIDES = 2
"""Sides that go on from which what is in front owns the outline: one edge of a thing may lie in line with a table."""
HIDDEN_SHARE = 0.25
"""Share of its outline, in sides that go on at both ends, from which what is in front owns it. Gaps of two benches had
0.33 to 0.58, berries behind the rim of their bowl 0.27."""


def lines_go_on(mask: Mask, lines: NDArray[np.float64]) -> bool:
    """Return whether ``lines`` (n, 4) go on across the outline of ``mask`` (H, W): a thing hides the lines behind it,
    but light and prints lie on what has them."""
    kernel = np.ones((5, 5), np.uint8)
    inside = cv2.erode(mask.astype(np.uint8), kernel) > 0
    outside = ~grown(mask, 2)
    size, height, width = float(np.sqrt(mask.sum())), *mask.shape
    least = max(LEAST_ACROSS_PX, ACROSS * size)
    counts = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1]).astype(int)
    across = []
    for (x0, y0, x1, y1), count in zip(lines, counts, strict=True):
        if count < 2.0 * least:
            continue
        columns = np.clip(np.round(np.linspace(x0, x1, count)).astype(int), 0, width - 1)
        rows = np.clip(np.round(np.linspace(y0, y1, count)).astype(int), 0, height - 1)
        shorter = min(int(inside[rows, columns].sum()), int(outside[rows, columns].sum()))
        if shorter >= least:
            across.append(shorter)
    return len(across) >= LINES_ACROSS and sum(across) > ALL_ACROSS * size


def sides_go_on(mask: Mask, lightness: NDArray[np.float32]) -> bool:
    """Return whether straight sides of ``mask`` (H, W) go on beyond both of their ends, so that it lies behind them.

    lightness: (H, W) CIELAB, slightly smoothed, as of ``proposal_features.lab_of``.
    """
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return False
    outline = np.asarray(max(outlines, key=len)[:, 0], dtype=np.float64)
    slopes = (cv2.Sobel(lightness, cv2.CV_32F, *order, scale=1.0 / 8.0) for order in ((1, 0), (0, 1)))
    step = np.asarray(np.stack(list(slopes), axis=-1), dtype=np.float64)
    long = [side for side in _straight_sides(outline, float(np.sqrt(mask.sum()))) if _goes_on(*side, step)]
    return len(long) >= LEAST_SIDES and sum(float(np.hypot(*(b - a))) for a, b in long) > HIDDEN_SHARE * len(outline)


def _straight_sides(outline: Values, size: float) -> list[tuple[Values, Values]]:
    """The first and last point x, y of each long straight side of ``outline`` (n, 2) around a region of ``size``."""
    off = max(STRAIGHT[1], STRAIGHT[0] * size)
    corners = cv2.approxPolyDP(outline[:, None].astype(np.int32), off, True)[:, 0].astype(np.float64)
    sides = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        if length < max(SIDE * size, LEAST_ONWARDS_PX):
            continue
        along = (end - start) / length
        normal = np.array([-along[1], along[0]])
        place, away = (outline - start) @ along, (outline - start) @ normal
        # Not at its ends: masks are round at corners.
        own = outline[(place > 0.1 * length) & (place < 0.9 * length) & (np.abs(away) < 1.5 * off)]
        if len(own) < 8:
            continue
        middle = own.mean(axis=0)
        line = np.linalg.svd(own - middle, full_matrices=False)[2][0]
        sides.append((middle + line * float((start - middle) @ line), middle + line * float((end - middle) @ line)))
    return sides


def _goes_on(start: Values, end: Values, step: Values) -> bool:
    """Whether the side from ``start`` to ``end``, x, y, is seen beyond both. step: (H, W, 2) slope of the lightness."""
    height, width = step.shape[:2]
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    normal = np.array([-along[1], along[0]])
    offsets = CORNER_PX + np.arange(max(LEAST_ONWARDS_PX, ONWARDS * length))
    for corner, outwards in ((start, -along), (end, along)):
        # A drawn line may be off by two pixels.
        at = (corner + offsets[:, None] * outwards)[:, None] + np.arange(-2.0, 3.0)[:, None] * normal
        column, row = np.round(at[..., 0]).astype(int), np.round(at[..., 1]).astype(int)
        inside = (column > 1) & (column < width - 2) & (row > 1) & (row < height - 2)
        slope = step[row.clip(0, height - 1), column.clip(0, width - 1)]
        across, steepest = np.abs(slope @ normal), np.linalg.norm(slope, axis=-1)
        seen = (inside & (across > CONTRAST) & (across > ALONG * steepest)).any(axis=1)
        whole = inside.all(axis=1)
        if whole.sum() < 8 or float(seen[whole].mean()) < GOES_ON:
            return False
    return True
