# SPDX-License-Identifier: MIT
"""Ground that shows an object's colour: light that a saturated object throws on pale ground beside it.

Ground reflects what reaches it, directly and by way of the object (interreflection: Funt, Drew & Ho, "Color constancy
from mutual reflection", International Journal of Computer Vision 6, 1991). Over the lit ground around it, channel by
channel, its linear light is s + k c: s the share of the direct light, c the object's colour, its largest channel 1, and
k what the object adds. The share k fades with the distance, so such a patch ends in no edge where it borders on ground,
but at the object it does.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .box_crop import EDGE, BoxCrop, edge_crest, edge_strength
from .ground_shade import LOCAL, SPECK, lit_ground, log_light
from .mask_geometry import Mask, grown

Light = NDArray[np.float32]

SATURATED = 1.0
"""Difference of a channel's logarithm from their mean, over the ground's, from which a pixel has the object's own
colour: e times as much or as little of one channel."""
LEAST_SATURATED = 0.2
"""Share of such pixels of a mask from which it has a colour to throw."""
LEAST_TINT = 0.05
"""Least k: a tint that is seen."""
OPEN = 0.3
"""Share of a patch on which k is below s: where the object does not shut out the direct light, it adds less than that,
as a wall fills half of the sky of the ground beside it."""
NOISE = 0.2
"""Largest difference of a channel from s + k c, as a natural logarithm."""
INNER_EDGE, WEAKER, FADED = 0.6, 0.9, 0.75
"""Share of a patch's rim at the object that lies on edges of ``EDGE``; gradient and k along its rim at the ground over
those at the object, medians, below which it fades: 0.2 to 0.8 and 0.4 to 0.7 were measured beside a clock on a sheet,
1.0 and more of parts of 60 drawn things."""


def tinted_ground(view: BoxCrop, mask: Mask) -> Mask:
    """Return the pixels (h, w) of ``mask`` (h, w) that are ground in the light that the object throws: patches along
    its outline that fade into the ground beside them, and that an edge parts from the object.

    None where the object has no colour of its own. What the user keeps is none.
    """
    nothing = np.zeros_like(mask)
    tint = _tint(view, mask)
    if tint is None:
        return nothing
    direct, added, seen = tint
    # Mixed colours along an outline are tinted, too: two pixels wide.
    tinted = seen & mask & ~view.keep
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    wide = cv2.morphologyEx(tinted.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    crest = edge_crest(edge_strength(view.lab))
    count, labels = cv2.connectedComponents((grown(wide, 2) & tinted).astype(np.uint8), connectivity=4)
    result = nothing
    for index in range(1, count):
        patch = labels == index
        if (added < direct)[patch].mean() < OPEN:
            continue
        rim = grown(patch) & ~patch
        inner, outer = rim & mask, rim & ~mask
        if patch.sum() < SPECK or not outer.any() or not inner.any() or (crest[inner] > EDGE).mean() < INNER_EDGE:
            continue
        fainter = np.median(crest[outer]) < WEAKER * np.median(crest[inner])
        if fainter and _share_along(added, patch, outer) < FADED * _share_along(added, patch, inner):
            result = result | patch
    return result


def _tint(view: BoxCrop, mask: Mask) -> tuple[Light, Light, Mask] | None:
    """The direct and the added light, s and k (h, w), and where they are those of tinted ground; None where ``mask``
    (h, w) has no colour to throw."""
    free = ~grown(mask, 2) & ~view.others
    if mask.sum() < 200 or not free.any():
        return None
    size = float(np.sqrt(mask.sum()))
    light = log_light(view.pixels)
    over = light - lit_ground(light, free, LOCAL * size)
    own = mask & (np.abs(over - over.mean(axis=2, keepdims=True)).max(axis=2) > SATURATED)
    if own.sum() < LEAST_SATURATED * mask.sum():
        return None
    colour = _mean_around(np.exp(light), own, LOCAL * size)
    # Farther away than the mean reaches there is none.
    colour /= np.maximum(colour.max(axis=2, keepdims=True), 1e-30)
    direct, added = _shares(np.exp(over), colour)
    fitted = np.maximum(direct[..., None] + added[..., None] * colour, 1e-3)
    apart = np.abs(np.log(fitted) - over).max(axis=2)
    return direct, added, np.asarray((apart < NOISE) & (added > LEAST_TINT) & (direct > 0.0) & ~own & ~view.others)


def _share_along(added: Light, patch: Mask, rim: Mask) -> float:
    """Median of ``added`` in ``patch`` within three pixels of its ``rim``, all (h, w)."""
    return float(np.median(added[patch & grown(rim, 3)]))


def _mean_around(values: Light, where: Mask, sigma: float) -> Light:
    """Mean (h, w, 3) of ``values`` at the pixels ``where`` (h, w), the nearer the more."""
    weight = where.astype(np.float32)
    total, mean = np.full(where.shape, 1e-12, dtype=np.float32), np.zeros_like(values)
    # Far from the object its mean colour counts.
    for share, width in ((1.0, sigma), (1e-6, 8.0 * sigma)):
        total += share * cv2.GaussianBlur(weight, (0, 0), width)
        mean += share * cv2.GaussianBlur(values * weight[..., None], (0, 0), width)
    return np.asarray(mean / total[..., None], dtype=np.float32)


def _shares(ratio: Light, colour: Light) -> tuple[Light, Light]:
    """Direct and added light, s and k (h, w), whose s + k ``colour`` (h, w, 3) is nearest ``ratio`` (h, w, 3)."""
    sums, squares = colour.sum(axis=2), np.square(colour).sum(axis=2)
    level, along = ratio.sum(axis=2), (ratio * colour).sum(axis=2)
    determinant = np.maximum(3.0 * squares - sums**2, 1e-6)
    direct = (squares * level - sums * along) / determinant
    added = (3.0 * along - sums * level) / determinant
    return np.asarray(direct, dtype=np.float32), np.asarray(added, dtype=np.float32)
