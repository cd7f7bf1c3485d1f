# SPDX-License-Identifier: MIT
"""Which part of the ground's plane in a picture is the surface on which the objects stand.

A stone, a bench or a table ends: what is seen beyond its edge lies below the horizon too, but it is water, grass or a
wall, on which the objects cast no shadow. Light changes the brightness of one surface and hardly its tint, and never
takes more than a lamp can give. So the surface before the objects, which the camera sees above everything else, goes on
as far as its tint does, and as far as it hangs together.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from .ground_lighting import MAX_SHARE
from .ground_pixels import relative_colour
from .shadow_lamps import MOST_TINT

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
Values = NDArray[np.float64]

REACH = 0.6
"""Range of the ground before an object whose colours are those of the surface, over the width of its foot."""
FOOT = 0.1
"""Share of an object's height, from below, that counts as its foot."""
FEWEST = 100
"""Fewest pixels before the objects that tell a surface."""
LIT = 0.7
"""Quantile of their brightness that counts as lit: the rest may lie in shadow."""
SMOOTH = 2.0
"""Blur in pixels: single grains differ in tint."""
LIGHT_SPREAD, TINT_SPREAD = (0.1, 0.4), (0.04, 0.13)
"""Bounds of the surface's spread: of its log brightness, and of its log chromas. What has more tints, as grass or
ground of two colours, is not told apart."""
BRIGHTER, DARKEST = 0.7, -float(np.log(1.0 - MAX_SHARE))
"""Change of log brightness by uneven light, and in the deepest shadow of a lamp."""
TINTED, SHADE_TINT = 0.06, 0.12
"""Change of log chromas over the surface, and that of a shadow, over its depth."""
TINT_ROUNDS = 8
SURE = 0.25
"""Share of a region of another colour that must be so beyond doubt."""
LEAST, LEAST_BEFORE = 0.02, 0.1
"""Least size of such a region over all ground, and least share of the ground before the objects in a part of the
surface."""


def ground_before(places: Points, eye: Points, surfaces: Sequence[Points]) -> Mask:
    """Return which of the points ``places`` (N, 2) of the ground lie close before one of the objects.

    eye: (2,) the camera. surfaces: points (M, 3) on each object, the third coordinate above the ground.
    """
    found = np.zeros(len(places), dtype=bool)
    for surface in surfaces:
        height = float(surface[:, 2].max())
        foot = surface[surface[:, 2] <= FOOT * height + float(surface[:, 2].min())][:, :2]
        low, high = foot.min(axis=0), foot.max(axis=0)
        reach = REACH * float((high - low).max())
        middle = foot.mean(axis=0)
        with np.errstate(invalid="ignore"):
            distance = np.linalg.norm(np.maximum(np.maximum(low - places, places - high), 0.0), axis=1)
            found |= (distance < reach) & ((places - middle) @ (middle - eye) < 0.0)
    return found


def standing_surface(colour: Values, ground: Mask, before: Mask) -> Mask:
    """Return the pixels (h, w) of ``ground`` (h, w) that show the surface on which the objects stand.

    colour: (h, w, 3) natural logarithm of the linear light. before: (h, w) ground close before the objects. All of
    ``ground`` if that is too little, or of too many tints, to tell.
    """
    if before.sum() < FEWEST:
        return ground
    usual = np.median(colour[before], axis=0)
    values = relative_colour(colour.reshape(-1, 3), usual[None]).reshape(colour.shape)
    own = values[before]
    # A shadow under a blue sky is bluer by as much as it is deeper.
    slope, offset, chroma = _tint(own)
    if chroma >= TINT_SPREAD[1]:
        return ground
    values[..., 1:] -= offset + slope * values[..., :1]
    alike = values[ground & (np.linalg.norm(values[..., 1:], axis=-1) < 3.0 * chroma), 0]
    lit = float(np.quantile(alike, LIT)) if len(alike) else float(np.median(own[:, 0]))
    light = float(np.clip(1.48 * np.median(np.abs(own[:, 0] - np.median(own[:, 0]))), *LIGHT_SPREAD))
    weight = ground.astype(np.float64)
    around = np.maximum(cv2.GaussianBlur(weight, (0, 0), SMOOTH), 1e-3)[..., None]
    mean = cv2.GaussianBlur((values - (lit, 0.0, 0.0)) * weight[..., None], (0, 0), SMOOTH) / around
    level, changed = mean[..., 0], np.linalg.norm(mean[..., 1:], axis=-1)

    def unlike(spreads: float, shade: float) -> Mask:
        tinted = changed > spreads * chroma + TINTED + shade * np.maximum(-level, 0.0)
        return np.asarray(
            ground & (tinted | (level > BRIGHTER + spreads * light) | (level < -DARKEST - spreads * light))
        )

    sure = unlike(3.0, SHADE_TINT)
    number, labels = _components(sure | unlike(1.5, 0.0))
    sizes, certain = (np.bincount(labels[some], minlength=number) for some in (ground, sure))
    other = (certain > SURE * sizes) & (sizes > LEAST * ground.sum())
    other[0] = False
    rest = ground & ~other[labels]
    number, labels = _components(rest)
    held = np.bincount(labels[before & rest], minlength=number)
    held[0] = 0
    return np.asarray(rest & (held > LEAST_BEFORE * max(int(held.sum()), 1))[labels])


def _tint(samples: Values) -> tuple[Values, Values, float]:
    """Return slope (2,) and offset (2,) of the log chromas of ``samples`` (N, 3) over their log luminance, and the
    spread of what is left, within ``TINT_SPREAD``. Robust: half of them may be of another colour."""
    luminance, chromas = samples[:, 0], samples[:, 1:]
    weight = np.ones(len(samples))
    slope, offset, spread = np.zeros(2), np.zeros(2), 0.0
    for _ in range(TINT_ROUNDS):
        total = weight.sum()
        middle, mean = float(weight @ luminance) / total, (weight @ chromas) / total
        across = weight * (luminance - middle)
        slope = np.clip(across @ chromas / max(float(across @ (luminance - middle)), 1e-9), -MOST_TINT, MOST_TINT)
        offset = mean - slope * middle
        left = np.linalg.norm(chromas - offset - slope * luminance[:, None], axis=1)
        near = left[left <= max(3.0 * spread, float(np.median(left)))]
        spread = float(np.clip(1.48 * np.median(near), *TINT_SPREAD))
        weight = 1.0 / (1.0 + np.square(left / spread)) ** 2
    return slope, offset, spread


def _components(region: Mask) -> tuple[int, NDArray[np.int64]]:
    number, labels = cv2.connectedComponents(region.astype(np.uint8), connectivity=4)
    return number, np.asarray(labels, dtype=np.int64)
