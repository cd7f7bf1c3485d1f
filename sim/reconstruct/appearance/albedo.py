# SPDX-License-Identifier: MIT
"""Albedo: the texture of a body divided by the shading at the surface point of each texel.

After division by the right shading, texels of one colour are equally bright. Where they differ more than in the photo,
the light, shape or material is wrong, and only a power of the shading is divided out.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from ...srgb import linear_to_bytes
from ..creases import CreasedSurface
from ..mesh_raster import rasterise

RADIUS = 0.2
"""Radius in log chromaticity of one colour, of any brightness."""
LEAST_PIXELS, LEAST_SHARE = 350, 0.4
"""Least pixels of one colour, and least share of the visible ones: with fewer, paint may cause the differences."""
SAMPLE = 2500
BORDER = 2
"""Texels along the outline, which are mixed with the background."""
CLIPPED = 0.95
DARKEST = 4e-3
"""Linear brightness below which 8 bits do not resolve a colour."""


def division_exponent(brightness: NDArray[np.float64], divisor: NDArray[np.float64], where: NDArray[np.bool_]) -> float:
    """Return the exponent, 0 to 1, of ``divisor`` (h, w, 3) in the division of linear ``brightness`` (h, w, 3).

    1 unless that makes the texels of the most common colour among ``where`` (h, w) differ more, as the deviation of
    logarithms, than they do undivided. Then the exponent of least difference, by linear regression.
    """
    inside = ndimage.binary_erosion(where, iterations=BORDER)
    light, shading = brightness[inside], divisor[inside]
    valid = (light.min(axis=1) > DARKEST) & (light.max(axis=1) < CLIPPED)
    light, shading = light[valid], shading[valid]
    if len(light) < LEAST_PIXELS:
        return 1.0
    chosen = _most_common(light)
    if chosen.sum() < max(LEAST_PIXELS, LEAST_SHARE * inside.sum()):
        return 1.0
    seen, expected = (np.log(v[chosen].mean(axis=1)) for v in (light, shading))
    seen, expected = seen - seen.mean(), expected - expected.mean()
    if (seen - expected).std() <= seen.std():
        return 1.0
    # Least squares of seen = exponent · expected. The variance of expected is not 0, or nothing would differ more.
    return float(np.clip((seen @ expected) / (expected @ expected), 0.0, 1.0))


def _most_common(light: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels (bool) of ``light`` (P, 3) with the most common chromaticity."""
    logs = np.log(light)
    features = np.column_stack([logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1]])
    some = features[np.random.default_rng(0).permutation(len(features))[:SAMPLE]]
    near = cKDTree(some).query_ball_point(some, RADIUS, return_length=True)
    return np.asarray(np.linalg.norm(features - some[int(np.argmax(near))], axis=1) < RADIUS)


LEAST_SHADING = 0.2
"""Least shading over the median, as errors of the light would glare in deep shade."""
BRIGHTEST = 0.95
NEAR = 24
"""Texels over which the shading is extended beyond the visible surface."""
LEAST_LEFT = 0.3
"""Least share of a pixel's brightness that is not a reflection: black materials do not exist."""
HIGHLIGHT_SHARE = 0.5
"""Share of a highlight in a pixel's brightness above which the colour below is inpainted from around it."""
WIDEST_KERNEL = 12.0
"""Standard deviation in texels of the widest Gaussian that is computed on the texture's own grid."""


def texel_values(
    creased: CreasedSurface,
    uv: NDArray[np.float64],
    seen: NDArray[np.bool_],
    values: NDArray[np.float64],
    size: tuple[int, int],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return ``values`` (N, C) at the vertices of ``creased`` over a texture (h, w, C) of ``size`` (width, height).

    uv: (V, 2) of the surface's own vertices. seen: (T,) visible faces; their values are extended over nearby texels,
    which hold the photo's colours, too. Elsewhere the median of the visible values. Also the texels (h, w) that visible
    faces cover.
    """
    width, height = size
    place = uv[creased.source] * (width, -height) + (0.0, height)
    at = np.column_stack([place, np.ones(len(place))])
    shown = rasterise(at, creased.faces, size, seen)
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


def compute_albedo(
    brightness: NDArray[np.float64],
    shading: NDArray[np.float64],
    highlight: NDArray[np.float64] | None,
    seen: NDArray[np.bool_],
) -> tuple[NDArray[np.uint8], float]:
    """Return albedo (h, w, 3) in 8-bit sRGB of a texture of linear ``brightness`` (h, w, 3) under ``shading`` (h, w,
    3).

    Both in the unit of ``LocalLighting``. highlight: (h, w, 3) reflected brightness. If the result is brighter than
    white, all of it is darkened: the photo was exposed brighter than assumed. seen: (h, w) visible texels. Also the
    exponent of the shading, 1 unless ``division_exponent`` rejects it; the median of the shading is always divided out
    in full.
    """
    least = LEAST_SHADING * np.median(shading, axis=(0, 1))
    # A soft maximum, as a hard one would leave a visible border.
    divisor = (np.maximum(shading, 0.0) ** 4 + least**4) ** 0.25
    light = brightness
    if highlight is not None:
        light = np.maximum(brightness - highlight, LEAST_LEFT * brightness)
    exponent = division_exponent(light, divisor, seen)
    if exponent < 1.0 and highlight is not None:
        # If the light is wrong, so are the reflections.
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
    """``albedo`` with texels below strong highlights, where hardly any of it is visible, inpainted from around them."""
    weak = highlight.mean(axis=2) < HIGHLIGHT_SHARE * np.maximum(brightness.mean(axis=2), 1e-6)
    if weak.all() or not weak.any():
        return albedo
    sigma = max(2.0, 0.5 * np.sqrt(float((~weak).sum())))
    weight = weak.astype(np.float32)
    share = _blurred(weight, sigma)
    filled = _blurred((albedo * weight[..., None]).astype(np.float32), sigma)
    usual = np.median(albedo[weak], axis=0)
    smooth = (filled + 1e-3 * usual) / (share[..., None] + 1e-3)
    keep = cv2.GaussianBlur(weight, (0, 0), 1.0)[..., None] * weight[..., None]
    return np.asarray(albedo * keep + smooth * (1.0 - keep))


def _blurred(values: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """``values`` (h, w) or (h, w, C) blurred by a Gaussian of ``sigma`` texels, a wide one on a smaller grid.

    The cost of a kernel grows with its width: one of 500 texels took minutes on a black object, where nearly every
    texel counts as a reflection, and what it leaves has no detail that a smaller grid would lose.
    """
    if sigma <= WIDEST_KERNEL:
        return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma))
    height, width = values.shape[:2]
    scale = WIDEST_KERNEL / sigma
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.GaussianBlur(cv2.resize(values, size, interpolation=cv2.INTER_AREA), (0, 0), WIDEST_KERNEL)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))
