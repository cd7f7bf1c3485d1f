# SPDX-License-Identifier: MIT
"""The outline of what is alike left and right, such as cans, jars and vases, from edges that both sides show.

Colours lose the metal rim of a can, which mirrors the ground, and a print of the background's colour at its side. But
the true outline lies on edges to the left and to the right of one upright axis, and neither a print, nor a cast shadow,
nor what stands behind is mirrored about that. The picture is folded at the axis, edges keep the weaker of both sides,
and the outline is the cheapest path around the middle, from above it to below it (dynamic programming in polar
coordinates). It replaces the mask's where it adds parts that sharp edges close, and where the mask is nearly so
symmetric already that the thing may well be.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from .box_crop import BoxCrop, crop_around_box, edge_crest, edge_strength, small_copy
from .colour_models import ground_likelihood
from .mask_geometry import Mask, enclosed_holes, grown, shrunk
from .part_contour import CREST

Field = NDArray[np.float32]
Points = NDArray[np.float64]

SIZE = 400
"""Longest side in pixels of the copy on which the outline is searched."""
TILT = 0.09
"""Largest slope of the axis from the vertical."""
ANGLES, JUMP = 220, 4
"""Rays around the middle, from up to down, and pixels by which the outline may move along them from one to the next."""
FOLDED = 0.54
"""Overlap of a mask with its mirror image below which nothing is searched."""
LOST, GAINED, ON_EDGES = 0.06, 0.3, 0.9
"""Largest share of the mask that the new outline leaves out, and that it adds; and the share of the outline on edges of
both sides from which it is believed."""
EDGE_COST, UNLIKE, COMMON, OUTWARD = 3.0, 0.1, 0.6, 8.0
"""Cost of a pixel of outline without an edge; value of a pixel inside that is unlike ground, and of one that is in the
mask on both sides; and of any, over the size in pixels: of two edges the outer one is a thing's, the inner one a
print's."""
CLOSED, STANDS_OUT = 0.8, 1.5
"""Share of an added part's outer rim on edges, and their strength over that of the edges beyond: grass is full of
them."""
MOUTH = 0.2
"""Least share of its own rim along which such a part faces outwards: the edge across a pocket's mouth closes none."""
LEAST, MOSTLY = 0.006, 0.75
"""Least area of added parts over the mask's, and the share of all that is added that must be closed so."""
THICK = 3.0
"""Pixels of the copy from which an added part is more than the edge's own width."""
SLIVER = (2.5, 0.05)
"""How far, in pixels and over the size, parts of the mask outside of the new outline reach that are dropped: less is
the edge's own width, more is a handle or an aerial."""
BESIDE = 0.1
"""Length over the size along which an edge over an added part goes on at both sides of it: a table's behind."""
BELOW = 0.12
"""Largest height over the mask's of a part below it that neither side of the mask has: a foot, but no shadow."""


@dataclass(frozen=True)
class _Axis:
    """The nearly vertical line x = x0 + tilt · (y − middle); half: half the width of what it divides. Pixels."""

    x0: float
    tilt: float
    middle: float
    half: float

    def column(self, rows: Points) -> Points:
        """Its x at ``rows``."""
        return self.x0 + self.tilt * (rows - self.middle)


def mirrored_outline(
    pixels: NDArray[np.uint8], box: tuple[int, int, int, int], mask: Mask, others: Mask, drop: Mask
) -> Mask:
    """Return ``mask`` (h, w) with the outline that both sides show; unchanged where there is none, or nothing to add.

    pixels: (h, w, 3) sRGB. box: x0, y0, x1, y1 around the object. others: (h, w) other objects, drop: (h, w) what the
    user says is background. Cost: some tenths of a second.
    """
    copy = small_copy(mask.shape, SIZE)
    own, other, barred = copy.mask(mask), copy.mask(others), copy.mask(drop)
    view = crop_around_box(copy.pixels(pixels), copy.box(box), other, drop=barred)
    if own.sum() < 400 or view.outside.sum() < 200:
        return mask
    edges = edge_strength(view.lab)
    axis = _axis_of(own, edges)
    if _overlap(own, _mirrored(own, axis)) < FOLDED:
        return mask
    outline, share = _path(view, own, edges, axis)
    area = float(own.sum())
    if share < ON_EDGES or (own & ~outline).sum() > LOST * area or (outline & ~own).sum() > GAINED * area:
        return mask
    if not _adds(outline, own, edges, axis):
        return mask
    away = cv2.distanceTransform((~outline).astype(np.uint8), cv2.DIST_L2, 3)
    labels, count = ndimage.label(own & ~outline, np.ones((3, 3)))
    reach = ndimage.maximum(away, labels, np.arange(count + 1))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    added = cv2.morphologyEx((outline & ~own).astype(np.uint8), cv2.MORPH_OPEN, disc) > 0
    outline = (outline & own) | added
    kept = np.asarray((reach < SLIVER[0]) | (reach > SLIVER[1] * float(np.sqrt(own.sum()))))[labels] & (labels > 0)
    whole, gone = copy.enlarged(outline | kept), copy.enlarged(own & ~(outline | kept))
    return np.asarray((mask & ~gone) | (whole & ~others & ~drop))


