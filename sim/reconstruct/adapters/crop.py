# SPDX-License-Identifier: MIT
"""The picture of one object that models from image to mesh take: square, centred, without its background."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .protocols import Mask, Pixels

MARGIN = 0.1
"""Empty border on each side, as a share of the square."""


def object_crop(pixels: Pixels, mask: Mask) -> NDArray[np.uint8]:
    """(S, S, 4) uint8: ``pixels`` (H, W, 3) cut to the ``mask`` (H, W), alpha 255 in it, black and 0 around it.

    Raises InputError for an empty mask.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        raise InputError("mask: is empty; there is no object to make a mesh of")
    top, left = int(rows[0]), int(columns[0])
    height, width = int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left
    side = max(1, round(max(height, width) / (1 - 2 * MARGIN)))
    crop = np.zeros((side, side, 4), dtype=np.uint8)
    y, x = (side - height) // 2, (side - width) // 2
    inside = mask[top : top + height, left : left + width]
    part = crop[y : y + height, x : x + width]
    part[inside, :3] = pixels[top : top + height, left : left + width][inside]
    part[inside, 3] = 255
    return crop
