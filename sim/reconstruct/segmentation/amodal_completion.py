# SPDX-License-Identifier: MIT
"""Amodal completion: whole masks of partly hidden objects, and colours for the hidden parts.

The hidden part is guessed by several rules: an ellipse, mirror and point symmetry, continued tangents, legs. A guess is
scored by how well its rule explains the visible outline, and by whether it needs a coincidence: an object's true
outline seldom runs along that of the thing in front of it (the generic view: Freeman, Nature 1994).

Masks are small copies (h, w): ``seen`` the visible part, ``unknown`` where the object may continue; the rest is known
to show something behind it. Points are x, y in pixels of that copy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...errors import InputError
from .hidden_legs import with_hidden_legs
from .mask_geometry import Mask, grown

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
    contour = _contour(seen)
    own = contour[_own(contour, unknown)]
    if len(own) < 12:
        return None
    (x, y), (width, height), turn = cv2.fitEllipseDirect(own.astype(np.float32))
    if not np.isfinite([x, y, width, height, turn]).all() or min(width, height) < 2.0:
        return None
    if max(width, height) > 2.0 * max(seen.shape):
        return None
    drawn = np.zeros(seen.shape, dtype=np.uint8)
    cv2.ellipse(drawn, ((x, y), (width, height), turn), 1, -1)
    return OutlineGuess("ellipse", drawn > 0, _share((drawn > 0) ^ seen, seen, unknown))


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
    return OutlineGuess("mirrored", _bridged(outline, unknown), _share(image & ~seen, seen, unknown))


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
    misfit = _share(image & ~seen, seen, unknown) + _share(_hull(seen) & ~seen, seen, unknown)
    return OutlineGuess("point_mirrored", hull, misfit)


def continued(seen: Mask, unknown: Mask, lowest_base: float) -> OutlineGuess:
    """Continue the outline from where it disappears to where it reappears.

    Tangents that meet are joined by a conic. Parallel ones, such as the walls of a bottle whose foot is hidden, are
    extended: down to the row ``lowest_base``, sideways half as far as the object could reach unseen.
    """
    contour = _contour(seen)
    own = _own(contour, unknown)
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


def _share(wrong: Mask, seen: Mask, unknown: Mask) -> float:
    return float((wrong & ~unknown).sum() / max(1, int(seen.sum())))


def _hull(mask: Mask) -> Mask:
    points = np.argwhere(mask)[:, ::-1].astype(np.float32)
    return _filled_polygon(cv2.convexHull(points)[:, 0].astype(np.float64), mask.shape)


def _filled_polygon(polygon: Points, shape: tuple[int, ...]) -> Mask:
    drawn = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(drawn, [np.round(polygon * 16.0).astype(np.int32)], 1, cv2.LINE_8, 4)
    return np.asarray(drawn > 0)


def _contour(mask: Mask) -> Points:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(max(contours, key=len)[:, 0, :], dtype=np.float64)


def _own(contour: Points, unknown: Mask) -> Mask:
    """Points (bool) of ``contour`` on the object's own edge: those away from possible occluders."""
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


GUESS_SIDE = 112
"""Pixels of the visible part's longer side in the copy on which guesses are made."""
ROOM = 1.0
"""Margin in that copy over the longer side: no hidden part is assumed to reach farther."""
COINCIDENCE = 0.1
"""Cost of an outline that follows the occluder's border everywhere, in shares of the visible area."""
PREFERENCE = {
    "ellipse": -0.03,
    "legs": 0.0,
    "mirrored": 0.02,
    "point_mirrored": 0.03,
    "seen_again": 0.03,
    "continued": 0.06,
}
"""Cost of each rule at equal fit, in shares of the visible area; tuned on drawn solids in front of others."""


