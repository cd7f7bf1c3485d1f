# SPDX-License-Identifier: MIT
"""Contour evidence for a mask made by colours: parts of the ground's tone that belong to it, gaps, thin rods.

Colours cannot tell a book's white spine from a white wall. But the spine has a closed contour of its own, shares a long
border with the cover, and completes it to a plain convex figure; ground does not. Nor does ground in a bay of the
object end at an edge across its mouth, as a wing does that the body wraps. Gaps between slats are ground by colour and
place, and edges surround them; rods are thin, unlike the ground, and join the object.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.segmentation import felzenszwalb

from .mask_cleanup import enclosed_holes, ring_around, touching
from .mask_proposals import (
    GROUND_PARTS,
    OBJECT_PARTS,
    BoxCrop,
    edge_strength,
    graph_cut,
    ground_likelihood,
    learn,
    principal_contrast,
)

Mask = NDArray[np.bool_]

CREST = 2.5
"""Gradient of an edge, in CIELAB units per pixel, of which a contour is made."""
CLOSED = 0.72
"""Share of a part's own contour that must lie on edges."""
SHARED = 0.18
"""Share of a part's contour that it must have in common with the object."""
CONVEX = 0.93
"""Least share of its convex hull that object and part fill together."""
APART = 7.0
"""Least distance of a part's colour from that beyond its contour, CIELAB."""
SHADE_SHARE = 0.5
"""Share of a part or rod that looks like shaded ground above which it is a shadow."""
LEAST_PART, MOST_PART = 0.015, 0.6
"""Area of such a part over the object's."""
BAY, OPEN_BELOW = 0.38, 0.6
"""Share of its contour that a part which fills a bay of the object has in common with it, and the largest share of the
rest that may face the ground: the object's own shadow lies below it."""
FILLED = 0.25
"""Least gain in the share of the convex hull that is filled, over such a part's area over the object's."""
STANDS_OUT = 1.6
"""Least median gradient along such a part's own contour over that of an edge: shadows of wide lamps are soft."""


@dataclass(frozen=True)
class Completed:
    """mask: (h, w) with the parts that contours close. added: (h, w) those parts. doubtful: (h, w) parts that have a
    closed contour and touch the object, but do not complete a plain figure: they may belong to it."""

    mask: Mask
    added: Mask
    doubtful: Mask


def completed_by_contours(view: BoxCrop, mask: Mask, *, shade: Callable[[], Mask] | None = None) -> Completed:
    """Return ``mask`` (h, w) with neighbouring parts that its contours close; see the module.

    shade: returns (h, w) pixels of which no such part consists, as they look like shaded ground; asked once a candidate
    is left. Works on a small copy; cost: a twentieth of a second. To a mask that is far from convex nothing is added
    but what fills its bays.
    """
    nothing = np.zeros_like(mask)
    if mask.sum() < 50:
        return Completed(mask, nothing, nothing)
    regions = thick_regions(view.pixels, max(20, int(0.004 * mask.sum())))
    crest = np.asarray(cv2.dilate(edge_strength(view.lab), np.ones((3, 3), np.uint8)), dtype=np.float32)
    result, doubtful = _with_bays(view, mask, regions, crest), nothing.copy()
    for _ in range(3):
        best: tuple[float, Mask] | None = None
        doubtful = nothing.copy()
        for index in np.unique(regions[ring_around(result, 3) & view.inside]):
            part = (regions == index) & ~result & ~view.others
            # A region that goes on outside of the box is ground.
            if (part & ~view.inside).sum() > 0.03 * max(1, part.sum()):
                continue
            part = part & view.inside
            if not LEAST_PART * mask.sum() <= part.sum() <= MOST_PART * mask.sum():
                continue
            if not _has_contour(view, part, result, crest):
                continue
            if shade is not None and shade()[part].mean() > SHADE_SHARE:
                continue
            solid, before = _solidity(joined_with(result, part)), _solidity(result)
            if solid >= max(CONVEX, before - 0.03):
                value = solid + 0.1 * float(part.sum()) / float(mask.sum())
                best = (value, part) if best is None or value > best[0] else best
            elif part.sum() > 0.04 * mask.sum() and solid > before - 0.1:
                doubtful |= part
        if best is None:
            break
        result = joined_with(result, best[1]) & view.inside
    return Completed(result, result & ~mask, doubtful & ~result)


