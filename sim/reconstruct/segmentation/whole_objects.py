# SPDX-License-Identifier: MIT
"""Which of overlapping candidates are whole objects: not several at once, not one with ground, not a part of one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .mask_geometry import Mask, extent_of, hull_of, solidity_of
from .proposal_features import cut_share

GOOD = 0.8
"""Score of a candidate that may be an object of a group."""
BETTER = 0.9
"""Score of a candidate that may be the object in another that has ground around it."""
WITHIN = 0.85
"""Share of a candidate that lies in another of which it is a part."""
LEAST_PART, MOST_PART = 0.08, 0.85
"""Area of an object of a group over the group's."""
ALL = 0.8
"""Share of a group that its objects cover, unless the rest is ground."""
DENTED = 0.03
"""How much less of its convex hull a group fills than the most convex of its objects. The faces of a box fill less
than the box."""
WHOLE = 0.12
"""Score that e times the area is worth when two candidates overlap."""

CUT = 0.02
"""Share of its box' outline on the photo's border from which a thing is cut."""
AMID = 0.15
"""Area of a thing over that of one around it which the photo's border cuts, from which that is the thing and what
surrounds it."""
STEP, BESIDE = 8.0, 3.0
"""Step of colour in CIELAB that an outline has, and the pixels beside it over which colours are averaged: the texture
of bark and grass has edges anywhere, but the same mean on both sides."""
OUTLINED, OPEN, FAINTER = 0.95, 0.75, 0.33
"""Share of its outline with such a step from which a thing is known to end there; share of it along the rest of a
candidate below which that goes on beyond; and its median over the thing's. A plush before a tree had 1.00, 0.69 and
0.29, a duck on its shadow 1.00, 0.48 and 0.08; parts of things had rests of 0.83 and more."""

FLUSH, SEAM = 0.7, 3
"""Share of the lower outline of a part that lies on the one below, and of that one's upper outline that lies under it,
from which both are one thing; and how many pixels may be between them."""


class Candidate(NamedTuple):
    """mask: (h, w). score: 0 to 1. shade: whether it may be nothing but shade on what surrounds it."""

    mask: Mask
    score: float
    shade: bool


def whole_objects(found: Sequence[Candidate], lab: NDArray[np.float32]) -> list[int]:
    """Return the numbers of those of ``found`` that are whole objects, none of which overlap.

    A candidate is no object where others that stand on the ground by themselves make it up, where it is another one
    with some ground, lit or shaded, or with some background that goes on beyond it, or where the photo's border cuts it
    but not one in it. Of those left a whole goes before its parts, which often have the clearer outline.
    lab: (h, w, 3) CIELAB of the picture.
    """
    order = sorted(range(len(found)), key=lambda i: int(found[i].mask.sum()))
    kept: list[int] = []
    extents = [item.mask for item in found]
    for i in order:
        inner = [j for j in kept if _within(found[j].mask, found[i].mask) > WITHIN]
        things = [found[j] for j in inner]
        if _is_group(found[i], things, lab) or _is_cut(found[i], things, lab):
            continue
        without = next((j for j in inner if _has_ground(found[i], found[j], things, lab)), None)
        if without is None:
            kept.append(i)
        else:
            # What else was found in that ground is no object either.
            extents[without] = extents[without] | found[i].mask
    kept.sort(key=lambda i: -(found[i].score + WHOLE * float(np.log(found[i].mask.mean()))))
    result: list[int] = []
    for i in kept:
        if all(not _same_or_part(found[i].mask, extents[j]) for j in result):
            result.append(i)
    return result


def stacked_parts(masks: Sequence[Mask]) -> list[list[int]]:
    """Return the numbers of ``masks`` (h, w), those together that are parts of one thing: a lid on its jar.

    Two things rarely end at the same place on both sides where one stands on the other (a generic view; Freeman, Nature
    1994), and the one would carry the other along.
    """
    groups = [[i] for i in range(len(masks))]
    for upper, above in enumerate(masks):
        for lower, below in enumerate(masks):
            if upper == lower or not _flush(above, below):
                continue
            first = next(group for group in groups if upper in group)
            second = next(group for group in groups if lower in group)
            if first is not second:
                first += second
                groups.remove(second)
    return groups


