# SPDX-License-Identifier: MIT
"""The whole outline of an object of which something in front hides a part (amodal completion).

Several guesses are made of the hidden part (continuation.py). A guess is judged by how well its rule explains the
outline that is seen, and by whether it would need a coincidence: an object's true outline seldom runs just along
that of the thing in front of it (the generic view: Freeman, Nature 1994).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .continuation import Guess, continued, ellipse, mirrored, point_mirrored

Mask = NDArray[np.bool_]

SIDE = 112
"""Pixels of the visible part's longer side in the copy that the guesses are made on."""
ROOM = 1.0
"""Surroundings in that copy, as a fraction of the longer side: nothing hidden is taken to reach farther."""
COINCIDENCE = 0.1
"""Cost of an outline that follows the border of what stands in front all along it, in shares of the visible area."""
PREFERENCE = {"ellipse": -0.03, "mirrored": 0.02, "point_mirrored": 0.03, "seen_again": 0.03, "continued": 0.06}
"""Cost of each rule at equal fit, in shares of the visible area; chosen on drawn solids standing in front of others."""


def complete_outline(mask: Mask, hidden_by: Mask, *, seen_again: Mask | None = None) -> Mask:
    """The full outline (H, W) of the object whose visible part is ``mask``.

    hidden_by: (H, W) pixels of the things in front of it. seen_again: (H, W) the object as segmented in the picture
    from which these things were removed (paper A.1); one more guess. The result holds ``mask`` and, beyond it, only
    pixels of ``hidden_by``. Nothing is added where nothing in front touches the object.
    """
    in_front = hidden_by & ~mask
    if not mask.any() or not in_front.any():
        return mask.copy()
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    side = max(int(np.ptp(rows)), int(np.ptp(columns))) + 1
    room = int(np.ceil(ROOM * side))
    window = (int(rows[0]) - room, int(rows[-1]) + 1 + room, int(columns[0]) - room, int(columns[-1]) + 1 + room)
    scale = SIDE / side
    seen = _copy(mask, window, scale, outside=False)
    # What lies beyond the picture is hidden as well.
    unknown = _copy(in_front, window, scale, outside=True) & ~seen
    # Two masks cut one after the other leave a seam of a few pixels between them.
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    closed = cv2.morphologyEx((seen | unknown).astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    beside = cv2.dilate(seen.astype(np.uint8), kernel) > 0
    unknown = (unknown | (closed & beside)) & ~seen
    if not (unknown & beside).any():
        return mask.copy()
    guesses = _guesses(seen, unknown, _lowest_base(in_front, window, scale))
    if seen_again is not None:
        again = _copy(seen_again, window, scale, outside=False)
        guesses.append(Guess("seen_again", again, _misfit(again, seen, unknown)))
    costs = [
        guess.misfit + PREFERENCE[guess.rule] + COINCIDENCE * _coincidence(guess.outline | seen, seen, unknown)
        for guess in guesses
    ]
    best = (guesses[int(np.argmin(costs))].outline | seen) & (seen | unknown)
    return mask | (_at_full_size(best, mask.shape, window, scale) & in_front)


def _guesses(seen: Mask, unknown: Mask, lowest_base: float) -> list[Guess]:
    guesses = [continued(seen, unknown, lowest_base)]
    for rule in (ellipse, mirrored, point_mirrored):
        guess = rule(seen, unknown)
        if guess is not None:
            guesses.append(guess)
    return guesses


def _misfit(outline: Mask, seen: Mask, unknown: Mask) -> float:
    return float(((outline ^ seen) & ~unknown).sum() / max(1, int(seen.sum())))


def _coincidence(outline: Mask, seen: Mask, unknown: Mask) -> float:
    """Share of the border between ``seen`` and ``unknown`` that ``outline`` takes for the object's own edge."""
    border = seen & (cv2.dilate(unknown.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    if not border.any():
        return 0.0
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    inside = cv2.erode(outline.astype(np.uint8), kernel, borderValue=0) > 0
    return float((border & ~inside).sum() / border.sum())


def _lowest_base(in_front: Mask, window: tuple[int, int, int, int], scale: float) -> float:
    """Lowest row, in the copy, on which something may stand that is hidden by ``in_front``.

    What stands in front covers about as much ground in depth as it is wide. Seen from 20 to 30 degrees above, the
    thing behind it then stands about half its width higher in the picture.
    """
    top, bottom, left, right = window
    height, width = in_front.shape
    inside = in_front[max(0, top) : min(height, bottom), max(0, left) : min(width, right)]
    columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(in_front.any(axis=1))
    if len(columns) == 0:
        return float("inf")
    return (float(rows[-1]) - 0.45 * float(np.ptp(columns)) - top) * scale


def _copy(mask: Mask, window: tuple[int, int, int, int], scale: float, *, outside: bool) -> Mask:
    """The ``window`` (top, bottom, left, right) of ``mask`` at ``scale``; beyond the picture it is ``outside``."""
    top, bottom, left, right = window
    height, width = mask.shape
    part = mask[max(0, top) : min(height, bottom), max(0, left) : min(width, right)]
    margins = ((max(0, -top), max(0, bottom - height)), (max(0, -left), max(0, right - width)))
    padded = np.pad(part, margins, constant_values=outside).astype(np.float32)
    size = (max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale)))
    method = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(padded, size, interpolation=method) > 0.5)


def _at_full_size(small: Mask, shape: tuple[int, ...], window: tuple[int, int, int, int], scale: float) -> Mask:
    top, bottom, left, right = window
    soft = cv2.GaussianBlur(small.astype(np.float32), (0, 0), 0.8)
    large = cv2.resize(soft, (right - left, bottom - top), interpolation=cv2.INTER_LINEAR) > 0.5
    result = np.zeros(shape, dtype=bool)
    rows = slice(max(0, top), min(shape[0], bottom))
    columns = slice(max(0, left), min(shape[1], right))
    result[rows, columns] = large[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
    return result
