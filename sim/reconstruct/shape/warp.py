# SPDX-License-Identifier: MIT
"""Bend a fitted primitive in the photo's plane so that its outline is the object's, and find what it leaves out.

A real can is dented and a real camera not quite where it was thought to be: outlines differ by a few pixels. Where the
two outlines run alongside, the primitive is shifted across them, less and less towards its inside. What reaches
out farther, as a handle does, is a part of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from .crop import Crop
from .inflate import signed_distance

Mask = NDArray[np.bool_]
Field = NDArray[np.float64]

FARTHEST = (3.0, 0.07)
"""Outlines farther apart than this are not the same edge: pixels, and share of the object's size; the larger one."""
ALONGSIDE = 0.75
"""Cosine of the angle between two outlines that may be the same edge."""
FADE = 0.6
"""Depth under the outline at which nothing is shifted any more, over the widest inscribed circle."""
SMOOTH = 0.02
"""Detail of the bend along the outline over the object's size: finer is the masks' noise."""
PART = (2.5, 0.02)
"""What reaches out less than this is no part: pixels, and share of the object's size; the larger one."""
REACH = 1.5
"""How far parts go on inside the primitive, over the radius of their widest inscribed circle."""
SMALLEST_PART = 0.002
"""Area over the object's."""


@dataclass(frozen=True)
class Fitting:
    """How a primitive's outline becomes the object's, on a crop.

    shift: (h, w, 2) pixels x, y to add to a pixel of the object for its place on the primitive.
    parts: (h, w) what the primitive leaves out, each reaching a little into it; all False without any.
    fade: (h, w) 1 outside the primitive, falling to 0 as far inside as the parts reach.
    """

    shift: Field
    parts: Mask
    fade: Field


def fitting(crop: Crop, primitive: Mask) -> Fitting:
    """How ``primitive`` (h, w), a fitted outline on the crop, becomes the crop's own."""
    mask = crop.mask
    size = float(np.sqrt(mask.sum()))
    own = signed_distance(primitive)
    towards = _gradient(ndimage.gaussian_filter(own, 1.0))
    rim = mask & ~ndimage.binary_erosion(mask)
    apart = crop.distance - own
    farthest = max(FARTHEST[0], FARTHEST[1] * size)
    alongside = (towards * _gradient(ndimage.gaussian_filter(crop.distance, 1.0))).sum(axis=0) > ALONGSIDE
    # At the photo's border it is the photo that ends.
    rim &= ndimage.binary_erosion(crop.photo, iterations=2)
    good = rim & (np.abs(apart) <= farthest) & alongside
    outward = np.zeros(mask.shape)
    if good.any():
        nearest = ndimage.distance_transform_edt(~good, return_distances=False, return_indices=True)
        outward = ndimage.gaussian_filter(apart[tuple(nearest)], max(1.5, SMOOTH * size))
    weight = np.clip(1.0 - own / max(FADE * float(own.max()), 1e-9), 0.0, 1.0)
    shift = np.moveaxis(towards * (outward * weight * weight * (3.0 - 2.0 * weight)), 0, -1)
    parts, reach = _parts(mask, own + outward, size)
    return Fitting(shift=shift, parts=parts, fade=np.clip(1.0 - (own + outward) / reach, 0.0, 1.0))


def _gradient(field: Field) -> Field:
    """Unit gradient (2, h, w), x and y."""
    rows, columns = np.gradient(field)
    length = np.maximum(np.hypot(rows, columns), 1e-6)
    return np.stack([columns / length, rows / length])


def _parts(mask: Mask, warped: Field, size: float) -> tuple[Mask, float]:
    """What of ``mask`` reaches out of the body whose distance, after the shift, is ``warped``; how far it goes in."""
    least = max(PART[0], PART[1] * size)
    beyond = mask & (warped < -0.5)
    labels, count = ndimage.label(beyond, np.ones((3, 3)))
    if not count:
        return np.zeros_like(mask), 1.0
    index = np.arange(1, count + 1)
    reach = -ndimage.minimum(warped, labels, index)
    area = ndimage.sum_labels(beyond, labels, index)
    keep = index[(reach > least) & (area > SMALLEST_PART * mask.sum())]
    if not len(keep):
        return np.zeros_like(mask), 1.0
    part = np.isin(labels, keep)
    inscribed = float(ndimage.distance_transform_edt(part).max())
    # Reaching in as far as the part is wide, so that it does not thin out where it is joined.
    reach = REACH * inscribed + 2.0
    inward = ndimage.distance_transform_edt(~part) <= reach
    return np.asarray(part | (mask & inward & (warped > -0.5))), reach