def _flush(above: Mask, below: Mask) -> bool:
    """Whether all of the underside of ``above`` lies on ``below``, all of whose top lies under it."""
    height = len(above)
    steps = np.arange(1, SEAM + 1)[:, None]
    columns = np.flatnonzero(above.any(axis=0))
    lowest = height - 1 - above[::-1, columns].argmax(axis=0)
    carried = below[np.minimum(height - 1, lowest + steps), columns].any(axis=0)
    if carried.mean() < FLUSH:
        return False
    columns = np.flatnonzero(below.any(axis=0))
    highest = below[:, columns].argmax(axis=0)
    covered = above[np.maximum(0, highest - steps), columns].any(axis=0)
    return bool(covered.mean() >= FLUSH)


def _within(mask: Mask, other: Mask) -> float:
    return float((mask & other).sum()) / float(mask.sum())


def _is_group(whole: Candidate, inner: Sequence[Candidate], lab: NDArray[np.float32]) -> bool:
    """Whether ``whole`` is several objects: two or more of ``inner`` make it up, and each of them stands by itself or
    is hidden in part by one that does."""
    area = float(whole.mask.sum())
    _, top, _, bottom = extent_of(whole.mask)
    covered = np.zeros_like(whole.mask)
    chosen: list[Candidate] = []
    good = [part for part in inner if part.score >= GOOD and not part.shade]
    good = [part for part in good if LEAST_PART * area <= float(part.mask.sum()) <= MOST_PART * area]
    standing = [part for part in good if stands_alone(part.mask, whole.mask)]
    for part in sorted(good, key=lambda item: -int(item.mask.sum())):
        if extent_of(part.mask)[3] < top + (bottom - top) / 3:
            continue
        alone = any(part is item for item in standing)
        if not alone and not any(_hides(item.mask, part.mask) for item in standing):
            continue
        if float((part.mask & covered).sum()) < 0.15 * float(part.mask.sum()):
            chosen.append(part)
            covered |= part.mask
    if len(chosen) < 2 or solidity_of(whole.mask) >= max(solidity_of(part.mask) for part in chosen) - DENTED:
        return False
    share = float((covered & whole.mask).sum()) / area
    return share > ALL or (share > 0.5 * ALL and rest_is_ground(covered & whole.mask, whole.mask, lab))


def stands_alone(part: Mask, whole: Mask) -> bool:
    """Return whether what lies below two fifths of ``part``'s width is not the rest of ``whole``."""
    x0, y0, x1, y1 = extent_of(part)
    columns = np.flatnonzero(part.any(axis=0))
    lowest = part.shape[0] - 1 - part[::-1, columns].argmax(axis=0)
    below = np.minimum(part.shape[0] - 1, lowest + max(2, round(0.06 * max(x1 - x0, y1 - y0))))
    return float((~whole[below, columns]).mean()) >= 0.4


def _hides(front: Mask, behind: Mask) -> bool:
    """Whether ``front`` stands before ``behind``: it reaches lower, and into a dent of its outline."""
    if extent_of(front)[3] <= extent_of(behind)[3] or float((front & behind).sum()) > 0.15 * float(front.sum()):
        return False
    return float((front & hull_of(behind)).sum()) > 0.08 * float(behind.sum())


def _has_ground(whole: Candidate, item: Candidate, inner: Sequence[Candidate], lab: NDArray[np.float32]) -> bool:
    """Whether ``whole`` is ``item`` and some ground."""
    area, size = float(whole.mask.sum()), float(item.mask.sum())
    if item.score < max(BETTER, whole.score - 0.1) or size < 0.3 * area or _within(item.mask, whole.mask) < 0.9:
        return False
    for other in inner:
        apart = float((other.mask & item.mask).sum()) < 0.15 * float(other.mask.sum())
        if apart and other.score >= GOOD and not other.shade and float(other.mask.sum()) > 0.12 * area:
            return False
    dented = solidity_of(whole.mask) < solidity_of(item.mask) - 0.01
    if dented and rest_is_ground(item.mask, whole.mask, lab):
        return True
    return stands_alone(item.mask, whole.mask) and _goes_on(item.mask, whole.mask, lab)


