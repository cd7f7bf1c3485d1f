# SPDX-License-Identifier: MIT
"""The ground near the objects, as pixels of a small picture: where they are on the plane, and how bright."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite.transfer import bytes_to_linear
from ...scene.model import Camera
from ..view.camera import on_ground
from .relief import Relief

Mask = NDArray[np.bool_]
Values = NDArray[np.float64]

OBJECT_SIDE, SMALLEST_SIDE = 130, 24
"""Pixels of the largest object, at most, and of the smallest, at least, where these allow it."""
MOST_PIXELS = 45_000
REACH = 3.0
"""How far around an object its shadow is looked for, over its height: light 18° high."""
USUAL = 1.0
"""Distance over an object's height from which on the ground's colour counts for less: a wall may begin."""
DARKEST = 2e-3
"""Linear light below which a pixel says nothing about ratios: one step in eight bits is a third of it."""


@dataclass(frozen=True)
class GroundPixels:
    """Ground near the objects in a picture of ``size`` (width, height).

    rows, columns: (N,) of the pixels. places: (N, 2) on the plane z = 0. colour: (N, 3) natural logarithm of the
    linear light. weight: (N,) how surely they are
    the ground that the objects stand on. known: (h, w) 1 on these pixels. object_side: pixels of the largest object.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    places: Values
    colour: Values
    weight: Values
    known: NDArray[np.float32]
    object_side: float

    def picture(self, values: NDArray[np.generic], elsewhere: float = 0.0) -> NDArray[np.float32]:
        """``values`` (N,) in the small picture (h, w), ``elsewhere`` where there is no ground."""
        found = np.full(self.known.shape, elsewhere, dtype=np.float32)
        found[self.rows, self.columns] = values
        return found

    def blurred(self, values: NDArray[np.generic], sigma: float) -> Values:
        """``values`` (N,) as weighted means over Gaussians of ``sigma`` pixels, of ground only."""
        total = cv2.GaussianBlur(self.picture(values), (0, 0), sigma)
        weight = cv2.GaussianBlur(self.known, (0, 0), sigma)
        at = self.rows, self.columns
        return np.asarray(total[at] / np.maximum(weight[at], 1e-6), dtype=np.float64)


def ground_pixels(
    pixels: NDArray[np.uint8], masks: Sequence[Mask], camera: Camera, bodies: Sequence[Relief]
) -> GroundPixels | None:
    """The ground around ``bodies`` in the photo ``pixels`` (H, W, 3) sRGB, or None when none is in view.

    masks: (H, W) of all objects; they and the pixels along their outlines are no ground.
    """
    height, width = pixels.shape[:2]
    sides = [max(int(np.ptp(i)) + 1 for i in np.nonzero(mask)) for mask in masks if mask.any()]
    shrink = min(1.0, max(OBJECT_SIDE / max(sides), min(SMALLEST_SIDE / min(sides), 1.0)))
    coarse = _centres(width, height, (max(1, width // 8), max(1, height // 8)))
    area = float(_near(on_ground(camera, coarse), bodies).mean()) * width * height
    shrink = min(shrink, math.sqrt(MOST_PIXELS / max(area, 1.0)))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    # Pixels along an outline are mixtures of object and ground: they have no part in the mean.
    seam = max(1, round(0.5 / shrink))
    covered = np.logical_or.reduce(masks).astype(np.uint8)
    open_ground = (cv2.dilate(covered, np.ones((2 * seam + 1,) * 2, np.uint8)) == 0).astype(np.float32)
    share = cv2.resize(open_ground, size, interpolation=cv2.INTER_AREA)
    light = cv2.resize(bytes_to_linear(pixels) * open_ground[..., None], size, interpolation=cv2.INTER_AREA)
    places = on_ground(camera, _centres(width, height, size))
    use = _near(places, bodies) & (share > 0.3)
    if not use.any():
        return None
    linear = light[use] / share[use][:, None]
    rows, columns = np.nonzero(use)
    return GroundPixels(
        rows=rows,
        columns=columns,
        places=places[use][:, :2],
        colour=np.log(np.maximum(linear.astype(np.float64), DARKEST)),
        weight=1.0 / (1.0 + (_distance(places[use], bodies) / USUAL) ** 2),
        known=use.astype(np.float32),
        object_side=max(sides) * shrink,
    )


def _centres(width: int, height: int, size: tuple[int, int]) -> Values:
    """Where the pixels of a picture of ``size`` (w, h) lie in the photo: (h, w, 2)."""
    x, y = (np.arange(size[0]) + 0.5) * (width / size[0]), (np.arange(size[1]) + 0.5) * (height / size[1])
    return np.stack(np.meshgrid(x, y), axis=-1)


def _near(places: Values, bodies: Sequence[Relief]) -> Mask:
    """Which of ``places`` (..., 3) a shadow of one of the ``bodies`` may reach; never what is above the horizon."""
    return (_distance(places, bodies) < REACH) & np.isfinite(places).all(axis=-1)


def _distance(places: Values, bodies: Sequence[Relief]) -> Values:
    """How far ``places`` (..., 3) lie from the nearest of the ``bodies``, over that one's height."""
    nearest = np.full(places.shape[:-1], np.inf)
    with np.errstate(invalid="ignore"):
        for body in bodies:
            low, high = body.points[:, :2].min(axis=0), body.points[:, :2].max(axis=0)
            outside = np.maximum(np.maximum(low - places[..., :2], places[..., :2] - high), 0.0)
            nearest = np.fmin(nearest, np.linalg.norm(outside, axis=-1) / max(body.height, 1e-9))
    return nearest
