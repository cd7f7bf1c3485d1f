# SPDX-License-Identifier: MIT
"""How far a texture is to be divided by its shading, where the shading may be that of a wrong light.

Places of one colour are equally bright after a division by the right shading. Where they are less so than in the photo
itself, the light, the shape or the matter is not what was taken, and the division would paint that error on the object.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

RADIUS = 0.2
"""Of logarithms of chromaticity, within which a colour is one; its brightness is what is asked about."""
LEAST_PIXELS, LEAST_SHARE = 350, 0.4
"""Of one colour, and of all that are seen: with fewer, paint may be what makes places unlike."""
SAMPLE = 2500
BORDER = 2
"""Texels along the outline, which show the background as well."""
CLIPPED = 0.95
DARKEST = 4e-3
"""Linear brightness below which 8 bits do not tell a colour."""


def division_exponent(brightness: NDArray[np.float64], divisor: NDArray[np.float64], where: NDArray[np.bool_]) -> float:
    """Exponent, 0 to 1, of ``divisor`` (h, w, 3) in the division of linear ``brightness`` (h, w, 3).

    1 unless that makes the texels of the most common colour among ``where`` (h, w) differ more, as the deviation of
    logarithms, than they do undivided. Then it is what makes them differ least, by linear regression.
    """
    inside = ndimage.binary_erosion(where, iterations=BORDER)
    light, shading = brightness[inside], divisor[inside]
    told = (light.min(axis=1) > DARKEST) & (light.max(axis=1) < CLIPPED)
    light, shading = light[told], shading[told]
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
    """Which of ``light`` (P, 3) have the chromaticity that most have."""
    logs = np.log(light)
    features = np.column_stack([logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1]])
    some = features[np.random.default_rng(0).permutation(len(features))[:SAMPLE]]
    near = cKDTree(some).query_ball_point(some, RADIUS, return_length=True)
    return np.asarray(np.linalg.norm(features - some[int(np.argmax(near))], axis=1) < RADIUS)
