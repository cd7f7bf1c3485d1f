# SPDX-License-Identifier: MIT
"""Image similarity: PSNR and SSIM (Wang, Bovik, Sheikh and Simoncelli 2004) with its gradient.

SSIM uses the settings of 3D Gaussian Splatting: an 11x11 Gaussian window with σ = 1.5, C₁ = 0.01², C₂ = 0.03², each
channel on its own, a map as large as the image with zeros beyond its border (Wang's own program crops 5 pixels
instead).
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def psnr(
    a: NDArray[np.uint8] | NDArray[np.floating],
    b: NDArray[np.uint8] | NDArray[np.floating],
    mask: NDArray[np.bool_] | None = None,
    *,
    peak: float = 255.0,
) -> float:
    """Return the peak signal-to-noise ratio in dB between images (H, W, 3), within ``mask`` (H, W) if given.

    peak: the value of white, 255 for 8-bit images, 1 for floating point. Infinite for equal images and an empty mask.
    """
    difference = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    if mask is not None:
        difference = difference[mask]
    if difference.size == 0:
        return math.inf
    error = float(np.mean(difference**2))
    return math.inf if error == 0 else 10.0 * math.log10(peak**2 / error)


Picture = NDArray[np.floating[Any]]

WINDOW, SPREAD = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


def ssim(a: Picture, b: Picture) -> float:
    """Return the mean structural similarity of images (H, W, C) with values 0 to 1: 1 for equal ones, down to -1."""
    return ssim_and_slope(a, b)[0]


def ssim_map(a: Picture, b: Picture) -> Picture:
    """Return the structural similarity (H, W) of images (H, W, C) with values 0 to 1 around each pixel, of ``ssim``."""
    mean_a, mean_b = windowed(a), windowed(b)
    product, squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    shared = windowed(a * b) - product
    spread = windowed(a * a) + windowed(b * b) - squares
    similarity = (2 * product + C1) * (2 * shared + C2) / ((squares + C1) * (spread + C2))
    return np.asarray(similarity.mean(axis=2))


def ssim_and_slope(a: Picture, b: Picture) -> tuple[float, Picture]:
    """Return ``ssim`` and its exact gradient (H, W, C) with respect to ``a``, in the precision of the images.

    With local means μ, variances σ² and covariance σ_ab under the window, Wang's equation 13:
    S = (2 μ_a μ_b + C₁)(2 σ_ab + C₂) / ((μ_a² + μ_b² + C₁)(σ_a² + σ_b² + C₂)). It depends on ``a`` through the windowed
    images of a, a² and ab, so the gradient is a sum of three windowed images: a symmetric window with zeros beyond the
    border is its own adjoint.
    """
    a, b = np.asarray(a), np.asarray(b)
    mean_a, mean_b = windowed(a), windowed(b)
    square_a, square_b, product = windowed(a * a), windowed(b * b), windowed(a * b)
    mean_product = mean_a * mean_b
    mean_squares = mean_a * mean_a + mean_b * mean_b
    luminance_top = 2 * mean_product + C1
    contrast_top = 2 * (product - mean_product) + C2
    luminance_bottom = mean_squares + C1
    contrast_bottom = square_a + square_b - mean_squares + C2
    bottom = luminance_bottom * contrast_bottom
    similarity = luminance_top * contrast_top / bottom

    by_product = 2 * luminance_top / bottom
    by_square = -similarity / contrast_bottom
    by_mean = (
        2 * mean_b * (contrast_top - luminance_top) / bottom
        + 2 * mean_a * similarity * (luminance_bottom - contrast_bottom) / bottom
    )
    slope = windowed(by_mean) + 2 * a * windowed(by_square) + b * windowed(by_product)
    return float(similarity.mean(dtype=np.float64)), slope / similarity.size


def windowed(picture: Picture) -> Picture:
    """Return the windowed mean (H, W, C) around each pixel of ``picture``, with zeros beyond the border."""
    blurred = cv2.sepFilter2D(picture, -1, _KERNEL, _KERNEL, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, dtype=picture.dtype).reshape(picture.shape)


def _kernel() -> NDArray[np.float64]:
    steps = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-0.5 * (steps / SPREAD) ** 2)
    return np.asarray(weights / weights.sum())


_KERNEL = _kernel()
