# SPDX-License-Identifier: MIT
"""A perceptually uniform sequence of colours from dark violet over red to light yellow.

Equal steps in value are equal steps of lightness in Oklab [Ottosson 2020, *A perceptual color space for image
processing*], so the picture reads the same in grey and for the colour-blind.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LIGHTNESS = (0.32, 0.92)
_HUE = (-75.0, 100.0)
"""Degrees; violet over red to yellow."""
_CHROMA = (0.13, 0.155, 0.15, 0.14, 0.13)

_LMS_FROM_OKLAB = np.array(
    [[1.0, 0.3963377774, 0.2158037573], [1.0, -0.1055613458, -0.0638541728], [1.0, -0.0894841775, -1.2914855480]]
)
_RGB_FROM_LMS = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


_GREY = 0.6
_STEPS = 512


def colours(shares: Array) -> Array:
    """sRGB (…, 3) from 0 to 1 for shares (…) from 0 to 1; grey where a share is no number."""
    known = np.isfinite(shares)
    index = np.round(np.clip(np.where(known, shares, 0.0), 0.0, 1.0) * _STEPS).astype(np.int64)
    return np.where(known[..., None], _table()[index], _GREY)


@cache
def _table() -> Array:
    t = np.linspace(0.0, 1.0, _STEPS + 1)
    lightness = _LIGHTNESS[0] + (_LIGHTNESS[1] - _LIGHTNESS[0]) * t
    hue = np.radians(_HUE[0] + (_HUE[1] - _HUE[0]) * t)
    chroma = np.interp(t, np.linspace(0, 1, len(_CHROMA)), _CHROMA)
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    linear = np.clip((lab @ _LMS_FROM_OKLAB.T) ** 3 @ _RGB_FROM_LMS.T, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def hex_colour(share: float) -> str:
    """The colour of one share as ``#rrggbb``."""
    red, green, blue = (round(float(c) * 255) for c in colours(np.array(share)))
    return f"#{red:02x}{green:02x}{blue:02x}"
