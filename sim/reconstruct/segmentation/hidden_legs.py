# SPDX-License-Identifier: MIT
"""Legs of a chair, a table or an animal, whose lower ends are hidden, go on one by one, with the gaps between them.

Points are x, y in pixels. ``seen`` is the visible part of the object, ``unknown`` where it may continue.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

WIDEST = 0.15
"""Greatest width of a leg over the square root of the visible area."""
FEWEST = 2
"""Fewest legs: a single one may be a handle."""
TRACE, LONG, STUMP = 4, 1.5, 0.5
"""Fewest rows in which a leg is seen; least length over its width of one whose foot is seen, and of a hidden one."""
TAPER = 1.4
"""Greatest ratio of the widths along a leg: a corner of a box widens faster."""
STEEP = 0.4
"""Most columns by which a leg shifts per row."""
SHARE = 0.25
"""Least share of legs in the columns in which the object goes on unseen below."""
GAP = 2
"""Rows between two masks that touch."""


@dataclass(frozen=True)
class _Leg:
    """A thin upright part. top, end: its rows; half: width; its middle in row y is ``column + slant (y - end)``;
    hidden: whether it goes on unseen."""

    top: int
    end: int
    half: float
    column: float
    slant: float
    hidden: bool


def with_hidden_legs(seen: Mask, unknown: Mask, lowest_base: float) -> Mask | None:
    """Return ``seen`` (h, w) with its hidden legs: as long as the longest whose foot is seen, else down to the row
    ``lowest_base``.

    None if it has none, or if other parts of it go on unseen for the most part.
    """
    found = _legs(seen, unknown)
    hidden = [leg for leg in found if leg.hidden]
    below = (seen & np.roll(unknown, -GAP, axis=0)).any(axis=0).sum()
    if len(found) < FEWEST or not hidden or sum(2.0 * leg.half for leg in hidden) < SHARE * below:
        return None
    lengths = [leg.end - leg.top for leg in found if not leg.hidden]
    drawn = np.zeros(seen.shape, dtype=np.uint8)
    for leg in hidden:
        base = max(float(leg.end), leg.top + max(lengths) if lengths else lowest_base)
        corners = [
            (leg.column + leg.slant * (y - leg.end) + side * leg.half, y)
            for y, sides in ((leg.end - 1.0, (-1.0, 1.0)), (base, (1.0, -1.0)))
            for side in sides
        ]
        cv2.fillPoly(drawn, [np.round(np.array(corners) * 16.0).astype(np.int32)], 1, cv2.LINE_8, 4)
    return seen | ((drawn > 0) & unknown)


def _legs(seen: Mask, unknown: Mask) -> list[_Leg]:
    widest = WIDEST * float(np.sqrt(seen.sum()))
    ends = seen & ~np.roll(seen, -1, axis=0)
    ends[-1] = False
    count, labels = cv2.connectedComponents(ends.astype(np.uint8), connectivity=8)
    found = []
    for index in range(1, count):
        rows, columns = np.nonzero(labels == index)
        trace = _trace(seen, int(rows.min()) - 1, (int(columns.min()), int(columns.max())), widest)
        if len(trace) < TRACE:
            continue
        hidden = bool(unknown[np.minimum(rows + GAP, len(seen) - 1), columns].mean() > 0.5)
        # What ends at a thing that stands on the object is no leg.
        if hidden and seen[int(rows.max()) + 1 :, columns].any(axis=0).mean() > 0.5:
            continue
        widths = np.array([right - left + 1.0 for _, left, right in trace])
        if np.percentile(widths, 90) > TAPER * np.percentile(widths, 10):
            continue
        leg = _fitted(np.array(trace, dtype=np.float64), int(rows.max()), hidden)
        if len(trace) >= 2.0 * (STUMP if hidden else LONG) * leg.half:
            found.append(leg)
    return found


def _trace(seen: Mask, start: int, span: tuple[int, int], widest: float) -> list[tuple[int, int, int]]:
    """Row, first and last column of a thin part, upwards from the columns ``span`` of the row ``start`` to where it
    joins the object."""
    trace = []
    left, right = span
    for row in range(start, -1, -1):
        inside = np.flatnonzero(seen[row, left : right + 1])
        if not len(inside):
            break
        middle = left + int(inside[len(inside) // 2])
        before, after = np.flatnonzero(~seen[row, :middle]), np.flatnonzero(~seen[row, middle:])
        left = int(before[-1]) + 1 if len(before) else 0
        right = middle + int(after[0]) - 1 if len(after) else seen.shape[1] - 1
        if right - left + 1 > widest:
            break
        trace.append((row, left, right))
    return trace


def _fitted(trace: NDArray[np.float64], end: int, hidden: bool) -> _Leg:
    rows, left, right = trace.T
    half = float(np.median(right - left + 1.0)) / 2.0
    middle = (left + right + 1.0) / 2.0
    slant, column = 0.0, float(middle.mean())
    # The direction of a short stump says little: it is taken for upright.
    if len(rows) > 2.0 * LONG * half:
        slant, column = (float(value) for value in np.polyfit(rows - end, middle, 1))
    return _Leg(int(rows.min()), end, half, column, float(np.clip(slant, -STEEP, STEEP)), hidden)
