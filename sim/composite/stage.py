# SPDX-License-Identifier: MIT
"""The background as geometry where only the ground is known: a stage of ground and an upright backdrop behind it.

A bend joins them, so that lines on the ground do not break where it ends. The stage is convex towards the camera: seen
from anywhere in front of the backdrop, each pixel sees it once, and nothing hides anything. So there are no meshes to
be torn; where a pixel of a moved camera is on the photo follows in closed form, exactly, which keeps things on the
ground where they stand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene.camera_move import level_forward
from ..scene.model import Camera, Ground

FloatArray = NDArray[np.float64]

DEEP = 4.0
"""Distance of the backdrop over that of the farthest object: near enough that the horizon is finite, far enough that
lines on the ground run straight over all that one looks at."""
CLEAR = 1.6
"""The least of it."""
BEND = 0.35
"""The bend begins this share of the distance before the backdrop, and ends as high above the ground."""
ENDLESS = 1e3
"""A ray that never meets the stage ends at this many distances of the backdrop: as good as infinity."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Ground and backdrop.

    origin: point on the ground below the photo's camera. up, forward: unit vectors; the backdrop faces backward.
    distance: metres along ``forward`` from ``origin`` to the backdrop. bend: radius in metres of what joins them.
    """

    origin: FloatArray
    up: FloatArray
    forward: FloatArray
    distance: float
    bend: float

    def hits(self, eye: FloatArray, rays: FloatArray) -> FloatArray:
        """Where rays (..., 3) from ``eye`` (3,) meet the stage (..., 3), metres."""
        height, ahead = float((eye - self.origin) @ self.up), float((eye - self.origin) @ self.forward)
        rise, run = rays @ self.up, rays @ self.forward
        end = ENDLESS * self.distance / np.maximum(np.linalg.norm(rays, axis=-1), 1e-12)
        with np.errstate(divide="ignore", invalid="ignore"):
            ground = np.where(rise < 0, -height / rise, np.inf)
            wall = np.where(run > 0, (self.distance - ahead) / run, np.inf)
        length = np.minimum(np.minimum(ground, wall), end)
        with np.errstate(invalid="ignore"):
            length = np.where(self._cut(height, ahead, rise, run, length), self._bend(height, ahead, rise, run), length)
        return np.asarray(eye + length[..., None] * rays)

    def _cut(
        self, height: float, ahead: float, rise: FloatArray, run: FloatArray, length: FloatArray
    ) -> NDArray[np.bool_]:
        """Which rays end in the corner that the bend cuts off."""
        over, along = height + length * rise, ahead + length * run
        return (over < self.bend) & (along > self.distance - self.bend)

    def _bend(self, height: float, ahead: float, rise: FloatArray, run: FloatArray) -> FloatArray:
        """Length at which rays leave the cylinder of the bend: the farther root."""
        a = rise**2 + run**2
        up, out = height - self.bend, ahead - (self.distance - self.bend)
        b, c = up * rise + out * run, up**2 + out**2 - self.bend**2
        return np.asarray((-b + np.sqrt(np.maximum(b * b - a * c, 0.0))) / np.maximum(a, 1e-30))


def make_stage(
    camera: Camera, ground: Ground, vertices: Sequence[NDArray[np.floating]], distance: float | None = None
) -> Stage:
    """The stage of what ``camera``, the photo's, sees; ``vertices`` (V, 3) of the objects, world metres.

    distance: of the backdrop, metres; None puts it behind all ground that is seen, or, where the ground runs to the
    horizon, at ``DEEP`` times the farthest object.
    """
    up = ground.unit_normal
    turn = np.asarray(camera.world_from_camera, dtype=np.float64)[:3, :3]
    forward = level_forward(turn, up)
    height = float(ground.heights(camera.position))
    origin = camera.position - height * up
    farthest = max(float(((np.asarray(v) - origin) @ forward).max()) for v in vertices)
    farthest = max(farthest, 0.5 * height)
    if distance is None:
        distance = min(max(2.0 * _seen_ground(camera, up, forward, height), CLEAR * farthest), DEEP * farthest)
    return Stage(origin=origin, up=up, forward=forward, distance=distance, bend=BEND * distance)


def _seen_ground(camera: Camera, up: FloatArray, forward: FloatArray, height: float) -> float:
    """How far away along ``forward`` is the farthest ground that the photo shows; infinite up to the horizon."""
    x = np.array([0.0, camera.width])
    corners = np.stack(np.meshgrid(x, [0.0, float(camera.height)]), axis=-1).reshape(-1, 2)
    rays = camera.rays(corners)
    rise, run = rays @ up, rays @ forward
    with np.errstate(divide="ignore"):
        return float(np.where(rise < 0, -height * run / rise, np.inf).max())
