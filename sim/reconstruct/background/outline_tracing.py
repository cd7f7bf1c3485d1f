# SPDX-License-Identifier: MIT
"""The way of an edge beside a hole, and a curve that joins both of its visible ends behind it.

The top of a stone, the rim of a round table and a hill are not straight. Near the line that fits them best, the edge is
traced on either side of the hole (dynamic programming over columns). The curve of least squared curvature near what was
traced, a smoothing spline, joins both ends behind it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]
Values = NDArray[np.float64]

REACH = 0.25
"""Largest distance of the edge from the line, over the width of what hides it."""
ARC = 0.8
"""Range beside the hole in which the edge is traced, over the same width."""
END = 0.3
"""Stretch next to the hole in which it must show, over the same width."""
FEWEST = 8
"""Least columns of such a stretch."""
BAND = 0.02
"""Height of the bands over and under the edge whose colours are compared, over the same width; at least 2 pixels."""
CLEAR, MOSTLY = 0.5, 0.8
"""Contrast over the line's own above which a column shows the edge; share of a stretch that must show it."""
TURN, AWAY = 0.06, 0.1
"""Cost of a step of one row from a column to the next, and of the largest distance from the line, in contrasts."""
OTHER = 0.8
"""Weight of a change of any colour over one of the line's own colour."""
BETTER = 0.25
"""Contrast that the traced way must gain over the line, so that a line that is right stays straight."""
STIFF = 0.15
"""Length over the same width below which the curve does not follow what was traced."""


def bend(
    logs: Picture, known: Mask, thing: Mask, ends: tuple[float, float], step: Values
) -> NDArray[np.float32] | None:
    """Return the rows (w,) by which an edge lies below a line, or None if it is as straight as that.

    logs: (h, w, 3) logarithms, valid where ``known``. thing: (h, w) what hides the edge. ends: rows at which the line
    enters at the left and leaves at the right. step: (3,) change of colour down across the edge.
    """
    height, width = known.shape
    columns = np.flatnonzero(thing.any(axis=0))
    extent = int(columns[-1] + 1 - columns[0])
    reach = max(3, round(REACH * extent))
    size = max(float(np.linalg.norm(step)), 1e-6)
    x = np.arange(width)
    line = ends[0] + (ends[1] - ends[0]) * (x + 0.5) / width
    change, seen = _changes(logs, known, line, reach, max(2, round(BAND * extent)))
    # What stands behind has many colours: any change counts, that of the line a little more.
    along, any_way = change @ (np.asarray(step) / size), np.linalg.norm(change, axis=-1)
    contrast = np.clip(np.maximum(along, OTHER * any_way) / size, 0.0, 1.0)
    # Where the thing stands in the way at the height of the line.
    at = np.clip(np.rint(line).astype(int), 0, height - 1)
    blocked = np.flatnonzero(~known[at, x] & (x >= columns[0] - 1) & (x <= columns[-1] + 1))
    if len(blocked) < 2:
        return None
    first, last = int(blocked[0]), int(blocked[-1]) + 1
    arc, stretch = max(FEWEST, round(ARC * extent)), max(FEWEST, round(END * extent))
    begin, end = slice(max(0, first - arc), first), slice(last, last + arc)
    off = np.rint(line) - line
    left = _traced(contrast[begin], seen[begin], off[begin], stretch)
    right = _traced(contrast[end][::-1], seen[end][::-1], off[end][::-1], stretch)
    if left is None or right is None or not (left.bent or right.bent):
        return None
    first, last = begin.stop - left.skipped, end.start + right.skipped
    rows, weight = np.zeros(width), np.zeros(width)
    for arc_at, found in (
        (slice(first - len(left.rows), first), left.rows),
        (slice(last, last + len(right.rows)), right.rows[::-1]),
    ):
        rows[arc_at], weight[arc_at] = found, 1.0
    shown = np.flatnonzero(weight)
    within = slice(int(shown[0]), int(shown[-1]) + 1)
    result = _least_bent(rows[within], weight[within], STIFF * extent)
    # Farther away nothing is known of it.
    return np.pad(result, (within.start, width - within.stop), mode="edge").astype(np.float32)


