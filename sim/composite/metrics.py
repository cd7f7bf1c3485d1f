# SPDX-License-Identifier: MIT
"""How close two 8-bit images are."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def psnr(a: NDArray[np.uint8], b: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB between images (H, W, 3), within ``mask`` (H, W) when given.

    Infinite for equal images and for an empty mask.
    """
    difference = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    if mask is not None:
        difference = difference[mask]
    if difference.size == 0:
        return math.inf
    error = float(np.mean(difference**2))
    return math.inf if error == 0 else 10.0 * math.log10(255.0**2 / error)
