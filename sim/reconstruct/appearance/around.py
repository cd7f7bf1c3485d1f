# SPDX-License-Identifier: MIT
"""Sums over all directions of an equirectangular map whose weight depends on the angle alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...scene.equirectangular import directions

Values = NDArray[np.float64]


def summed_around(picture: Values, weight: Callable[[Values], Values]) -> Values:
    """The integral (H, W, C) of ``picture`` (H, W, C) times ``weight`` of the cosine to each pixel's direction.

    A turn about the vertical only moves the columns, so between two rows this is a circular convolution and is done
    as products of Fourier coefficients: W times less work than over all pairs of pixels, and the same numbers.
    """
    height, width = picture.shape[:2]
    towards, solid = directions(height, width)
    cosine = np.einsum("ik,jdk->ijd", towards[:, 0], towards)
    kernel = np.fft.rfft(weight(np.clip(cosine, -1.0, 1.0)), axis=2)
    light = np.fft.rfft(picture * solid[..., None], axis=1)
    # Row i, column c meets row j, column c + d with the kernel's d: a correlation, hence the conjugate.
    product = np.einsum("ijf,jfc->ifc", kernel.conj(), light, optimize=True)
    return np.asarray(np.fft.irfft(product, n=width, axis=1))
