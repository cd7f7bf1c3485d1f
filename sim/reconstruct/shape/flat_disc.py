# SPDX-License-Identifier: MIT
"""Coins and buttons seen from above: a circle is the outline of a ball and of a disc alike, and shading tells them
apart. Over a ball brightness changes smoothly from one side to the other or from the middle outwards; on a disc there
is only what is printed or struck on it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from ...srgb import bytes_to_linear
from ..segmentation.round_things import circles_of_a_kind

Mask = NDArray[np.bool_]

STEEP = math.radians(60.0)
"""Angle below the horizontal from which a camera looks at things from above: a disc's outline is within 13 % a circle,
about what ``OBLATE`` allows a ball."""
INNER = 0.8
"""Share of the outline's half width within which brightness is looked at: rims of coins are ridges."""
SIDE = 200
"""Longest side in pixels at which it is looked at."""
SMOOTH = 0.44
"""Share of the variance of brightness (logarithm) that a quadratic in the place explains, below which it is no
shading. 38 balls in three photos (oranges, apples): at least 0.46, and 0.70 and more in the middle; 45 coins in three:
at most 0.41, and at most 0.10 in the middle."""
MOST = 12
"""Round things of a photo that are looked at, the largest ones."""
ROUNDS, ROBUST = 4, 0.15
"""Robust refits of that quadratic, and the deviation in logarithms beyond which highlights and prints count less."""


def looks_down(camera: Camera) -> bool:
    """Return whether ``camera`` looks at the ground steeply enough for discs to be circles."""
    return -float(np.asarray(camera.world_from_camera)[2, 2]) >= math.sin(STEEP)


def smooth_share(pixels: NDArray[np.uint8], mask: Mask) -> float:
    """Return the share, at most 1, of the variance of brightness in ``mask`` (H, W) that smooth shading explains.

    pixels: (H, W, 3) sRGB. Negative where prints are so strong that the robust fit explains less than the mean; 1
    where there are too few pixels to tell.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return 1.0
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    part, inside = np.ascontiguousarray(pixels[window]), mask[window].astype(np.float32)
    scale = min(1.0, SIDE / max(inside.shape))
    if scale < 1.0:
        size = (max(1, round(inside.shape[1] * scale)), max(1, round(inside.shape[0] * scale)))
        part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        inside = np.asarray(cv2.resize(inside, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    height, width = inside.shape
    v, u = ((np.mgrid[:height, :width].T + 0.5) / (0.5 * np.array([height, width])) - 1.0).T
    where = (inside > 0.99) & (u**2 + v**2 < INNER**2)
    if where.sum() < 60:
        return 1.0
    light = np.log(bytes_to_linear(part).mean(axis=2)[where].astype(np.float64) + 0.01)
    u, v = u[where], v[where]
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    weight = np.ones_like(light)
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        fitted = terms @ np.linalg.lstsq(terms * root[:, None], light * root, rcond=None)[0]
        weight = 1.0 / (1.0 + ((light - fitted) / ROBUST) ** 2)
    return float(1.0 - ((light - fitted) ** 2).mean() / max(float(light.var()), 1e-6))


def is_disc(pixels: NDArray[np.uint8], mask: Mask) -> bool:
    """Return whether what fills the round outline ``mask`` (H, W) of ``pixels`` (H, W, 3) shows no shading of a ball.

    If it is one of many round things, most of them decide: a single coin may have a print that looks like shading.
    """
    shares = [smooth_share(pixels, mask)]
    circles = circles_of_a_kind(pixels)
    if any(mask[int(item.y), int(item.x)] for item in circles):
        for item in circles[:MOST]:
            low = np.maximum(np.floor(np.array([item.y, item.x]) - item.radius), 0).astype(int)
            part = pixels[low[0] : math.ceil(item.y + item.radius), low[1] : math.ceil(item.x + item.radius)]
            rows, columns = np.mgrid[: part.shape[0], : part.shape[1]] + 0.5 + low[:, None, None]
            shares.append(smooth_share(part, np.hypot(columns - item.x, rows - item.y) < item.radius))
    return float(np.median(shares)) < SMOOTH
