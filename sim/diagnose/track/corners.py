# SPDX-License-Identifier: MIT
"""Patches that can be followed: with contrast along every direction (Shi and Tomasi, CVPR 1994)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .pose import Array, Mask


def image_noise(grey: NDArray[np.uint8]) -> float:
    """Standard deviation of the pixels' noise in grey levels (Immerkær, Computer Vision and Image Underst. 64, 1996).

    Taken as a median over the frame, so that texture counts little.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    response = cv2.filter2D(grey.astype(np.float32), -1, kernel)[1:-1, 1:-1]
    return float(np.median(np.abs(response))) / 0.6745 / 6.0


def contrast(grey: NDArray[np.uint8], half: int) -> Array:
    """(H, W): root mean square gradient, grey levels per pixel, along the weakest direction of the patch around."""
    block = 2 * half + 1
    least = cv2.cornerMinEigenVal(grey, block, ksize=3)
    # OpenCV scales Sobel's kernel by 1 / (4 · 255 · block) and sums over the block; its kernel gives 8 gradients.
    return np.asarray(np.sqrt(np.maximum(least, 0.0)) * 255.0 / 2.0, dtype=np.float64)


def find_corners(
    grey: NDArray[np.uint8], allowed: Mask, *, count: int, half: int, spacing: float, min_contrast: float
) -> Array:
    """Up to ``count`` corners (N, 2) in ``allowed`` (H, W), best first, pixel centres at halves."""
    if count <= 0:
        return np.empty((0, 2))
    # Noise of standard deviation s gives gradients of s · 0.43 after Sobel's smoothing; twice that is no corner yet.
    least = max(min_contrast, 2 * 0.43 * image_noise(grey))
    good = allowed & (contrast(grey, half) >= least)
    if not good.any():
        return np.empty((0, 2))
    found = cv2.goodFeaturesToTrack(
        grey, count, 1e-4, spacing, mask=good.astype(np.uint8), blockSize=2 * half + 1, useHarrisDetector=False
    )
    return np.empty((0, 2)) if found is None else np.asarray(found[:, 0], dtype=np.float64) + 0.5
