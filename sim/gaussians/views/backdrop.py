# SPDX-License-Identifier: MIT
"""The outline of an object before a plain backdrop, as generators of views paint it: white, or grey."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Picture = NDArray[np.float32]

LEAST_TOLERANCE, LARGEST_TOLERANCE = 0.03, 0.12
"""Of a channel: below the first compression alone differs as much; above the second a backdrop is not plain."""
PLAIN_SHARE = 0.6
"""Of the border's pixels that a plain backdrop has; the object may reach the border with the others."""
SPECK_SHARE = 5e-4
"""Of the picture: what stands alone and is smaller is dirt."""


def plain_backdrop_mask(pixels: Picture) -> Picture | None:
    """(H, W) 1 where ``pixels`` (H, W, 3) show an object, 0 where they show the backdrop; None where it is not plain.

    The backdrop is what has the border's colour and is connected to the border: an opening through which it shows
    counts as object, and so an opaque object of the backdrop's own colour stays whole.
    """
    border = np.concatenate([pixels[0], pixels[-1], pixels[1:-1, 0], pixels[1:-1, -1]])
    colour = np.median(border, axis=0)
    off = np.abs(border - colour).max(axis=1)
    close = off[off <= LARGEST_TOLERANCE]
    if len(close) < PLAIN_SHARE * len(border):
        return None
    tolerance = float(np.clip(2 * np.quantile(close, 0.95), LEAST_TOLERANCE, LARGEST_TOLERANCE))
    alike = np.abs(pixels - colour).max(axis=2) <= tolerance
    regions, _ = ndimage.label(alike)
    at_border = np.unique(np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]]))
    inside = _without_specks(~np.isin(regions, at_border[at_border > 0]))
    return inside.astype(np.float32) if inside.any() else None


def _without_specks(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    regions, count = ndimage.label(inside)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    large = sizes >= SPECK_SHARE * inside.size
    large[0] = False
    return np.asarray(large[regions])
