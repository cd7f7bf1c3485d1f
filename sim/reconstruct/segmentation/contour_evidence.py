# SPDX-License-Identifier: MIT
"""Contour evidence for a mask made by colours: parts of the ground's tone that belong to it.

Colours cannot tell a book's white spine from a white wall. But the spine has a closed contour of its own, shares a long
border with the cover, and completes it to a plain convex figure; ground does not. Nor does ground in a bay of the
object end at an edge across its mouth, as a wing does that the body wraps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components

from .box_crop import BoxCrop, edge_crest, edge_strength
from .mask_geometry import Mask, grown, ring_around, solidity_of
from .part_contour import (
    APART,
    CLOSED,
    CREST,
    SHADE_SHARE,
    STANDS_OUT,
    PartContour,
    joined_with,
    shows_ground,
    thick_regions,
)

SEAM = 2
"""Pixels around a mask on this copy in which its colours and others are mixed."""
SHARED, MOST_SHARED = 0.18, 0.8
"""Share of its contour that a part which completes a plain figure has in common with the mask at least; and any part at
most."""
SAME_BEYOND = 0.25
"""Largest share of what lies beyond a part's contour that has its colour: beyond every piece of it, not on average, as
ground of its colour would go on somewhere."""
CONVEX = 0.93
"""Least share of its convex hull that object and part fill together."""
LEAST_PART, MOST_PART = 0.015, 0.6
"""Area of such a part over the object's."""
BAY, OPEN_BELOW = 0.38, 0.6
"""Least share of its contour that a part which fills a bay of the object has in common with it; and the largest share
of the rest that may face the ground: the object's own shadow lies below it."""
FILLED = 0.25
"""Least gain in the share of the convex hull that is filled, over such a part's area over the object's."""


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
    crest = edge_crest(edge_strength(view.lab))
    result, doubtful = _with_bays(view, _with_bays(view, mask, regions, crest), regions, crest), nothing.copy()
    for _ in range(3):
        best: tuple[float, Mask] | None = None
        doubtful, near = nothing.copy(), grown(result, SEAM)
        for index in np.unique(regions[ring_around(result, 3) & view.inside]):
            part = (regions == index) & ~result & ~view.others
            # A region that goes on outside of the box is ground.
            if (part & ~view.inside).sum() > 0.03 * max(1, part.sum()):
                continue
            part = part & view.inside
            if not LEAST_PART * mask.sum() <= part.sum() <= MOST_PART * mask.sum():
                continue
            if not _closes(PartContour(view, part, near, crest)):
                continue
            if shade is not None and shade()[part].mean() > SHADE_SHARE:
                continue
            solid, before = solidity_of(joined_with(result, part)), solidity_of(result)
            if solid >= max(CONVEX, before - 0.03):
                value = solid + 0.1 * float(part.sum()) / float(mask.sum())
                best = (value, part) if best is None or value > best[0] else best
            elif part.sum() > 0.04 * mask.sum() and solid > before - 0.1:
                doubtful |= part
        if best is None:
            break
        result = joined_with(result, best[1]) & view.inside
    return Completed(result, result & ~mask, doubtful & ~result)


def _closes(contour: PartContour) -> bool:
    """Whether the part shares a long border with the mask and has a contour of its own against everything else."""
    return (
        SHARED <= contour.shared <= MOST_SHARED
        and contour.on_edges >= CLOSED
        and contour.going_on <= SAME_BEYOND
        and not contour.is_shade
    )


def _with_bays(view: BoxCrop, mask: Mask, regions: NDArray[np.int_], crest: NDArray[np.float32]) -> Mask:
    """``mask`` (h, w) with the parts that fill a bay of it, made of ``regions`` (h, w) without an edge between them."""
    merged = _without_weak_borders(view, mask, regions, crest)
    result, near = mask, grown(mask, SEAM)
    for index in np.unique(merged[ring_around(mask, 3) & view.inside]):
        part = (merged == index) & ~mask & ~view.others
        if (part & ~view.inside).any() or not LEAST_PART * mask.sum() <= part.sum() <= MOST_PART * mask.sum():
            continue
        gain = (solidity_of(joined_with(mask, part)) - solidity_of(mask)) * float(mask.sum()) / float(part.sum())
        if gain > FILLED and _fills_bay(PartContour(view, part, near, crest), mask):
            result = joined_with(result, part) & (view.inside | mask)
    return result


def _without_weak_borders(
    view: BoxCrop, mask: Mask, regions: NDArray[np.int_], crest: NDArray[np.float32]
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


def _fills_bay(contour: PartContour, mask: Mask) -> bool:
    """Whether the part fills a bay of ``mask`` and an edge closes it against everything else, above all.

    A grey wing on a yellow body has the colour of grey ground in the shade. But ground that shows in a bay goes on
    beyond it, and a shadow that ends there by chance lies below what casts it.
    """
    return (
        BAY <= contour.shared <= MOST_SHARED
        and contour.on_edges >= CLOSED
        and contour.sharpness >= STANDS_OUT
        and contour.going_on <= SAME_BEYOND
        and contour.facing_down <= OPEN_BELOW
        and not shows_ground(contour.view, contour.part, mask | contour.part)
    )
