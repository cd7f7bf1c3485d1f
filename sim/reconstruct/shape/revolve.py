# SPDX-License-Identifier: MIT
"""The largest body of revolution about a vertical axis that an outline holds: bottles, vases, cups.

At every height the widest circle about the axis whose picture stays inside the outline: perspective is exact, and a
handle, which is on one side only, does not widen it. Circles that only the far rim of the outline stops would make a
dome over every cup that is seen from above: the body ends below them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import minimize

from ...scene.model import Camera
from .primitives import Primitive, Revolved, drawn

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]
Field = NDArray[np.float64]

HEIGHTS = 28
"""Circles between the ground and the top."""
AROUND = 32
"""Points on each circle."""
LATERAL = 0.75
"""Cosine of the angle from the line of sight below which a point of a circle is at its side."""
BROAD_BASE = 0.015
"""Overlap that is given up for a base as wide as the body: what stands on a point falls over."""
TALLER = 1.6
"""Height up to which the body may reach over that of the straight one."""
SIDE = 160
"""Pixels along the longer side of the outline in the search for the axis."""


class Carver:
    """Bodies of revolution inside one outline, given on a crop of the photo."""

    def __init__(self, camera: Camera, mask: Mask, distance: Field, left: int, top: int) -> None:
        """mask, distance: (h, w) and its signed distance in pixels; left, top: the crop's first pixel in the photo."""
        self._camera, self._mask, self._distance, self._left, self._top = camera, mask, distance, left, top
        step = max(1, max(mask.shape) // SIDE)
        # Every step-th pixel of a picture is a picture by a camera with larger pixels.
        self._small = mask[::step, ::step]
        self._small_camera = replace(
            camera,
            fx=camera.fx / step,
            fy=camera.fy / step,
            cx=(camera.cx - left - 0.5) / step + 0.5,
            cy=(camera.cy - top - 0.5) / step + 0.5,
        )

    def carve(self, x: float, y: float, highest: float, widest: float) -> Revolved | None:
        """The body about the vertical through ``x``, ``y``, up to ``highest`` and ``widest`` (units); None if none."""
        heights = np.linspace(0.0, highest, HEIGHTS)
        turn = 2.0 * np.pi * np.arange(AROUND) / AROUND
        axis = np.array([x, y])
        away = axis - self._camera.position[:2]
        away = away / max(float(np.linalg.norm(away)), 1e-12)
        circle = np.column_stack([np.cos(turn), np.sin(turn)])
        lateral = np.abs(circle @ away) < LATERAL
        pixel = float(self._camera.project(np.array([x, y, 0.0]))[2]) / self._camera.fx
        if pixel <= 0:
            return None

        def room(radii: Points) -> Field:
            ground = axis + radii[:, None, None] * circle[None]
            points = np.concatenate([ground, np.broadcast_to(heights[:, None, None], (*ground.shape[:2], 1))], axis=-1)
            at = self._camera.project(points)[..., :2] - [self._left + 0.5, self._top + 0.5]
            found = ndimage.map_coordinates(self._distance, at[..., ::-1].reshape(-1, 2).T, order=1, mode="nearest")
            return np.asarray(found).reshape(ground.shape[:2])

        low, high = np.zeros(HEIGHTS), np.full(HEIGHTS, widest)
        for _ in range(11):
            middle = (low + high) / 2.0
            fits = room(middle).min(axis=1) >= 0.0
            low, high = np.where(fits, middle, low), np.where(fits, high, middle)
        space = room(low)
        held = np.where(lateral[None], space, np.inf).min(axis=1) < space.min(axis=1) + 1.0
        solid = low > 1.5 * pixel
        if not solid[0] or not (held & solid).any():
            return None
        end = int(np.flatnonzero(held & solid)[-1]) + 1
        first_gap = np.flatnonzero(~solid[:end])
        end = int(first_gap[0]) if len(first_gap) else end
        if end < 3:
            return None
        radii = ndimage.gaussian_filter1d(low[:end], 0.7, mode="nearest")
        return Revolved(x, y, tuple(float(v) for v in heights[:end]), tuple(float(v) for v in radii))

    def overlap(self, body: Primitive) -> float:
        """Intersection over union with the outline, on the small picture."""
        image = drawn(body, self._small_camera, self._small.shape, 0.0, 0.0)
        return float((image & self._small).sum() / max(1, int((image | self._small).sum())))

    def best(self, guess: Revolved) -> Revolved | None:
        """The body with the largest overlap near ``guess``; a broad base counts a little."""
        scale = max(guess.radii)
        widest, highest = 4.0 * scale, TALLER * guess.height

        def loss(offset: Points) -> float:
            body = self.carve(guess.x + offset[0] * scale, guess.y + offset[1] * scale, highest, widest)
            if body is None:
                return 1.0
            return -self.overlap(body) - BROAD_BASE * min(1.0, body.radii[0] / max(body.radii))

        towards = np.array([guess.x, guess.y]) - self._camera.position[:2]
        towards /= max(float(np.linalg.norm(towards)), 1e-12)
        start = min((step * towards for step in (0.0, -0.4, 0.4, -0.8, 0.8)), key=loss)
        simplex = start + np.array([np.zeros(2), 0.2 * towards, 0.1 * np.array([-towards[1], towards[0]])])
        options = {"initial_simplex": simplex, "maxfev": 40, "xatol": 5e-3}
        found = minimize(loss, start, method="Nelder-Mead", options=options)
        return self.carve(guess.x + found.x[0] * scale, guess.y + found.x[1] * scale, highest, widest)
