# SPDX-License-Identifier: GPL-3.0-or-later
"""Exact soft shadows of convex parts on a plane: every part is projected along many directions and filled."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from physgen.benchmarks.reconstruct_pictures.cases import Case, Lamp

Values = NDArray[np.float64]
Picture = NDArray[np.float32]
Shade = NDArray[np.uint8]

RASTER = 640
"""Cells along a plane's longer side."""
SUBCELLS = 4
"""Bits of a cell in which corners are given to OpenCV."""
SKY, LAMP = 96, 24
"""Directions of the sky; points of a lamp."""
BEYOND = 4
"""Sides of the raster beyond which corners are cut off."""
FLATTEST = 0.02
"""Cosine below which a direction does not light a plane."""


@dataclass(frozen=True, eq=False)
class Plane:
    """origin: (3,). axes: (3, 3) rows are its x, y and normal. low, high: (2,) the part that is drawn, its frame."""

    origin: Values
    axes: Values
    low: Values
    high: Values

    @property
    def scale(self) -> float:
        """Cells a metre."""
        return RASTER / float((self.high - self.low).max())

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the raster."""
        columns, rows = np.maximum(8, np.ceil((self.high - self.low) * self.scale).astype(int))
        return int(rows), int(columns)

    def in_frame(self, points: Values) -> Values:
        """Return world ``points`` (..., 3) in the plane's frame."""
        return np.asarray((points - self.origin) @ self.axes.T)

    def shadow(self, parts: Sequence[Values], *, toward: Values | None = None, lamp: Values | None = None) -> Shade:
        """Return the raster (rows, columns), 1 where the convex hulls of ``parts`` (M, 3) block the light from the unit
        vector ``toward`` (3,), or from a ``lamp`` at (3,)."""
        canvas = np.zeros(self.shape, np.uint8)
        for part in parts:
            points = self.in_frame(part)
            points = points[points[:, 2] > -1e-6]
            slid = _slid_along(points, self.axes @ toward) if toward is not None else self._slid_from(points, lamp)
            if len(slid) < 3:
                continue
            cells = np.clip((slid - self.low) * self.scale, -BEYOND * RASTER, (BEYOND + 1) * RASTER)
            hull = cv2.convexHull(np.rint(cells * 2**SUBCELLS).astype(np.int32))
            cv2.fillConvexPoly(canvas, hull, 1, shift=SUBCELLS)
        return canvas

    def _slid_from(self, points: Values, lamp: Values | None) -> Values:
        assert lamp is not None
        at = self.in_frame(lamp)
        points = points[points[:, 2] < 0.95 * at[2]]
        height = np.maximum(points[:, 2:], 0.0)
        return np.asarray(points[:, :2] + (points[:, :2] - at[:2]) * height / (at[2] - height))

    def sampled(self, raster: Picture, places: Values, elsewhere: float) -> Picture:
        """Return ``raster`` (rows, columns) at ``places`` (H, W, 3) of the plane's frame."""
        cells = (places[..., :2] - self.low) * self.scale - 0.5
        cells = np.where(np.isfinite(cells), cells, -1e6).astype(np.float32).clip(-1e6, 1e6)
        return np.asarray(
            cv2.remap(
                raster,
                cells[..., 0],
                cells[..., 1],
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=elsewhere,
            )
        )


def _slid_along(points: Values, direction: Values) -> Values:
    if direction[2] < FLATTEST:
        return points[:0, :2]
    return np.asarray(points[:, :2] - direction[:2] / direction[2] * np.maximum(points[:, 2:], 0.0))


def light_on(
    plane: Plane, parts: Sequence[Values], case: Case, rng: np.random.Generator, *, loss: float, bounce: float
) -> tuple[NDArray[np.float32], Values]:
    """Return the irradiance of ``plane`` past the convex ``parts``, (rows, columns, 3), and (3,) without them.

    The even sky of ``case`` gives about 1 to open ground. loss: share of blocked light of sky and ground that is lost;
    the parts reflect the rest. bounce: radiance of the ground as a wall sees it, over the sky's at the horizon.
    """
    sky, normal = np.array(case.sky), plane.axes[2]
    toward = _cosine_weighted(SKY, rng) @ plane.axes
    up = toward[:, 2]
    radiance = np.where(up > 0, 1.0 + case.sky_gradient * up, bounce) / (1.0 + case.sky_gradient * 0.667)
    reached = np.zeros(plane.shape, np.float32)
    for direction, bright in zip(toward, radiance, strict=True):
        share = bright / SKY
        reached += share * (1.0 - loss * plane.shadow(parts, toward=direction))
    total: Any = reached[..., None] * sky
    bare = float(radiance.mean()) * sky
    for lamp in case.lamps:
        direction = np.array(lamp.towards) / np.linalg.norm(lamp.towards)
        cosine = float(direction @ normal)
        if cosine <= FLATTEST:
            continue
        # Its strength is that on open ground.
        colour = np.array(lamp.colour) * (lamp.strength * (cosine / max(direction[2], 0.05)))
        shadows = [plane.shadow(parts, **point) for point in _points_of(lamp, direction)]
        total = total + (1.0 - np.mean(shadows, axis=0))[..., None] * colour
        bare = bare + colour
    return np.asarray(total, dtype=np.float32), bare


def _cosine_weighted(count: int, rng: np.random.Generator) -> Values:
    """Unit vectors (count, 3) about z, in sunflower order from a random turn."""
    radius, turn = _sunflower(count)
    turn = turn + rng.uniform(0, 6.28)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1.0 - radius**2)])


def _sunflower(count: int) -> tuple[Values, Values]:
    """Radii and angles (count,) of points evenly over a disc of radius 1."""
    number = np.arange(count) + 0.5
    return np.sqrt(number / count), number * math.pi * (3.0 - math.sqrt(5.0))


def _points_of(lamp: Lamp, direction: Values) -> Iterator[dict[str, Values]]:
    """Directions or places over ``lamp``, as arguments of ``Plane.shadow``."""
    side = np.cross(direction, [0.0, 0.0, 1.0])
    side /= max(float(np.linalg.norm(side)), 1e-9)
    other = np.cross(side, direction)
    if lamp.distance is None:
        radius, turn = _sunflower(LAMP)
        radius = radius * lamp.width / 2.0
        for x, y in zip(radius * np.cos(turn), radius * np.sin(turn), strict=True):
            ray = direction + side * x + other * y
            yield {"toward": ray / np.linalg.norm(ray)}
        return
    size, number = lamp.distance * lamp.width, np.arange(LAMP) + 0.5
    for x, y in zip(number / LAMP - 0.5, (number * 0.618034) % 1.0 - 0.5, strict=True):
        yield {"lamp": direction * lamp.distance + side * (x * size) + other * (y * size * 1.3)}