def _goes_on(part: Mask, whole: Mask, lab: NDArray[np.float32]) -> bool:
    """Whether ``part`` ends at its outline, but ``whole`` without it, such as a tree behind, goes on beyond its own."""
    own, rest = outline_steps(part, part, lab), outline_steps(whole & ~part, whole, lab)
    if not len(own) or not len(rest) or (own > STEP).mean() < OUTLINED or (rest > STEP).mean() > OPEN:
        return False
    return float(np.median(rest)) < FAINTER * float(np.median(own))


def outline_steps(part: Mask, whole: Mask, lab: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the steps of colour (n,) across the outline of ``whole`` where that is of ``part``; in the photo."""
    kernel = np.ones((3, 3), np.uint8)
    inner = cv2.erode(whole.astype(np.uint8), kernel) > 0
    means, seen = [], part & ~inner
    for side in (part & inner, cv2.dilate(whole.astype(np.uint8), kernel) == 0):
        weight = cv2.GaussianBlur(side.astype(np.float32), (0, 0), BESIDE)
        total = cv2.GaussianBlur(lab * side[..., None].astype(np.float32), (0, 0), BESIDE)
        means.append(total / np.maximum(weight, 1e-4)[..., None])
        seen = seen & (weight > 0.01)
    return np.asarray(np.linalg.norm(means[0] - means[1], axis=2)[seen], dtype=np.float32)


def _is_cut(whole: Candidate, inner: Sequence[Candidate], lab: NDArray[np.float32]) -> bool:
    """Whether the photo's border cuts ``whole``, but not a thing of ``inner`` amid it that ends at its outline."""
    if cut_share(whole.mask) <= CUT:
        return False
    area = float(whole.mask.sum())
    for item in inner:
        share = float(item.mask.sum()) / area
        if item.score < max(BETTER, whole.score) or item.shade or not AMID <= share <= MOST_PART:
            continue
        if cut_share(item.mask) <= CUT and (outline_steps(item.mask, item.mask, lab) > STEP).mean() >= OUTLINED:
            return True
    return False


def rest_is_ground(part: Mask, whole: Mask, lab: NDArray[np.float32]) -> bool:
    """Return whether ``whole`` without ``part`` looks like what is beside it, lit or shaded, and not like ``part``."""
    kernel = np.ones((3, 3), np.uint8)
    rest = whole & ~(cv2.dilate(part.astype(np.uint8), kernel) > 0)
    rest = cv2.morphologyEx(rest.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    if rest.sum() < max(12.0, 0.04 * float(whole.sum())):
        return False
    side = 2 * max(4, round(0.2 * float(np.sqrt(whole.sum())))) + 1
    reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    beside = (cv2.dilate(rest.astype(np.uint8), reach) > 0) & ~(cv2.dilate(whole.astype(np.uint8), kernel) > 0)
    if beside.sum() < 20:
        return False
    own, near = np.median(lab[rest], axis=0), np.median(lab[beside], axis=0)
    # CIELAB scales with the cube root of light but for the offset of L*.
    factor = (own[0] + 16.0) / (near[0] + 16.0)
    hue = float(np.linalg.norm(own[1:] - factor * near[1:]))
    if not 0.3 < factor < 1.04 or np.linalg.norm(own - np.median(lab[part], axis=0)) < max(5.0, 1.5 * hue):
        return False
    even = lab[rest][:, 0].std() < 1.5 * lab[beside][:, 0].std() + 5.0
    return bool(even and hue < 6.0 + 0.12 * float(np.linalg.norm(near[1:])))


def _same_or_part(mask: Mask, better: Mask) -> bool:
    """Whether ``mask`` is mostly ``better`` itself, a part of it, or a shadow or strap that touches it in its box."""
    common = float((mask & better).sum())
    if common > 0.5 * float(min(mask.sum(), better.sum())):
        return True
    x0, y0, x1, y1 = extent_of(better)
    inside = float(mask[y0:y1, x0:x1].sum()) / float(mask.sum())
    kernel = np.ones((7, 7), np.uint8)
    return inside > 0.7 and bool(((cv2.dilate(mask.astype(np.uint8), kernel) > 0) & better).any())
