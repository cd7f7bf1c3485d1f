# SPDX-License-Identifier: MIT
"""Blur whose strength differs from pixel to pixel."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
LEAST_PX = 0.25
"""Blur below this cannot be seen, and none is applied."""
STEP = 1.5
"""Ratio of one strength to the next; between them, blurred images are mixed."""


def varied(image: Image, strength: Image, blur: Callable[[Image, float], Image], most: float = 48.0) -> Image:
    """``image`` (H, W, C), each pixel blurred by ``strength`` (H, W) there, up to ``most``; 0 leaves it exactly.

    blur: gives an image blurred evenly by a strength in pixels.
    """
    strongest = min(float(strength.max(initial=0.0)), most)
    if strongest < LEAST_PX:
        return image
    levels = [LEAST_PX]
    while levels[-1] < strongest:
        levels.append(levels[-1] * STEP)
    result, below_image, below = image, image, 0.0
    for level in levels:
        here = blur(image, level)
        share = np.clip((strength - below) / (level - below), 0.0, 1.0)[..., None]
        # Strengths beyond ``level`` are overwritten by the next round.
        result = np.where(strength[..., None] > below, below_image + (here - below_image) * share, result)
        below_image, below = here, level
    return np.asarray(result, dtype=np.float32)


def gaussian(image: Image, sigma_x: float, sigma_y: float | None = None) -> Image:
    """``image`` (H, W, C) under a Gaussian of these standard deviations in pixels."""
    blurred = cv2.GaussianBlur(image, (0, 0), sigma_x, sigmaY=sigma_y or sigma_x, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.float32).reshape(image.shape)


def disc(image: Image, radius: float) -> Image:
    """``image`` (H, W, C) under the disc of an open aperture, ``radius`` pixels, its edge smooth."""
    reach = int(np.ceil(radius + 0.5))
    axis = np.arange(-reach, reach + 1)
    kernel = np.clip(radius + 0.5 - np.hypot(*np.meshgrid(axis, axis)), 0.0, 1.0)
    blurred = cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, dtype=np.float32).reshape(image.shape)
