# SPDX-License-Identifier: MIT
"""A mask cut out of the photo, with the signed distance to its outline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .inflate import OUTSET, signed_distance

Mask = NDArray[np.bool_]
Field = NDArray[np.float64]


@dataclass(frozen=True)
class Crop:
    """One object's outline.

    mask: (h, w); photo: (h, w) what lies in the photo; distance: (h, w) pixels to the outline, positive inside, with
    ``outset`` added.

    left, top: photo pixels of the first pixel's corner; may be negative. outset: how far the body reaches beyond.
    """

    mask: Mask
    photo: Mask
    distance: Field
    left: int
    top: int
    outset: float

    def pixels(self) -> Field:
        """(h w, 2) photo pixels of all pixel centres, row by row."""
        height, width = self.mask.shape
        rows, columns = np.mgrid[:height, :width]
        return np.stack([self.left + columns + 0.5, self.top + rows + 0.5], axis=-1).reshape(-1, 2)


def crop_of(mask: Mask) -> Crop:
    """The part of ``mask`` (H, W), not empty, that holds the object, and a border of background around it."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    pad = 8 + round(0.08 * max(np.ptp(rows), np.ptp(columns)))
    padded = np.pad(mask, pad)
    window = (slice(rows[0], rows[-1] + 1 + 2 * pad), slice(columns[0], columns[-1] + 1 + 2 * pad))
    part = padded[window]
    outset = OUTSET * max(mask.shape)
    photo = np.pad(np.ones(mask.shape, dtype=bool), pad)[window]
    return Crop(part, photo, signed_distance(part) + outset, int(columns[0]) - pad, int(rows[0]) - pad, outset)