def thick_regions(pixels: NDArray[np.uint8], least: int) -> NDArray[np.int_]:
    """Return regions (h, w) of even colour of at least ``least`` pixels; seams of mixed colours go to the nearest."""
    regions = np.asarray(felzenszwalb(pixels, scale=60.0, sigma=0.5, min_size=least))
    edge = np.zeros(regions.shape, dtype=np.uint8)
    edge[:, 1:] |= regions[:, 1:] != regions[:, :-1]
    edge[1:] |= regions[1:] != regions[:-1]
    depth = cv2.distanceTransform(1 - edge, cv2.DIST_L2, 3)
    thickest = ndimage.maximum(depth, regions, np.arange(int(regions.max()) + 1))
    thin = np.asarray(thickest)[regions] < 2.5
    if thin.all():
        return regions
    nearest = ndimage.distance_transform_edt(thin, return_distances=False, return_indices=True)
    return np.asarray(regions[tuple(nearest)])


def joined_with(mask: Mask, part: Mask) -> Mask:
    """Return both (h, w), with the seam of mixed pixels between them."""
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.morphologyEx((mask | part).astype(np.uint8), cv2.MORPH_CLOSE, kernel, iterations=2) > 0)


def _has_contour(view: BoxCrop, part: Mask, mask: Mask, crest: NDArray[np.floating]) -> bool:
    """Whether ``part`` shares a long border with ``mask`` and has a contour of its own against everything else."""
    rim = ring_around(part, 1)
    near = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    own = rim & ~near
    if (rim & near).sum() < SHARED * rim.sum() or own.sum() < 0.2 * rim.sum():
        return False
    if (crest[own] > CREST).mean() < CLOSED:
        return False
    inner = cv2.erode(part.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    beyond = ring_around(part, 5) & ~ring_around(part, 2) & ~mask & ~near & ~view.others
    if inner.sum() < 10 or beyond.sum() < 10:
        return False
    colour, outside = np.median(view.lab[inner], axis=0), view.lab[beyond]
    # Beyond every piece of its contour, not on average: ground of its colour would go on somewhere.
    if (np.linalg.norm(outside - colour, axis=1) < APART).mean() > 0.25:
        return False
    return not is_shade_of(colour, np.median(outside, axis=0))


def _with_bays(view: BoxCrop, mask: Mask, regions: NDArray[np.int_], crest: NDArray[np.floating]) -> Mask:
    """``mask`` (h, w) with the parts that fill a bay of it, made of ``regions`` (h, w) without an edge between them."""
    merged = _without_weak_borders(view, mask, regions, crest)
    result = mask
    for index in np.unique(merged[ring_around(mask, 3) & view.inside]):
        part = (merged == index) & ~mask & ~view.others
        if (part & ~view.inside).any() or not LEAST_PART * mask.sum() <= part.sum() <= MOST_PART * mask.sum():
            continue
        gain = (_solidity(joined_with(mask, part)) - _solidity(mask)) * float(mask.sum()) / float(part.sum())
        if gain > FILLED and _in_bay(view, part, mask, crest):
            result = joined_with(result, part) & (view.inside | mask)
    return result


def _without_weak_borders(
    view: BoxCrop, mask: Mask, regions: NDArray[np.int_], crest: NDArray[np.floating]
) -> NDArray[np.int_]:
    """``regions`` (h, w) outside of ``mask`` joined where their colours are alike and no edge lies between them."""
    count = int(regions.max()) + 1
    colours = np.stack([ndimage.median(view.lab[..., i], regions, np.arange(count)) for i in range(3)], axis=-1)
    colours = np.nan_to_num(colours)
    pairs, edges = [], []
    for shift in ((0, 1), (1, 0)):
        near, far = (slice(None, -1), slice(1, None)) if shift[0] else (slice(None), slice(None))
        left, right = (slice(None, -1), slice(1, None)) if shift[1] else (slice(None), slice(None))
        first, second = regions[near, left], regions[far, right]
        border = (first != second) & ~mask[near, left] & ~mask[far, right]
        pairs.append(np.sort(np.column_stack([first[border], second[border]]), axis=1))
        edges.append(np.minimum(crest[near, left], crest[far, right])[border])
    pair, strength = np.concatenate(pairs), np.concatenate(edges)
    if not len(pair):
        return regions
    both, index = np.unique(pair, axis=0, return_inverse=True)
    border_edge = ndimage.median(strength, index.ravel(), np.arange(len(both)))
    alike = np.linalg.norm(colours[both[:, 0]] - colours[both[:, 1]], axis=1) < 2.0 * APART
    joined = both[alike & (np.asarray(border_edge) < CREST)]
    links = sparse.coo_matrix((np.ones(len(joined)), (joined[:, 0], joined[:, 1])), (count, count))
    return np.asarray(connected_components(links, directed=False)[1][regions])


def _in_bay(view: BoxCrop, part: Mask, mask: Mask, crest: NDArray[np.floating]) -> bool:
    """Whether ``part`` fills a bay of ``mask`` and an edge closes it against everything else, above all.

    A grey wing on a yellow body has the colour of grey ground in the shade. But ground that shows in a bay goes on
    beyond it, and a shadow that ends there by chance lies below what casts it.
    """
    rim = ring_around(part, 1)
    near = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    own = rim & ~near
    if (rim & near).sum() < BAY * rim.sum() or own.sum() < 0.2 * rim.sum():
        return False
    if (crest[own] > CREST).mean() < CLOSED or np.median(crest[own]) < STANDS_OUT * CREST:
        return False
    inner = cv2.erode(part.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    beyond = ring_around(part, 5) & ~ring_around(part, 2) & ~mask & ~near & ~view.others
    if inner.sum() < 10 or beyond.sum() < 10:
        return False
    if (np.linalg.norm(view.lab[beyond] - np.median(view.lab[inner], axis=0), axis=1) < APART).mean() > 0.25:
        return False
    above = np.roll(part, 1, axis=0)
    above[0] = False
    if (own & above).sum() > OPEN_BELOW * own.sum():
        return False
    rows, columns = np.nonzero(part)
    box = (int(columns.min()), int(rows.min()), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1)
    return not _shows_ground(view, part, box, mask | part)


def is_shade_of(colour: NDArray[np.floating], ground: NDArray[np.floating]) -> bool:
    """Return whether ``colour`` is that of ``ground``, both CIELAB, in the shade."""
    factor = float((colour[0] + 16.0) / (ground[0] + 16.0))
    hue = float(np.linalg.norm(colour[1:] - factor * ground[1:]))
    return 0.5 < factor < 0.98 and hue < 6.0 + 0.12 * float(np.linalg.norm(ground[1:]))


def _solidity(mask: Mask) -> float:
    hull = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32)), 1)
    return float(mask.sum()) / max(1.0, float(hull.sum()))