def _overlap(first: Mask, second: Mask) -> float:
    return float((first & second).sum() / max(1, int((first | second).sum())))


def _at(field: Field, x: Points, y: Points) -> Field:
    """``field`` (h, w) at ``x``, ``y`` of one shape, bilinear, 0 outside."""
    across, down = x.astype(np.float32), y.astype(np.float32)
    found = cv2.remap(field, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(found, dtype=np.float32)


def _mirrored(mask: Mask, axis: _Axis) -> Mask:
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float64)
    return np.asarray(_at(mask.astype(np.float32), 2.0 * axis.column(rows) - columns, rows) > 0.5)


def _axis_of(mask: Mask, edges: Field) -> _Axis:
    """The axis about which most edges near the outline of ``mask`` (h, w) lie on both sides."""
    rows = np.flatnonzero(mask.any(axis=1))
    left, right = mask[rows].argmax(axis=1), mask.shape[1] - 1 - mask[rows][:, ::-1].argmax(axis=1)
    wide = (right - left) / 2.0
    half, middle = float(np.quantile(wide, 0.9)), float(rows[0] + rows[-1]) / 2.0
    start = float(np.average((left + right) / 2.0, weights=wide + 0.5))
    reach = 2 * round(0.12 * float(np.sqrt(mask.sum()))) + 1
    disc = np.ones((reach, reach), np.uint8)
    binary = mask.astype(np.uint8)
    near = (cv2.dilate(binary, disc) > 0) & ~(cv2.erode(binary, disc, borderValue=0) > 0)
    strong = np.where(near, np.minimum(edges, 3.0 * CREST), 0.0).astype(np.float32)
    crest = np.asarray(cv2.GaussianBlur(strong, (0, 0), 1.0), dtype=np.float32)
    across, down = np.meshgrid(np.linspace(0.0, 1.35 * half, 90), np.linspace(rows[0], rows[-1], 70))

    def both(axis: _Axis) -> float:
        at = axis.column(down)
        return float(np.minimum(_at(crest, at - across, down), _at(crest, at + across, down)).sum())

    found = _Axis(start, 0.0, middle, half)
    for tilts, shifts in ((TILT, 0.25), (TILT / 3.0, 0.03)):
        tried = [
            _Axis(found.x0 + shift * half, float(np.clip(found.tilt + tilt, -TILT, TILT)), middle, half)
            for tilt in np.linspace(-tilts, tilts, 7)
            for shift in np.linspace(-shifts, shifts, 21)
        ]
        found = max(tried, key=both)
    return found


def _path(view: BoxCrop, mask: Mask, edges: Field, axis: _Axis) -> tuple[Mask, float]:
    """The symmetric outline of least cost, filled (h, w), and its share on edges of both sides."""
    crest = edge_crest(edges)
    size = float(np.sqrt(mask.sum()))
    rows = np.flatnonzero(mask.any(axis=1))
    tall = max(1.0, float(rows[-1] - rows[0]) / 2.0)
    x0, y0, x1, y1 = view.box
    farthest = max((axis.middle - y0) / tall, (y1 - axis.middle) / tall, (axis.x0 - x0) / axis.half)
    farthest = float(np.clip(max(farthest, (x1 - axis.x0) / axis.half), 1.25, 3.0))
    ratio = np.linspace(0.15, farthest, round(farthest * max(axis.half, tall)))
    turn = np.linspace(0.0, np.pi, ANGLES)
    y = axis.middle - tall * np.cos(turn)[:, None] * ratio
    away = axis.half * np.sin(turn)[:, None] * ratio
    left, right = axis.column(y) - away, axis.column(y) + away

    def folded(field: Field) -> Field:
        return np.minimum(_at(field, left, y), _at(field, right, y))

    both = folded(crest)
    sharp = np.minimum((_at(edges, left, y) + _at(edges, right, y)) / 2.0, both)
    strength = 0.6 * both / (both + CREST) + 0.4 * sharp / (sharp + CREST)
    outside = (y < y0) | (y > y1 - 1) | (left < x0) | (right > x1 - 1) | (folded(view.inside.astype(np.float32)) < 0.5)
    value = UNLIKE * folded(_unlike_ground(view)) + COMMON * (folded(mask.astype(np.float32)) > 0.5) + OUTWARD / size
    area = axis.half * tall * ratio * np.gradient(ratio) * (turn[1] - turn[0])
    node = np.where(outside, 1e6, 0.0) - np.cumsum(value * area, axis=1)
    # Outwards it has gone to the far side of the edge.
    chosen = np.maximum(_cheapest(np.stack([away, y], axis=-1), strength, node) - 1, 0)
    index = np.arange(ANGLES)
    half, row, found = away[index, chosen], y[index, chosen], both[index, chosen]
    step = np.hypot(np.diff(half, prepend=half[0]), np.diff(row, prepend=row[0]))
    share = float((step * (found > CREST)).sum() / max(float(step.sum()), 1e-9))
    column = axis.column(row)
    ring = np.concatenate([np.stack([column - half, row], 1), np.stack([column + half, row], 1)[::-1]])
    filled = np.zeros(mask.shape, np.uint8)
    cv2.fillPoly(filled, [np.round(ring * 16).astype(np.int32)], 1, shift=4)
    return filled > 0, share


