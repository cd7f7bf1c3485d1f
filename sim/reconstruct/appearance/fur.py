# SPDX-License-Identifier: MIT
"""Whether an object is of fur, pile or wool, from its texture in the photo.

Fur is rough everywhere, nearly as much in one place as in another, and its hairs lie in all directions. Prints, edges
and highlights are strong in a few places and leave even ones between them; wood, cloth and weaves have a direction.
Stone looks alike: the caller asks only about bodies for which nothing else was found.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

SIDE, LEAST_SIDE = 300.0, 150.0
"""Square root of the area in pixels at which the texture is looked at, and below which hairs are not resolved."""

FINE, COARSE = 0.7, 2.5
"""Standard deviations in pixels of the two blurs whose difference is the texture."""

WINDOW = 4.0
"""Standard deviation in pixels of the windows in which its strength and direction are measured."""

RIM = 6
"""Pixels inside the outline that are left out."""

ROUGH = (0.013, 0.02)
"""Least contrast of the texture, over lightness, in all but the evenest 10 % and 25 % of the object."""

ALIKE = (2.3, 4.5)
"""Largest ratios of contrasts: of the 25th percentile to the 10th, and of the 90th to the 25th."""

DIRECTED = 0.46
"""Largest median coherence of the structure tensor (0: all directions alike, 1: one)."""


def is_furry(pixels: NDArray[np.uint8], mask: NDArray[np.bool_]) -> bool:
    """Return whether the object ``mask`` (h, w) in ``pixels`` (h, w, 3), sRGB, looks as if it were of fur or pile."""
    side = float(np.sqrt(mask.sum()))
    if side < LEAST_SIDE:
        return False
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    scale = min(1.0, SIDE / side)
    height, width = mask[window].shape
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    seen = cv2.resize(np.ascontiguousarray(pixels[window]), size, interpolation=cv2.INTER_AREA)
    inside = cv2.resize(mask[window].astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    inner = ndimage.binary_erosion(inside, iterations=RIM)
    if not inner.any():
        return False
    lightness = cv2.cvtColor(np.asarray(seen, dtype=np.uint8), cv2.COLOR_RGB2LAB)[..., 0].astype(np.float32)
    texture = _blurred(lightness, FINE) - _blurred(lightness, COARSE)
    # Dark places show less of the same hairs, black ones nothing.
    contrast = np.sqrt(_blurred(texture * texture, WINDOW)) / (_blurred(lightness, WINDOW) + 20.0)
    least, quarter, most = np.percentile(contrast[inner], (10, 25, 90))
    if least < ROUGH[0] or quarter < ROUGH[1] or quarter > ALIKE[0] * least or most > ALIKE[1] * quarter:
        return False
    across, down = cv2.Sobel(texture, cv2.CV_32F, 1, 0), cv2.Sobel(texture, cv2.CV_32F, 0, 1)
    xx, yy, xy = (_blurred(product, WINDOW) for product in (across * across, down * down, across * down))
    coherence = np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy) / np.maximum(xx + yy, 1e-3)
    return bool(np.median(coherence[inner]) <= DIRECTED)


def _blurred(values: NDArray[np.float32], deviation: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), deviation), dtype=np.float32)
