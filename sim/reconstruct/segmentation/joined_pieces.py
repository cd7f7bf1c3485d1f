# SPDX-License-Identifier: MIT
"""One thing that was found in pieces: a dog's head and its flank, the shade, the arm and the foot of a lamp.

What joins the pieces, a pale breast before a pale sky or thin rods, stands out too little to be a candidate of its own.
So the box around all of them is segmented once more, with the pieces as what the object certainly is. They are one
where they are of the same colours, and what comes out joins them, is no ground, and ends at an outline. Two things of a
kind on one floor stay two.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .box_crop import crop_around_box, padded
from .colour_models import SHADES, ground_likelihood
from .mask_geometry import Mask, extent_of, grown, largest_component, shrunk
from .mask_proposals import propose
from .proposal_features import cut_share, lab_of
from .whole_objects import CUT, STEP, outline_steps, rest_is_ground, stands_alone

Pixels = NDArray[np.uint8]

MOST = 3
"""Pieces above which what was found is taken for many things."""
ROUNDS = 4
"""Rounds of cuts and colour models."""
MARGIN = 0.06
"""Margin of the box around the pieces, over its longer side."""
SEAM = 2
"""Pixels around a piece in which its colours are mixed; pieces closer than twice that touch."""
ALIKE, SHARED = 10.0, 0.5
"""Distance in CIELAB below which colours are the same, and the share of the smaller of two pieces that must have
colours of the larger one."""
HELD = 0.9
"""Share of each piece that the whole holds."""
JOINT, MOST_JOINT = 0.05, 0.7
"""Least and largest area of what joins the pieces, over the whole's."""
EDGED = 0.5
"""Least share of the outline of what joins them with a step of colour: ground goes on beyond it."""
ONE_FLOOR = 1.0
"""Two pieces that stand by themselves are two things where the feet of both are less apart, over the height of the
higher one: a lamp's shade hangs far above its foot."""


def in_one_piece(
    pixels: Pixels, masks: Sequence[Mask], scores: Sequence[float], aside: float
) -> tuple[list[Mask], list[float]]:
    """Return the objects ``masks`` (h, w) of ``pixels`` (h, w, 3) and their ``scores``, those as one that are pieces of
    one thing; only objects with a score above ``aside`` are looked at."""
    used = [i for i, score in enumerate(scores) if score > aside]
    found = joined_pieces(pixels, [masks[i] for i in used])
    if found is None:
        return list(masks), list(scores)
    whole, pieces = found
    rest = [i for i, mask in enumerate(masks) if (mask & whole).sum() < 0.5 * mask.sum()]
    return [whole, *(masks[i] for i in rest)], [max(scores[used[i]] for i in pieces), *(scores[i] for i in rest)]


def joined_pieces(pixels: Pixels, pieces: Sequence[Mask]) -> tuple[Mask, list[int]] | None:
    """Return the thing (h, w) in ``pixels`` (h, w, 3) of which two or more of ``pieces`` (h, w) are parts, and their
    numbers; None where there is none.

    Cost: a second for two pieces.
    """
    if not 2 <= len(pieces) <= MOST:
        return None
    lab = lab_of(pixels)
    for chosen in _groups(len(pieces)):
        parts = [pieces[i] for i in chosen]
        if not _apart(parts) or not _alike(lab, parts):
            continue
        whole = _whole(pixels, lab, parts)
        if whole is not None:
            return whole, chosen
    return None


def _groups(count: int) -> Iterator[list[int]]:
    """Numbers of the pieces that may be one: all of them first, then fewer."""
    for size in range(count, 1, -1):
        yield from (list(group) for group in combinations(range(count), size))


def _apart(parts: Sequence[Mask]) -> bool:
    """Whether some of ``parts`` (h, w) are apart: those that all touch were judged together before."""
    near = grown(np.logical_or.reduce(list(parts)), SEAM)
    return int(cv2.connectedComponents(near.astype(np.uint8), connectivity=8)[0]) > 2


def _alike(lab: NDArray[np.float32], parts: Sequence[Mask]) -> bool:
    """Whether all of ``parts`` (h, w) have colours of the largest."""
    order = sorted(parts, key=lambda part: -int(part.sum()))
    colours = cKDTree(lab[order[0]][:: max(1, int(order[0].sum()) // 1000)])
    return all(float((colours.query(lab[part])[0] < ALIKE).mean()) > SHARED for part in order[1:])


def _whole(pixels: Pixels, lab: NDArray[np.float32], parts: Sequence[Mask]) -> Mask | None:
    """The thing (h, w) in the box around ``parts`` (h, w), which certainly belong to it; None where it is not one."""
    both = np.logical_or.reduce(list(parts))
    x0, y0, x1, y1 = extent_of(both)
    margin = round(MARGIN * max(x1 - x0, y1 - y0)) + 1
    height, width = both.shape
    box = (max(0, x0 - margin), max(0, y0 - margin), min(width, x1 + margin), min(height, y1 + margin))
    window, inner = padded(box, both.shape)
    crop, keep = np.ascontiguousarray(pixels[window]), np.logical_or.reduce([shrunk(part) for part in parts])
    view = crop_around_box(crop, inner, np.zeros(crop.shape[:2], dtype=bool), keep=keep[window])
    if view.outside.sum() < 60:
        return None
    ground = ground_likelihood(view, view.outside, view.inside)
    whole = np.zeros_like(both)
    whole[window] = largest_component(propose(view, view.keep, ground, SHADES, ROUNDS))
    return whole if whole.any() and _is_one(whole, parts, lab) else None


def _is_one(whole: Mask, parts: Sequence[Mask], lab: NDArray[np.float32]) -> bool:
    """Whether ``whole`` is one thing that holds ``parts``, all (h, w), and not several things with ground between."""
    if any(float((whole & part).sum()) < HELD * float(part.sum()) for part in parts) or cut_share(whole) > CUT:
        return False
    both = np.logical_or.reduce(list(parts))
    rest = whole & ~grown(both, SEAM)
    rest = cv2.morphologyEx(rest.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0
    if not JOINT <= rest.sum() / whole.sum() <= MOST_JOINT or rest_is_ground(both & whole, whole, lab):
        return False
    standing = [part for part in parts if stands_alone(part & whole, whole)]
    if any(_on_one_floor(*pair) for pair in combinations(standing, 2)):
        return False
    steps = outline_steps(rest, whole, lab)
    return len(steps) > 0 and float((steps > STEP).mean()) > EDGED


def _on_one_floor(first: Mask, second: Mask) -> bool:
    """Whether the feet of both (h, w) are as close as those of two things on one floor."""
    (_, top, _, foot), (_, other_top, _, other_foot) = extent_of(first), extent_of(second)
    return abs(foot - other_foot) < ONE_FLOOR * max(foot - top, other_foot - other_top)