FINE = 560
"""Longest side in pixels of the copy on which gaps and rods are searched."""
LONG = 0.12
"""Least length of a gap over the object's size: letters printed on a cover are shorter."""
THIN = 0.05
"""Largest width of a rod over the object's size."""
LEG, UPRIGHT = 0.12, 1.8
"""Largest width of a leg over the object's size, and least height over its width."""
SEAM = 4
"""Pixels between a leg and what it carries, whose colours are mixed."""
UNKNOWN = 3.0
"""Log likelihood of colours that the object has nowhere else, below that of unusual ground: those of legs."""
SOLID, SOLID_SHARE = 0.16, 0.25
"""Width over the object's size from which a part of it is no slat or post, and the share of such parts around a gap
above which it is none: the inside of a cup and a shade on it have the ground's colours, too.
"""


def gaps_and_rods(view: BoxCrop, mask: Mask, *, shade: Callable[[], Mask] | None = None) -> tuple[Mask, Mask]:
    """Return gaps (h, w) in the filled ``mask`` through which the ground shows, and rods (h, w) beside it.

    Both models of colour are learned with the gaps left out of the object, and the cut has little smoothness, so that
    it follows slats and spokes. A gap is typical ground by colour, texture and place, long, and surrounded by edges;
    a rod is unlike the ground, lit or shaded, thin, on edges, and joined to the object. shade: returns (h, w) pixels of
    which no rod consists, as they look like shaded ground; asked once a candidate is left.
    """
    nothing = np.zeros_like(mask)
    size = float(np.sqrt(mask.sum()))
    if mask.sum() < 400 or view.outside.sum() < 200:
        return nothing, nothing
    window = view.inside | mask
    beyond = view.outside
    usual = float(np.quantile(ground_likelihood(view, beyond, beyond, ()), 0.08))
    ground = np.full(mask.shape, -np.inf, dtype=np.float32)
    ground[window] = ground_likelihood(view, beyond, window)
    typical = window & (ground > usual)
    own_pixels = mask & ~typical
    if own_pixels.sum() < 0.12 * mask.sum() or own_pixels.sum() < 60:
        # Nearly all of it looks like ground: what is a gap cannot be told from camouflage.
        return nothing, nothing
    features = np.dstack([view.lab, view.texture])
    likely = learn(features[own_pixels], OBJECT_PARTS + GROUND_PARTS - 5).log_likelihood(features[window])
    ratio = np.zeros(mask.shape, dtype=np.float32)
    ratio[window] = np.clip(likely - ground[window], -4.0, 4.0)
    cut = graph_cut(ratio, principal_contrast(view.lab), 1.0, barred=~window)
    crest = np.asarray(cv2.dilate(edge_strength(view.lab), np.ones((3, 3), np.uint8)), dtype=np.float32)
    rods = nothing.copy()
    candidates = []
    core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    for part, box in _parts((mask | enclosed_holes(mask)) & ~cut, 24):
        length = float(np.hypot(box[2], box[3]))
        if length < LONG * size or (ground[part] > usual).mean() < 0.4 or (ratio[part] < -0.5).mean() < 0.7:
            continue
        rim = ring_around(part, 1) & core
        if (rim.any() and (crest[rim] > CREST).mean() < 0.6) or not _shows_ground(view, part, box, mask):
            continue
        candidates.append(part)
    gaps = _between_slats(mask, candidates, size)
    for part, box in _parts(cut & ~mask & view.inside, 16):
        length = float(np.hypot(box[2], box[3]))
        inwards = cv2.distanceTransform(np.pad(part, 1).astype(np.uint8), cv2.DIST_L2, 3)
        if 2.0 * float(inwards.max()) > THIN * size + 3.0 or length < 0.06 * size:
            continue
        rim = ring_around(part, 1) & ~mask
        joined = (cv2.dilate(part.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0) & mask
        if not joined.any() or not rim.any() or (crest[rim] > CREST).mean() < 0.6 or (ratio[part] > 1.0).mean() < 0.6:
            continue
        if shade is not None and shade()[part].mean() > SHADE_SHARE:
            continue
        rods |= part
    legs = _legs(view, mask, (usual - UNKNOWN) - ground, crest)
    if shade is not None and legs:
        # Where a leg's colours and the ground's are mixed, they look like shade.
        legs = [part for part in legs if shade()[_core(part)].mean() < SHADE_SHARE]
    rods = np.logical_or.reduce([rods, *legs])
    if gaps.sum() > 0.8 * mask.sum():
        return nothing, rods
    # What only a gap's edge held in place goes with it.
    return gaps, rods & touching(rods | (mask & ~gaps), mask & ~gaps)


def _legs(view: BoxCrop, mask: Mask, unlike: NDArray[np.floating], crest: NDArray[np.floating]) -> list[Mask]:
    """Return parts (h, w) below the object ``mask`` that carry it: thin, upright, on edges, of any colour but the
    ground's. Chairs of cloth have legs of wood.

    unlike: (h, w) log likelihood ratio of a colour that is nowhere else, over the ground. crest: (h, w) gradient.
    """
    size = float(np.sqrt(mask.sum()))
    window = view.inside | mask
    ratio = np.where(window, np.clip(unlike, -4.0, 4.0), 0.0).astype(np.float32)
    cut = graph_cut(ratio, principal_contrast(view.lab), 1.0, barred=~window)
    free = cut & view.inside & ~ring_around(mask, 1) & ~mask
    result = []
    for part, (_, top, _, height) in _parts(free, 16):
        width = 2.0 * float(cv2.distanceTransform(np.pad(part, 1).astype(np.uint8), cv2.DIST_L2, 3).max())
        if not (height > UPRIGHT * width and height > 0.06 * size and width < LEG * size):
            continue
        joint = np.flatnonzero((ring_around(part, SEAM) & mask).any(axis=1))
        rim = ring_around(part, 1) & ~mask
        hangs = len(joint) > 0 and joint[-1] < top + 0.25 * height
        if hangs and rim.any() and (crest[rim] > CREST).mean() > 0.6:
            # With the mixed pixels between them.
            seam = ring_around(part, SEAM) & ring_around(mask, SEAM) & view.inside & part.any(axis=0)
            result.append(part | seam)
    return result


def _core(part: Mask) -> Mask:
    """``part`` without its outermost pixels, unless nothing would be left."""
    inner = cv2.erode(part.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    return inner if inner.any() else part


def _between_slats(mask: Mask, candidates: Sequence[Mask], size: float) -> Mask:
    """Return those of ``candidates`` (h, w), joined, around which the object ``mask`` of ``size`` pixels is thin."""
    gaps = np.zeros_like(mask)
    if not candidates:
        return gaps
    solid = mask & ~np.logical_or.reduce(candidates)
    width = max(3, round(SOLID * size))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    thick = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_OPEN, disc) > 0
    for part in candidates:
        beside = ring_around(part, max(2, width // 4)) & solid
        if beside.any() and thick[beside].mean() <= SOLID_SHARE:
            gaps |= part
    return gaps


def _shows_ground(view: BoxCrop, part: Mask, box: tuple[int, int, int, int], mask: Mask) -> bool:
    """Whether the colours of ``part`` are those of the background left and right of the object at its height."""
    size = float(np.sqrt(mask.sum()))
    reach = max(3, round(0.25 * size))
    top, bottom = max(0, box[1] - round(0.08 * size)), box[1] + box[3] + round(0.08 * size)
    columns = np.flatnonzero(mask.any(axis=0))
    strip = np.zeros_like(mask)
    strip[top:bottom, max(0, columns[0] - reach) : columns[-1] + reach] = True
    near = strip & ~(cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0) & ~view.others
    if near.sum() < 30:
        return False
    outside, own = view.lab[near], view.lab[part]
    outside, own = outside[:: max(1, len(outside) // 500)], own[:: max(1, len(own) // 300)]
    apart = np.linalg.norm(np.median(outside, axis=0) - np.median(own, axis=0))
    return bool(apart < 16.0 and (cKDTree(outside).query(own)[0] < 9.0).mean() > 0.7)


def _parts(mask: Mask, least: int) -> list[tuple[Mask, tuple[int, int, int, int]]]:
    """The connected parts of at least ``least`` pixels, each with left, top, width and height."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return [
        (labels == index, (int(stats[index, 0]), int(stats[index, 1]), int(stats[index, 2]), int(stats[index, 3])))
        for index in range(1, count)
        if stats[index, cv2.CC_STAT_AREA] >= least
    ]
