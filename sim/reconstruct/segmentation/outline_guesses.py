# SPDX-License-Identifier: MIT
"""Guesses of the whole outline of a partly hidden object: an ellipse, mirror and point symmetry, continued tangents.

Masks are small copies (h, w): ``seen`` the visible part, ``unknown`` where the object may continue; the rest is known
to show something behind it. Points are x, y in pixels of that copy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .mask_geometry import Mask

Points = NDArray[np.float64]

TILTS = (0.0, -5.0, 5.0, -10.0, 10.0, -15.0, 15.0)
"""Tilts in degrees of the mirror axis."""
CONIC_WEIGHT = 2.0
"""Weight of the rational curve that joins two tangents: 1 is a parabola, larger values approach their corner."""
OPEN = 0.3
"""Share of background in the visible part of a convex hull, above which the object is not convex there."""


@dataclass(frozen=True)
class OutlineGuess:
    """A guess of the whole mask. misfit: disagreement of its rule with the visible part, in shares of the visible
    area."""

    rule: str
    outline: Mask
    misfit: float


def _convolved(first: NDArray[Any], second: NDArray[Any], *, axes: int | None = None) -> NDArray[np.float64]:
    """Return the full convolution of two images, along ``axes`` or both."""
    # Half a second of imports, of scipy.stats above all, that every bake and command would pay.
    from scipy.signal import fftconvolve

    return np.asarray(fftconvolve(first, second, axes=axes))


def ellipse(seen: Mask, unknown: Mask) -> OutlineGuess | None:
    """Fit an ellipse to the object's own outline (Fitzgibbon, Pilu & Fisher, PAMI 1999)."""
    contour = contour_of(seen)
    own = contour[on_own_edge(contour, unknown)]
    if len(own) < 12:
        return None
    (x, y), (width, height), turn = cv2.fitEllipseDirect(own.astype(np.float32))
    if not np.isfinite([x, y, width, height, turn]).all() or min(width, height) < 2.0:
        return None
    if max(width, height) > 2.0 * max(seen.shape):
        return None
    drawn = np.zeros(seen.shape, dtype=np.uint8)
    cv2.ellipse(drawn, ((x, y), (width, height), turn), 1, -1)
    return OutlineGuess("ellipse", drawn > 0, known_share((drawn > 0) ^ seen, seen, unknown))


