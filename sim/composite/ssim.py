# SPDX-License-Identifier: MIT
"""Structural similarity of two pictures (Wang, Bovik, Sheikh and Simoncelli 2004), and which way it grows.

With the settings that 3D Gaussian Splatting made usual: a Gaussian window of 11x11 pixels and σ = 1.5, C₁ = 0.01²,
C₂ = 0.03², each channel on its own, the map as large as the picture with zeros beyond its border (Wang's own program
leaves out the 5 pixels along the border instead).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.floating[Any]]

WINDOW, SPREAD = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


def ssim(a: Picture, b: Picture) -> float:
    """Mean structural similarity of pictures (H, W, C) of values 0 to 1: 1 where they are equal, down to -1."""
    return ssim_and_slope(a, b)[0]


def ssim_and_slope(a: Picture, b: Picture) -> tuple[float, Picture]:
    """``ssim`` and its exact derivative (H, W, C) with respect to ``a``, in the precision of the pictures.

    With local means μ, variances σ² and covariance σ_ab under the window, Wang's equation 13:
    S = (2 μ_a μ_b + C₁)(2 σ_ab + C₂) / ((μ_a² + μ_b² + C₁)(σ_a² + σ_b² + C₂)). All of it is made of three windowed
    pictures that hang on ``a``: those of a, a² and ab, so the derivative is three windowed pictures again: a symmetric
    window with zeros beyond the border is its own adjoint.
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
    """Mean of ``picture`` (H, W, C) under the window around each pixel, counting zeros beyond the border."""
    blurred = cv2.sepFilter2D(picture, -1, _KERNEL, _KERNEL, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, dtype=picture.dtype).reshape(picture.shape)


def _kernel() -> NDArray[np.float64]:
    steps = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-0.5 * (steps / SPREAD) ** 2)
    return np.asarray(weights / weights.sum())


_KERNEL = _kernel()
