# SPDX-License-Identifier: MIT
"""The texture without the photo's light: its picture divided by the shading of what each of its pixels shows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...composite.transfer import linear_to_bytes
from .creased import CreasedSurface
from .doubt import division_exponent
from .visible import rasterised

LEAST_SHADING = 0.2
"""Of the median: deep shade is not divided by less, where errors of the light would glare."""
BRIGHTEST = 0.95
NEAR = 24
"""Pixels of the texture beyond what the camera sees over which its shading goes on."""
LEAST_LEFT = 0.3
"""Of a pixel's brightness, that no reflection takes away: black matter does not exist."""
HIGHLIGHT_SHARE = 0.5
"""Of a pixel's brightness, above which the colour below a highlight is taken from around it."""


def texel_values(
    creased: CreasedSurface,
    uv: NDArray[np.float64],
    seen: NDArray[np.bool_],
    values: NDArray[np.float64],
    size: tuple[int, int],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """``values`` (N, C) of the vertices of ``creased`` over a texture (h, w, C) of ``size`` (width, height).

    uv: (V, 2) of the surface's own vertices. seen: (T,) faces that the camera sees; their values go on over what is
    near by, for all that is seen of a photo is painted there. Elsewhere the median of the seen. Also which texels
    (h, w) the seen faces cover.
    """
    width, height = size
    place = uv[creased.source] * (width, -height) + (0.0, height)
    at = np.column_stack([place, np.ones(len(place))])
    shown = rasterised(at, creased.faces, size, seen)
    result = np.empty((height, width, values.shape[1]))
    covered = np.zeros((height, width), dtype=bool)
    if not len(shown.rows):
        result[:] = np.median(values, axis=0)
        return result, covered
    found = shown.interpolated(creased.faces, values)
    result[:] = np.median(found, axis=0)
    covered[shown.rows, shown.columns] = True
    result[shown.rows, shown.columns] = found
    distance, nearest = ndimage.distance_transform_edt(~covered, return_indices=True)
    close = (distance <= NEAR) & ~covered
    result[close] = result[tuple(nearest[:, close])]
    return result, covered


def albedo_of(
    brightness: NDArray[np.float64],
    shading: NDArray[np.float64],
    highlight: NDArray[np.float64] | None,
    seen: NDArray[np.bool_],
) -> tuple[NDArray[np.uint8], float]:
    """Albedo (h, w, 3) in 8-bit sRGB of a texture of linear ``brightness`` (h, w, 3) under ``shading`` (h, w, 3).

    Both in the unit of ``surroundings``. highlight: (h, w, 3) brightness that no albedo causes. Where the result would
    be whiter than white matter, all of it is made darker alike: the photo was exposed brighter than was assumed.
    seen: (h, w) what of it the photo shows. Also the exponent of the shading, 1 unless ``division_exponent`` doubts it;
    the median of the shading is divided by in full.
    """
    least = LEAST_SHADING * np.median(shading, axis=(0, 1))
    # A soft maximum: a hard one would draw its border.
    divisor = (np.maximum(shading, 0.0) ** 4 + least**4) ** 0.25
    light = brightness
    if highlight is not None:
        light = np.maximum(brightness - highlight, LEAST_LEFT * brightness)
    exponent = division_exponent(light, divisor, seen)
    if exponent < 1.0 and highlight is not None:
        # Of a light that is not so, neither are the reflections.
        light, highlight = brightness, None
        exponent = division_exponent(light, divisor, seen)
    if exponent < 1.0:
        usual = float(np.median(divisor))
        divisor = usual * (divisor / usual) ** exponent
    albedo = light / divisor
    if highlight is not None:
        albedo = _refilled(albedo, brightness, highlight)
    top = float(np.percentile(albedo.max(axis=2), 99.5))
    if top > BRIGHTEST:
        albedo *= BRIGHTEST / top
    return linear_to_bytes(np.clip(albedo, 0.0, 1.0).astype(np.float32)), exponent


def _refilled(
    albedo: NDArray[np.float64], brightness: NDArray[np.float64], highlight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """``albedo`` with what lies below strong highlights, where the photo shows hardly any of it, from around them."""
    weak = highlight.mean(axis=2) < HIGHLIGHT_SHARE * np.maximum(brightness.mean(axis=2), 1e-6)
    if weak.all() or not weak.any():
        return albedo
    sigma = max(2.0, 0.5 * np.sqrt(float((~weak).sum())))
    weight = weak.astype(np.float32)
    share = cv2.GaussianBlur(weight, (0, 0), sigma)
    filled = cv2.GaussianBlur((albedo * weight[..., None]).astype(np.float32), (0, 0), sigma)
    usual = np.median(albedo[weak], axis=0)
    smooth = (filled + 1e-3 * usual) / (share[..., None] + 1e-3)
    keep = cv2.GaussianBlur(weight, (0, 0), 1.0)[..., None] * weight[..., None]
    return np.asarray(albedo * keep + smooth * (1.0 - keep))