def _least_bent(rows: Values, weight: Values, stiff: float) -> Values:
    """The curve (n,) of least Σ weight (curve − rows)² + stiff⁴ Σ curvature²."""
    curvature = sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(len(rows) - 2, len(rows)))
    system = sparse.diags(weight) + stiff**4 * (curvature.T @ curvature)
    return np.asarray(linalg.spsolve(system.tocsc(), weight * rows))


def _changes(logs: Picture, known: Mask, line: Values, reach: int, band: int) -> tuple[Values, Mask]:
    """Means of ``logs`` (h, w, 3) under less over the rows ``line`` (w,) moved by −reach to reach: (w, 2 reach + 1, 3),
    and where all of both bands is known."""
    height, width = known.shape
    sums = np.cumsum(np.where(known[..., None], logs, 0.0), axis=0, dtype=np.float64)
    total = np.concatenate([np.zeros((1, width, 3)), sums])
    count = np.concatenate([np.zeros((1, width)), np.cumsum(known, axis=0)])
    rows = np.rint(line).astype(int)[:, None] + np.arange(-reach, reach + 1)
    inside = (rows >= band) & (rows <= height - band)
    rows = np.clip(rows, band, max(height - band, band))
    x = np.arange(width)[:, None]
    under, over = total[rows + band, x] - total[rows, x], total[rows, x] - total[rows - band, x]
    seen = inside & (count[rows + band, x] - count[rows - band, x] == 2 * band)
    return (under - over) / band, np.asarray(seen)


@dataclass(frozen=True, eq=False)
class _Arc:
    """The traced edge on one side. rows: (n,) below the line, from afar to the hole. skipped: columns between its end
    and the hole. bent: whether it leaves the line."""

    rows: Values
    skipped: int
    bent: bool


def _traced(contrast: Values, seen: Mask, off: Values, stretch: int) -> _Arc | None:
    """The edge along columns (n, m) towards the hole; None where it does not show there. off: (n,) rows from the line
    to the middle of the m that are compared."""
    if len(contrast) < FEWEST:
        return None
    moves = np.abs(np.linspace(-1.0, 1.0, contrast.shape[1]))
    value = np.where(seen, contrast, 0.0) - AWAY * moves
    best, came = value[0], np.zeros(contrast.shape, dtype=int)
    for index in range(1, len(value)):
        padded = np.pad(best, 1, constant_values=-np.inf)
        choices = np.stack([padded[:-2] - TURN, padded[1:-1], padded[2:] - TURN])
        came[index] = np.argmax(choices, axis=0) - 1
        best = choices.max(axis=0) + value[index]
    way = np.empty(len(value), dtype=int)
    way[-1] = int(np.argmax(best))
    for index in range(len(value) - 1, 0, -1):
        way[index - 1] = way[index] + came[index, way[index]]
    at = np.arange(len(value))
    shown, middle = seen[at, way], contrast.shape[1] // 2
    good = shown & (contrast[at, way] > CLEAR)
    if not good.any():
        return None
    stop = int(np.flatnonzero(good)[-1]) + 1
    near = slice(max(0, stop - stretch), stop)
    if good[near].sum() < max(FEWEST, MOSTLY * (stop - near.start)):
        return None
    # Farther away the edge may end.
    lost = np.flatnonzero(~good[: near.start])
    start = int(lost[-1]) + 1 if len(lost) else 0
    straight = np.where(seen[near, middle], contrast[near, middle], 0.0)
    gain = float((contrast[at, way][near] - straight).mean())
    return _Arc((way - middle + off)[start:stop], len(value) - stop, gain > BETTER)
