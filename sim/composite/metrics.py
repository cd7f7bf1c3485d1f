# SPDX-License-Identifier: MIT
"""How close two images are, as one number; structural similarity is in ssim.py."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def psnr(
    a: NDArray[np.uint8] | NDArray[np.floating],
    b: NDArray[np.uint8] | NDArray[np.floating],
    mask: NDArray[np.bool_] | None = None,
    *,
    peak: float = 255.0,
) -> float:
    """Peak signal-to-noise ratio in dB between images (H, W, 3), within ``mask`` (H, W) when given.

    peak: the value of white: 255 for 8-bit images, 1 for those in memory. Infinite for equal images and for an empty
    mask.
    """
    difference = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    if mask is not None:
        difference = difference[mask]
    if difference.size == 0:
        return math.inf
    error = float(np.mean(difference**2))
    return math.inf if error == 0 else 10.0 * math.log10(peak**2 / error)