def complete_outline(mask: Mask, hidden_by: Mask, *, seen_again: Mask | None = None) -> Mask:
    """Return the whole mask (H, W) of the object whose visible part is ``mask``.

    hidden_by: (H, W) pixels of the objects in front of it. seen_again: (H, W) the object as segmented in the picture
    without them (paper A.1); one more guess. The result contains ``mask`` and, beyond it, only pixels of ``hidden_by``;
    it equals ``mask`` where nothing in front touches the object.
    """
    in_front = hidden_by & ~mask
    if not mask.any() or not in_front.any():
        return mask.copy()
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    side = max(int(np.ptp(rows)), int(np.ptp(columns))) + 1
    room = int(np.ceil(ROOM * side))
    window = (int(rows[0]) - room, int(rows[-1]) + 1 + room, int(columns[0]) - room, int(columns[-1]) + 1 + room)
    scale = GUESS_SIDE / side
    seen = _copy(mask, window, scale, outside=False)
    # Beyond the picture everything is unknown as well.
    unknown = _copy(in_front, window, scale, outside=True) & ~seen
    # Two masks segmented one after the other leave a seam of a few pixels.
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    closed = cv2.morphologyEx((seen | unknown).astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    beside = cv2.dilate(seen.astype(np.uint8), kernel) > 0
    unknown = (unknown | (closed & beside)) & ~seen
    if not (unknown & beside).any():
        return mask.copy()
    guesses = _guesses(seen, unknown, _lowest_base(in_front, window, scale))
    if seen_again is not None:
        again = _copy(seen_again, window, scale, outside=False)
        guesses.append(OutlineGuess("seen_again", again, _misfit(again, seen, unknown)))
    costs = [
        guess.misfit + PREFERENCE[guess.rule] + COINCIDENCE * _coincidence(guess.outline | seen, seen, unknown)
        for guess in guesses
    ]
    best = (guesses[int(np.argmin(costs))].outline | seen) & (seen | unknown)
    return mask | (_at_full_size(best, mask.shape, window, scale) & in_front)


def _guesses(seen: Mask, unknown: Mask, lowest_base: float) -> list[OutlineGuess]:
    guesses = [continued(seen, unknown, lowest_base)]
    standing = with_hidden_legs(seen, unknown, lowest_base)
    if standing is not None:
        guesses.append(OutlineGuess("legs", standing, 0.0))
    for rule in (ellipse, mirrored, point_mirrored):
        guess = rule(seen, unknown)
        if guess is not None:
            guesses.append(guess)
    return guesses


def _misfit(outline: Mask, seen: Mask, unknown: Mask) -> float:
    return float(((outline ^ seen) & ~unknown).sum() / max(1, int(seen.sum())))


def _coincidence(outline: Mask, seen: Mask, unknown: Mask) -> float:
    """Share of the border between ``seen`` and ``unknown`` that ``outline`` makes the object's own edge."""
    border = seen & grown(unknown)
    if not border.any():
        return 0.0
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    inside = cv2.erode(outline.astype(np.uint8), kernel, borderValue=0) > 0
    return float((border & ~inside).sum() / border.sum())


def _lowest_base(in_front: Mask, window: tuple[int, int, int, int], scale: float) -> float:
    """Lowest row, in the copy, of the base of an object hidden by ``in_front``.

    An occluder covers about as much ground in depth as it is wide. Seen from 20 to 30 degrees above, an object behind
    it stands about half its width higher in the picture.
    """
    top, bottom, left, right = window
    height, width = in_front.shape
    inside = in_front[max(0, top) : min(height, bottom), max(0, left) : min(width, right)]
    columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(in_front.any(axis=1))
    if len(columns) == 0:
        return float("inf")
    return (float(rows[-1]) - 0.45 * float(np.ptp(columns)) - top) * scale


def _copy(mask: Mask, window: tuple[int, int, int, int], scale: float, *, outside: bool) -> Mask:
    """The ``window`` (top, bottom, left, right) of ``mask`` at ``scale``; ``outside`` is its value beyond the
    picture."""
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


COLOUR_SIDE = 200.0
"""Largest side in pixels at which hidden colours are inpainted; larger objects are scaled down."""
ENOUGH = 400
"""Visible pixels at that scale, below which the nearest colour is used instead of patches."""
SEAM = 2
"""Pixels along the visible part's edge that are mixed with the neighbour's colour, and are not a source."""


def complete_colours(
    pixels: NDArray[np.uint8], mask: Mask, full: Mask, *, radius: int = 3, seed: int = 0
) -> NDArray[np.uint8]:
    """Return ``pixels`` (H, W, 3) with the hidden part, ``full`` without ``mask``, in the object's own colours.

    mask: (H, W) visible pixels of the object; full: (H, W) its whole mask. All sources are pixels of ``mask``, never of
    the occluder or the surroundings. PatchMatch (Barnes et al., SIGGRAPH 2009) with patches of (2 radius + 1)² pixels;
    the nearest colour where too little is visible. Raises InputError for an empty mask, or when the native library is
    missing.
    """
    hidden = full & ~mask
    if not hidden.any():
        return pixels.copy()
    if not mask.any():
        raise InputError("complete_colours: the mask is empty; give the visible pixels of the object")
    rows, columns = (np.flatnonzero((mask | hidden).any(axis=axis)) for axis in (1, 0))
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    crop, own, missing = pixels[window], mask[window], hidden[window]
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SEAM + 1, 2 * SEAM + 1))
    core = cv2.erode(own.astype(np.uint8), disc, borderValue=0) > 0
    source = core if core.sum() > 0.3 * own.sum() else own
    filled = _filled_colours(crop, source, radius, seed)
    result = pixels.copy()
    result[window] = np.where(missing[..., None], filled, crop)
    return result


def _filled_colours(crop: NDArray[np.uint8], source: Mask, radius: int, seed: int) -> NDArray[np.uint8]:
    """``crop`` (h, w, 3) with everything but ``source`` filled from ``source``."""
    height, width = source.shape
    scale = min(1.0, COLOUR_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    weight = cv2.resize(source.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    # Average over source pixels only, or downscaling would mix in the neighbours' colours.
    total = cv2.resize(crop * source[..., None].astype(np.float32), size, interpolation=cv2.INTER_AREA)
    small = np.clip(total / np.maximum(weight, 1e-6)[..., None] + 0.5, 0, 255).astype(np.uint8)
    known = weight > 0.5
    if not known.any():
        known = weight > 0.0
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    plain = small[nearest[0], nearest[1]]
    if known.sum() < ENOUGH or known.mean() < 0.05 or min(size) < 4 * radius:
        filled = np.where(known[..., None], plain, cv2.GaussianBlur(plain, (0, 0), 2.0))
    else:
        filled = _patch_match(plain, ~known, radius, seed)
    return np.asarray(cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def _patch_match(pixels: NDArray[np.uint8], hole: Mask, radius: int, seed: int) -> NDArray[np.uint8]:
    if not hole.any():
        return pixels
    # Imported late: importing the package must not load a native library.
    from patchmatch import patch_match

    if not getattr(patch_match, "patchmatch_available", False):
        raise InputError("the inpainting library pypatchmatch cannot be loaded; install it again for this Python")
    patch_match.set_random_seed(seed)
    try:
        return np.asarray(patch_match.inpaint(np.ascontiguousarray(pixels), hole.astype(np.uint8), patch_size=radius))
    except RuntimeError:
        # Too few patches: keep the nearest colours.
        return pixels
