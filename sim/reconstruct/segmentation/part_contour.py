# SPDX-License-Identifier: MIT
"""The contour of a part beside a mask: what both share, and the edge and the colours along the rest of it.

Neighbours that complete a plain figure, what fills a bay (``contour_evidence``) and the ends of limbs (``limb_ends``)
are distinguished from ground by the same measurements, each with its own thresholds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.segmentation import felzenszwalb

from ...srgb import cielab
from .box_crop import BoxCrop, is_smoother
from .mask_geometry import Mask, grown, ring_around, shrunk

CREST = 2.5
"""Gradient of an edge, in CIELAB units per pixel, of which a contour is made."""
CLOSED = 0.72
"""Share of a part's own contour that must lie on edges."""
STANDS_OUT = 1.6
"""Least median gradient along its own contour of a part that no figure speaks for, over ``CREST``: shadows of wide
lamps are soft."""
APART = 7.0
"""Least distance of a part's colour from that beyond its contour, CIELAB."""
SHADE_SHARE = 0.5
"""Share of a part or rod that looks like shaded ground above which it is a shadow."""
LEAST_SEEN = 10
"""Pixels of a part, and beyond it, from which their colours are known."""


@dataclass(frozen=True)
class PartContour:
    """What is measured along the contour of ``part`` (h, w) beside a mask; shares are 0 to 1.

    near_mask: (h, w) the mask, and around it what has mixed colours. crest: (h, w) gradients, see ``edge_crest``.
    """

    view: BoxCrop
    part: Mask
    near_mask: Mask
    crest: NDArray[np.float32]

    @cached_property
    def _rim(self) -> Mask:
        return ring_around(self.part, 1)

    @property
    def shared(self) -> float:
        """The share of its contour that it has in common with the mask; the rest is its own."""
        return float((self._rim & self.near_mask).sum()) / max(1.0, float(self._rim.sum()))

    @cached_property
    def own(self) -> Mask:
        """The pixels (h, w) of its own contour."""
        return self._rim & ~self.near_mask

    @property
    def on_edges(self) -> float:
        """The share of its own contour that lies on edges."""
        return float((self.crest[self.own] > CREST).mean())

    @property
    def sharpness(self) -> float:
        """The median gradient along its own contour, over that of an edge."""
        return float(np.median(self.crest[self.own])) / CREST

    @property
    def facing_down(self) -> float:
        """The share of its own contour that lies right below it."""
        below = np.roll(self.part, 1, axis=0)
        below[0] = False
        return float((self.own & below).sum()) / float(self.own.sum())

    @cached_property
    def _colours(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """CIELAB colours (n, 3) inside of it, and beyond its own contour, where no other object is."""
        inner = shrunk(self.part)
        beyond = ring_around(self.part, 5) & ~ring_around(self.part, 2) & ~self.near_mask & ~self.view.others
        return self.view.lab[inner], self.view.lab[beyond]

    @property
    def going_on(self) -> float:
        """The share of what lies beyond its own contour that has its colour; 1 where too little of either is seen."""
        inner, beyond = self._colours
        if min(len(inner), len(beyond)) < LEAST_SEEN:
            return 1.0
        return float((np.linalg.norm(beyond - np.median(inner, axis=0), axis=1) < APART).mean())

    @property
    def is_shade(self) -> bool:
        """Whether it has the colour of what lies beyond its own contour, in the shade."""
        inner, beyond = self._colours
        return is_shade_of(np.median(inner, axis=0), np.median(beyond, axis=0))


def is_shade_of(colour: NDArray[np.floating], ground: NDArray[np.floating]) -> bool:
    """Return whether ``colour`` is that of ``ground``, both CIELAB, in the shade."""
    factor = float((colour[0] + 16.0) / (ground[0] + 16.0))
    hue = float(np.linalg.norm(colour[1:] - factor * ground[1:]))
    return 0.5 < factor < 0.98 and hue < 6.0 + 0.12 * float(np.linalg.norm(ground[1:]))


def shows_ground(view: BoxCrop, part: Mask, mask: Mask) -> bool:
    """Return whether ``part`` (h, w) has the colours of the background at its height, beside ``mask`` (h, w), and is
    not smoother than any of it."""
    size = float(np.sqrt(mask.sum()))
    reach = max(3, round(0.25 * size))
    rows, margin = np.flatnonzero(part.any(axis=1)), round(0.08 * size)
    columns = np.flatnonzero(mask.any(axis=0))
    strip = np.zeros_like(mask)
    strip[max(0, rows[0] - margin) : rows[-1] + 1 + margin, max(0, columns[0] - reach) : columns[-1] + reach] = True
    near = strip & ~grown(mask, 3) & ~view.others
    if near.sum() < 30:
        return False
    outside, own = view.lab[near], view.lab[part]
    outside, own = outside[:: max(1, len(outside) // 500)], own[:: max(1, len(own) // 300)]
    apart = np.linalg.norm(np.median(outside, axis=0) - np.median(own, axis=0))
    alike = bool(apart < 16.0 and (cKDTree(outside).query(own)[0] < 9.0).mean() > 0.7)
    return alike and not is_smoother(cielab(view.pixels)[..., 0], part, near)


def joined_with(mask: Mask, part: Mask) -> Mask:
    """Return both (h, w), with the seam of mixed pixels between them."""
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.morphologyEx((mask | part).astype(np.uint8), cv2.MORPH_CLOSE, kernel, iterations=2) > 0)


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
