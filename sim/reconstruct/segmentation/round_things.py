# SPDX-License-Identifier: MIT
"""Many round things of a kind: coins, buttons, candies, fruit in a tray.

They touch, so that one contour holds several, and what is printed on them stands out more than they do. Their outlines
are circles all the same, which nothing else in a photo is five times.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..reconstruct_options import Proposal
from .mask_geometry import Mask, grown, ring_around
from .proposal_features import copy_of, lab_of

Pixels = NDArray[np.uint8]

SIDE = 480
"""Longest side in pixels of the copy that is searched."""
LEAST_RADIUS, MOST_RADIUS = 0.03, 0.3
"""Radii that are looked for, over the copy's shorter side."""
EDGE, PERFECT = 200.0, 0.85
"""Gradient of an edge for ``cv2.HOUGH_GRADIENT_ALT``, and the share of a circle that its edges have to confirm."""
FEWEST = 5
"""Circles of alike size from which a photo is one of many round things."""
ALIKE = 2.0
"""Largest ratio of a radius to the median one."""
INSIDE = 0.8
"""Distance of two centres over the larger radius, below which the smaller circle is a ring on the larger thing."""
LAPPED = 0.1
"""Share of the smaller radius by which two circles may overlap before one thing lies on the other."""
LARGER, HELD, STEP = 4.0, 0.4, 8.0
"""Area of something over that of one of the things from which it is much larger; share of it that they fill in a group;
colour of the rest of it from that around it in CIELAB, up to which the rest is ground."""
COVER = 0.08
"""Share of the photo that all of them cover at least: knobs of a stove are not what a photo is of."""
MARGIN = 0.08
"""Margin of a box around a circle, over its diameter; the rim's inner edge may be the clearer one."""
ROOM = 0.5
"""Gap to the next thing over the radius or width, above which more of it says no more."""
SCORES = (0.9, 0.99)
"""Scores of what touches another, and of what stands with that much room."""
CUT_SCORE = 0.79
"""Score of what lies on another, under it, or is cut by the photo's border."""


class Circle(NamedTuple):
    """Centre and radius in pixels."""

    x: float
    y: float
    radius: float


def circles_of_a_kind(pixels: Pixels) -> list[Circle]:
    """Return the outlines of the round things of ``pixels`` (H, W, 3), largest first; empty unless there are at least
    ``FEWEST`` of alike size that make up the photo.
    """
    height, width = pixels.shape[:2]
    scale = min(1.0, SIDE / max(height, width))
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    grey = cv2.cvtColor(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    side = min(size)
    found = cv2.HoughCircles(
        cv2.GaussianBlur(grey, (0, 0), 1.0), cv2.HOUGH_GRADIENT_ALT, 1.5, 0.05 * side,
        param1=EDGE, param2=PERFECT,
        minRadius=max(4, round(LEAST_RADIUS * side)), maxRadius=round(MOST_RADIUS * side),
    )  # fmt: skip
    if found is None:
        return []
    outer: list[Circle] = []
    for x, y, radius in sorted(found[0][:, :3].tolist(), key=lambda item: -item[2]):
        if all(np.hypot(x - other.x, y - other.y) > INSIDE * other.radius for other in outer):
            outer.append(Circle(x, y, radius))
    if not outer:
        return []
    typical = float(np.median([item.radius for item in outer]))
    alike = [item for item in outer if typical / ALIKE < item.radius < typical * ALIKE]
    covered = sum(np.pi * item.radius**2 for item in alike) / (size[0] * size[1])
    if len(alike) < FEWEST or covered < COVER:
        return []
    whole = [Circle(item.x / scale, item.y / scale, item.radius / scale) for item in alike]
    # The copy's size is rounded, so that a middle at its border may lie outside of the photo.
    return [item for item in whole if 0.0 <= item.x < width and 0.0 <= item.y < height]


def round_things(pixels: Pixels, seen: Sequence[tuple[Mask, float]], least: float) -> list[Proposal]:
    """Return the round things of a photo ``pixels`` (H, W, 3) of many, those with most room first; empty unless it is
    one.

    seen: masks (h, w) on a copy of any size and scores of what else stands out in it, of which nothing with a score of
    ``least`` or more may be much larger than they are, unless it is a group of them.
    """
    found = circles_of_a_kind(pixels)
    if not found:
        return []
    small = copy_of(pixels, SIDE)
    scale = small.shape[1] / pixels.shape[1]
    covered = np.zeros(small.shape[:2], dtype=np.uint8)
    for item in found:
        cv2.circle(covered, (round(item.x * scale), round(item.y * scale)), round(item.radius * scale), 1, cv2.FILLED)
    typical = np.pi * (scale * float(np.median([item.radius for item in found]))) ** 2
    if larger_thing_seen(seen, least, covered > 0, typical, lab_of(small)):
        return []
    height, width = pixels.shape[:2]
    scored = [(_score(item, found, width, height), item) for item in found]
    scored.sort(key=lambda pair: (-pair[0], -pair[1].radius, pair[1].y, pair[1].x))
    return [Proposal(_box(item, width, height), score) for score, item in scored]


def larger_thing_seen(
    seen: Sequence[tuple[Mask, float]], least: float, covered: Mask, typical: float, lab: NDArray[np.float32]
) -> bool:
    """Return whether something of ``seen`` with a score of ``least`` or more is much larger than things of a kind and
    no group of them: a coat with buttons, a shelf of balls. What is between those of a group is them or their ground.

    covered: (h, w) pixels of those things on a copy of the photo. typical: area of one of them in pixels. lab: the
    copy (h, w, 3) in CIELAB.
    """
    for mask, score in seen:
        whole = cv2.resize(mask.astype(np.uint8), covered.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        if score < least or whole.sum() < LARGER * typical or (whole & covered).sum() > HELD * whole.sum():
            continue
        rest, around = whole & ~grown(covered, 2), ring_around(whole, 6) & ~covered
        if not rest.any() or not around.any():
            continue
        if np.linalg.norm(np.median(lab[rest], axis=0) - np.median(lab[around], axis=0)) > STEP:
            return True
    return False


def _score(item: Circle, found: Sequence[Circle], width: int, height: int) -> float:
    """Score of ``item`` among the things ``found`` in a photo of ``width`` x ``height`` pixels, by the room it has."""
    to_border = min(item.x, item.y, width - item.x, height - item.y) - item.radius
    gaps = [
        (np.hypot(item.x - other.x, item.y - other.y) - item.radius - other.radius, other.radius)
        for other in found
        if other is not item
    ]
    if to_border < 0.0 or any(gap < -LAPPED * min(item.radius, radius) for gap, radius in gaps):
        return CUT_SCORE
    gap = min([to_border, *(gap for gap, _ in gaps)])
    return score_of_room(gap, item.radius)


def score_of_room(gap: float, size: float) -> float:
    """Return the score of one of many things by its ``gap`` to the next over its ``size``, of the same unit."""
    room = float(np.clip(gap / (ROOM * size), 0.0, 1.0))
    return round(SCORES[0] + room * (SCORES[1] - SCORES[0]), 3)


def _box(item: Circle, width: int, height: int) -> tuple[float, float, float, float]:
    reach = item.radius * (1.0 + 2.0 * MARGIN)
    x0, y0 = max(0, round(item.x - reach)), max(0, round(item.y - reach))
    x1, y1 = min(width, round(item.x + reach)), min(height, round(item.y + reach))
    return float(x0), float(y0), float(x1), float(y1)