def mirrored(seen: Mask, unknown: Mask) -> OutlineGuess | None:
    """Mirror the visible part about a nearly upright axis, with notches filled by the local convex hull.

    The axis maximises the overlap of the object with itself and minimises that with known background.
    """
    height, width = seen.shape
    area = int(seen.sum())
    rows, columns = np.nonzero(seen)
    centre = (float(columns.mean()), float(rows.mean()))
    other = ~(seen | unknown)
    best: tuple[float, NDArray[np.float64]] | None = None
    for tilt in TILTS:
        turn = cv2.getRotationMatrix2D(centre, tilt, 1.0)
        own, clear = (cv2.warpAffine(m.astype(np.float32), turn, (width, height)) for m in (seen, other))
        # Entry k: the overlap after mapping x to k - x.
        same = _convolved(own, own, axes=1).sum(axis=0)
        clash = _convolved(own, clear, axes=1).sum(axis=0)
        score = (same - 2.0 * clash) / area - 0.004 * abs(tilt)
        k = int(np.argmax(score))
        if best is None or score[k] > best[0]:
            flip = np.array([[-1.0, 0.0, k], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            whole = np.vstack([turn, [0.0, 0.0, 1.0]])
            best = float(score[k]), np.asarray(np.linalg.inv(whole) @ flip @ whole)[:2]
    assert best is not None
    image = cv2.warpAffine(seen.astype(np.float32), best[1], (width, height)) > 0.5
    outline = (image | seen) & (seen | unknown)
    return OutlineGuess("mirrored", _bridged(outline, unknown), known_share(image & ~seen, seen, unknown))


def point_mirrored(seen: Mask, unknown: Mask) -> OutlineGuess | None:
    """Point-reflect the visible part and take the convex hull: boxes, cylinders and spheres look like that from
    afar."""
    height, width = seen.shape
    own, clear = seen.astype(np.float32), (~(seen | unknown)).astype(np.float32)
    score = _convolved(own, own) - 2.0 * _convolved(own, clear)
    down, across = np.unravel_index(int(np.argmax(score)), score.shape)
    flip = np.array([[-1.0, 0.0, across], [0.0, -1.0, down]])
    image = cv2.warpAffine(own, flip, (width, height)) > 0.5
    outline = (image | seen) & (seen | unknown)
    hull = _hull(outline)
    misfit = known_share(image & ~seen, seen, unknown) + known_share(_hull(seen) & ~seen, seen, unknown)
    return OutlineGuess("point_mirrored", hull, misfit)


def continued(seen: Mask, unknown: Mask, lowest_base: float) -> OutlineGuess:
    """Continue the outline from where it disappears to where it reappears.

    Tangents that meet are joined by a conic. Parallel ones, such as the walls of a bottle whose foot is hidden, are
    extended: down to the row ``lowest_base``, sideways half as far as the object could reach unseen.
    """
    contour = contour_of(seen)
    own = on_own_edge(contour, unknown)
    reach = max(5, round(0.08 * len(contour)))
    result = seen.copy()
    for first, last in _cut_runs(own):
        start, end = _tangent(contour, own, first, -1, reach), _tangent(contour, own, last, 1, reach)
        if start is None or end is None:
            continue
        gap = float(np.linalg.norm(end[0] - start[0]))
        if gap < 0.08 * np.sqrt(seen.sum()):
            continue
        curve = _joined(start, end, gap)
        if curve is None:
            curve = _carried_on(start, end, seen | unknown, lowest_base)
        indices = np.arange(last, last - (last - first) % len(contour) - 1, -1) % len(contour)
        result |= _filled_polygon(np.concatenate([curve, contour[indices]]), seen.shape)
    outline = result & (seen | unknown)
    return OutlineGuess("continued", _bridged(outline, unknown), 0.0)


def _joined(start: tuple[Points, Points], end: tuple[Points, Points], gap: float) -> Points | None:
    """A conic from one tangent to the other; None unless they meet nearby."""
    (p, d), (q, e) = start, end
    matrix = np.stack([d, -e], axis=1)
    if abs(np.linalg.det(matrix)) < 0.02:
        return None
    lengths = np.linalg.solve(matrix, q - p)
    if (lengths <= 0.0).any() or lengths.max() > 1.2 * gap:
        return None
    corner = p + lengths[0] * d
    t = np.linspace(0.0, 1.0, 30)[:, None]
    weights = (1.0 - t) ** 2, 2.0 * CONIC_WEIGHT * t * (1.0 - t), t**2
    return np.asarray((weights[0] * p + weights[1] * corner + weights[2] * q) / sum(weights))


def _carried_on(start: tuple[Points, Points], end: tuple[Points, Points], possible: Mask, lowest_base: float) -> Points:
    """Both tangents extended in parallel and closed by a slightly bent cap; straight across where they diverge."""
    (p, d), (q, e) = start, end
    across = np.stack([p, q])
    length = float(np.linalg.norm(d + e))
    if length < 0.7:
        return across
    ahead = (d + e) / length
    middle = across.mean(axis=0)
    height, width = possible.shape
    steps = np.arange(1, 2 * max(height, width))
    columns, rows = np.floor(middle + steps[:, None] * ahead).astype(int).T
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    inside[inside] = possible[rows[inside], columns[inside]]
    far = float(len(steps) if inside.all() else np.argmin(inside))
    if ahead[1] > 0.5:
        extent = min(far, max(0.0, (lowest_base - float(across[:, 1].max())) / float(ahead[1])))
    else:
        extent = 0.5 * far
    if extent < 1.0:
        return across
    first, second = p + d * (extent / max(0.3, float(d @ ahead))), q + e * (extent / max(0.3, float(e @ ahead)))
    bend = min(extent, 0.09 * float(np.linalg.norm(first - second)))
    t = np.linspace(0.0, 1.0, 20)[:, None]
    cap = first + (second - first) * t + ahead * (bend * (4.0 * t * (1.0 - t) - 1.0))
    return np.concatenate([p[None], cap, q[None]])


def _bridged(outline: Mask, unknown: Mask) -> Mask:
    """``outline`` with, inside each unseen part, the convex hull of its surroundings, unless these have gaps
    themselves."""
    rest = unknown & ~outline
    count, labels = cv2.connectedComponents(rest.astype(np.uint8))
    side = 2 * round(0.2 * float(np.sqrt(outline.sum()))) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    result = outline.copy()
    for index in range(1, count):
        part = labels == index
        near = outline & (cv2.dilate(part.astype(np.uint8), kernel) > 0)
        if part.sum() < 20 or near.sum() < 5:
            continue
        hull = _hull(near)
        told = hull & ~unknown
        if (told & ~outline).sum() <= OPEN * told.sum() or _borne(part, outline):
            result |= hull & unknown
    return result


def _borne(part: Mask, outline: Mask) -> bool:
    """Whether below most columns of ``part`` lies some of ``outline``: a thing that stands on the object hides it."""
    below = np.roll(part, 2, axis=0) & outline
    return bool(below.any(axis=0).sum() > 0.5 * part.any(axis=0).sum())


def known_share(wrong: Mask, seen: Mask, unknown: Mask) -> float:
    """Return the area of ``wrong`` where it is known what shows, in shares of the visible area."""
    return float((wrong & ~unknown).sum() / max(1, int(seen.sum())))


def _hull(mask: Mask) -> Mask:
    return filled_hull(np.argwhere(mask)[:, ::-1].astype(np.float64), mask.shape)


def filled_hull(points: Points, shape: tuple[int, ...]) -> Mask:
    """Return the convex hull of ``points`` (n, 2) as a mask of ``shape``."""
    return _filled_polygon(cv2.convexHull(points.astype(np.float32))[:, 0].astype(np.float64), shape)


def _filled_polygon(polygon: Points, shape: tuple[int, ...]) -> Mask:
    drawn = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(drawn, [np.round(polygon * 16.0).astype(np.int32)], 1, cv2.LINE_8, 4)
    return np.asarray(drawn > 0)


def contour_of(mask: Mask) -> Points:
    """Return the points (n, 2) of the longest outer contour of ``mask`` (h, w), in order."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(max(contours, key=len)[:, 0, :], dtype=np.float64)


def on_own_edge(contour: Points, unknown: Mask) -> Mask:
    """Return which points (n,) of ``contour`` are on the object's own edge: those away from possible occluders."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    near = cv2.dilate(unknown.astype(np.uint8), kernel) > 0
    return np.asarray(~near[contour[:, 1].astype(int), contour[:, 0].astype(int)])


def _cut_runs(own: Mask) -> list[tuple[int, int]]:
    """For each stretch of the contour that is not the object's own edge: indices of the own points before and after
    it."""
    if own.all() or not own.any():
        return []
    count = len(own)
    runs = []
    for first in np.flatnonzero(own & ~np.roll(own, -1)):
        last = int(first) + 1
        while not own[last % count]:
            last += 1
        runs.append((int(first), last % count))
    return runs


def _tangent(contour: Points, own: Mask, index: int, step: int, reach: int) -> tuple[Points, Points] | None:
    """Point ``index`` and the direction (2,) in which the ``reach`` own points behind it approach it."""
    indices = (index + step * np.arange(reach)) % len(contour)
    stop = reach if own[indices].all() else int(np.argmin(own[indices]))
    points = contour[indices[:stop]]
    if len(points) < 3:
        return None
    direction = np.linalg.svd(points - points.mean(axis=0))[2][0]
    if direction @ (points[0] - points[-1]) < 0.0:
        direction = -direction
    return points[0], direction