def _unlike_ground(view: BoxCrop) -> Field:
    """How little each pixel (h, w) of the box looks like the ground around it, lit or shaded, 0 to 1; 0 outside."""
    inside, outside = view.inside, view.outside
    usual = float(np.quantile(ground_likelihood(view, outside, outside, ()), 0.1))
    result = np.zeros(inside.shape, dtype=np.float32)
    result[inside] = np.clip((usual - ground_likelihood(view, outside, inside)) / 6.0, 0.0, 1.0)
    return result


def _cheapest(places: Points, strength: Field, node: Points) -> NDArray[np.int64]:
    """Index along each ray (ANGLES,) of the path of least cost through ``places`` (ANGLES, n, 2), costs ``node``."""
    count = node.shape[1]
    cost, back = node[0], np.zeros(node.shape, dtype=np.int64)
    for i in range(1, ANGLES):
        best = np.full(count, np.inf)
        for jump in range(-JUMP, JUMP + 1):
            here = np.arange(max(0, jump), min(count, count + jump))
            before = here - jump
            length = np.linalg.norm(places[i, here] - places[i - 1, before], axis=1)
            weak = 1.0 - (strength[i, here] + strength[i - 1, before]) / 2.0
            total = cost[before] + EDGE_COST * length * weak
            better = total < best[here]
            best[here[better]], back[i, here[better]] = total[better], before[better]
        cost = best + node[i]
    chosen = [int(np.argmin(cost))]
    for i in range(ANGLES - 1, 0, -1):
        chosen.append(int(back[i, chosen[-1]]))
    return np.array(chosen[::-1])


def _adds(outline: Mask, mask: Mask, edges: Field, axis: _Axis) -> bool:
    """Whether what ``outline`` adds to ``mask``, both (h, w), is mostly closed by edges of both sides that stand out
    from those beyond."""
    crest = edge_crest(edges)
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float64)
    folded = np.minimum(crest, _at(crest, 2.0 * axis.column(rows) - columns, rows))
    either = mask | _mirrored(mask, axis)
    rim = outline & ~shrunk(outline)
    near = grown(mask, 2)
    size, foot = float(np.sqrt(mask.sum())), int(np.flatnonzero(mask.any(axis=1))[-1])
    tall = float(np.ptp(np.flatnonzero(mask.any(axis=1))))

    def around(part: Mask, reach: float) -> Mask:
        return grown(part, max(1, round(reach)))

    beyond = around(outline, 0.08 * size) & ~around(outline | mask, 3)
    labels, count = ndimage.label(outline & ~mask & ~enclosed_holes(mask), np.ones((3, 3)))
    closed = added = 0.0
    for index in range(1, count + 1):
        part = labels == index
        if 2.0 * float(cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 3).max()) < THICK:
            continue
        # So near the mask it is the edge's own width.
        area = float((part & ~near).sum())
        added += area
        outer = part & rim & ~near
        inner = shrunk(part)
        if not outer.any() or (part & rim).sum() < MOUTH * (part & ~inner).sum():
            continue
        texture = beyond & around(part, 0.1 * size)
        usual = float(np.median(crest[texture if texture.sum() > 20 else beyond])) if beyond.any() else 0.0
        least = max(1.3 * CREST, STANDS_OUT * usual)
        below = float(np.flatnonzero(part.any(axis=1))[-1] - foot) / max(tall, 1.0)
        shadow = below > BELOW and float(either[part].mean()) < 0.5
        if (
            not shadow
            and not _goes_on(crest, part, BESIDE * size)
            and (folded[outer] > CREST).mean() > CLOSED
            and float(np.median(folded[outer])) > least
        ):
            closed += area
    return closed > LEAST * float(mask.sum()) and closed > MOSTLY * added


def _goes_on(crest: Field, part: Mask, length: float) -> bool:
    """Whether the edge over ``part`` goes on for ``length`` pixels at both sides of it: then it is not the thing's."""
    columns = np.flatnonzero(part.any(axis=0))
    row, near, far = round(float(np.median(part[:, columns].argmax(axis=0)))), 3, 3 + max(4, round(length))
    left, right = int(columns[0]), int(columns[-1]) + 1
    if left < far or right + far > part.shape[1]:
        return False
    band = crest[max(0, row - 2) : row + 3].max(axis=0)
    sides = band[left - far : left - near], band[right + near : right + far]
    return all(float((side > CREST).mean()) > CLOSED for side in sides)
