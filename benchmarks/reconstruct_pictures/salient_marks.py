# SPDX-License-Identifier: GPL-3.0-or-later
"""Marks in a view of a body: eyes, letters, logos, bows; what a viewer would recognise if it came twice.

It is independent of what the reconstruction itself takes for a mark, which it judges. A mark is a connected blob, whose
colour differs from the body's own wide appearance there, with an edge, and of a size between a freckle and a patch.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from .view_distance import Look, lab_of

Mask = NDArray[np.bool_]

LIGHT_WEIGHT = 0.5
"""Of L*: light and shade count half, since they are baked into textures."""
WINDOW = 1 / 3
"""Side of the wide appearance's window in the body's larger extent."""
RESIDUAL = 12.0
"""Least distance of a mark's pixels from the wide appearance, weighted Delta E."""
DEVIATIONS = 3.5
"""The same in median deviations of the body itself, for those with a strong pattern of their own."""
EDGE = 12.0
"""Least distance of the mean colours of a mark and of the ring around it, weighted Delta E."""
SHARES = (6e-4, 0.2)
"""Of the body's area in the view, least and largest."""
THICK = 1.5
"""Least distance in pixels between a mark's middle and its rim: thinner ones are lines and seams."""
RIM = 4
"""Pixels from the outline that do not count: they are seen at a grazing angle."""


@dataclass(frozen=True, eq=False)
class Marks:
    """labels: (n, n) 0 for none, else 1 to ``count``."""

    labels: NDArray[np.int32]
    count: int


def marks_of(look: Look) -> Marks:
    """Return the marks in a view of a body."""
    inside = look.cover > 0.99
    depth = ndimage.distance_transform_edt(inside)
    area = int(inside.sum())
    empty = np.zeros(inside.shape, dtype=np.int32)
    if area < 100:
        return Marks(empty, 0)
    lab = lab_of(look.pixels) * np.array([LIGHT_WEIGHT, 1.0, 1.0], dtype=np.float32)
    residual = np.linalg.norm(lab - _wide(lab, inside), axis=-1)
    limit = max(RESIDUAL, DEVIATIONS * float(np.median(residual[inside])))
    hot = ndimage.binary_opening((residual > limit) & (depth > RIM))
    labels, _ = ndimage.label(hot)
    kept, number = empty, 0
    for index, window in enumerate(ndimage.find_objects(labels), start=1):
        # A margin for the ring.
        rows, columns = (slice(max(0, s.start - 8), s.stop + 8) for s in window)
        blob = labels[rows, columns] == index
        share = blob.sum() / area
        if not SHARES[0] <= share <= SHARES[1] or ndimage.distance_transform_edt(blob).max() < THICK:
            continue
        ring = ndimage.binary_dilation(blob, iterations=6) & ~ndimage.binary_dilation(blob, iterations=2)
        ring &= inside[rows, columns] & ~hot[rows, columns]
        if ring.sum() < 10:
            continue
        colours = lab[rows, columns]
        if np.linalg.norm(colours[blob].mean(axis=0) - colours[ring].mean(axis=0)) >= EDGE:
            number += 1
            kept[rows, columns][blob] = number
    return Marks(kept, number)


def _wide(lab: NDArray[np.float32], inside: Mask) -> NDArray[np.float32]:
    """(n, n, 3) the median in a wide window, body only: outside lies the nearest colour of the body."""
    nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
    filled = lab[nearest[0], nearest[1]]
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    extent = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    window = min(255, int(extent * WINDOW)) | 1
    low, high = filled.min(axis=(0, 1)), filled.max(axis=(0, 1))
    scale = np.maximum(high - low, 1e-3) / 255.0
    coarse = np.rint((filled - low) / scale).astype(np.uint8)
    return np.asarray(cv2.medianBlur(coarse, max(3, window)) * scale + low, dtype=np.float32)


def unmatched(found: Marks, true: Marks, reach: int) -> int:
    """Return how many of the marks ``found`` lie more than half beyond ``reach`` pixels from those of ``true``."""
    near = ndimage.binary_dilation(true.labels > 0, iterations=reach)
    return sum(float(near[found.labels == index].mean()) < 0.5 for index in range(1, found.count + 1))
