# SPDX-License-Identifier: GPL-3.0-or-later
"""Image regions that objects and their shadows can affect, so that nothing else is rendered. Needs no bpy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...sim.plane_axes import plane_axes
from ...sim.scene.model import Camera, SceneModel
from ...sim.smoothstep import smoothstep

MARGIN_PX = 3
SHADOW_REACH = 4.0
"""Distance around an object to which its contact shadow is rendered, over its height above the ground. Beyond, it takes
less than about 1/250 of the light of an even sky.
"""
NEAR_REACH = 0.15
"""The same for the finely rendered part; beyond, the sky's shadow varies slowly."""
MIN_DEPTH_M = 1e-3


class Box(NamedTuple):
    """Pixels x0 ≤ x < x1, y0 ≤ y < y1, origin at the top left."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def width(self) -> int:
        """Width in pixels."""
        return self.x1 - self.x0

    @property
    def height(self) -> int:
        """Height in pixels."""
        return self.y1 - self.y0

    @property
    def slices(self) -> tuple[slice, slice]:
        """Slices of rows and columns, to index an image."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)


def object_box(
    camera: Camera, vertices: Sequence[NDArray[np.floating]], size: tuple[int, int], reach: float = 0.0
) -> Box | None:
    """Return the pixels of an image of ``size`` (width, height) covered by ``vertices`` (V, 3); None out of view.

    reach: margin in metres around a vertex.
    """
    points = np.concatenate([np.asarray(v) for v in vertices])
    near = max(float(camera.project(points)[:, 2].min()), MIN_DEPTH_M)
    margin = reach * max(camera.fx * size[0] / camera.width, camera.fy * size[1] / camera.height) / near
    return _bounds(camera, points, size, MARGIN_PX + math.ceil(min(margin, max(size))))


class ShadowRegion(NamedTuple):
    """Region of possible shadows: pixels, and the depth in metres beyond which there are none."""

    box: Box
    far: float


def shadow_region(
    scene: SceneModel,
    vertices: Sequence[NDArray[np.floating]],
    size: tuple[int, int],
    *,
    sky_reach: float = SHADOW_REACH,
    lamps: Sequence[tuple[NDArray[np.float64], float]] = (),
) -> ShadowRegion | None:
    """Return the pixels whose ground the objects can darken: along sun and lamps with their penumbras, and all around
    by the sky.

    sky_reach: margin all around, over the height of an object's top. lamps: of the environment, unit vectors (3,)
    towards them and their diameters in radians.
    """
    light = scene.light
    if light.sun_direction is not None and light.sun_strength > 0:
        lamps = [(np.asarray(light.sun_direction), light.sun_angle), *lamps]
    found = []
    for points in (_footprint(scene, v, sky_reach, lamps) for v in vertices):
        box = _bounds(scene.camera, points, size, MARGIN_PX)
        if box is not None:
            found.append((box, float(scene.camera.project(points)[:, 2].max())))
    if not found:
        return None
    boxes = [box for box, _ in found]
    box = Box(min(b.x0 for b in boxes), min(b.y0 for b in boxes), max(b.x1 for b in boxes), max(b.y1 for b in boxes))
    return ShadowRegion(box, max(far for _, far in found))


def ground_depth(scene: SceneModel, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return the depth (H, W) in metres along the optical axis at which each pixel sees the ground, else infinity."""
    width, height = size
    camera, normal = scene.camera, np.asarray(scene.ground_plane.normal)
    x = (np.arange(width) + 0.5) * camera.width / width
    y = (np.arange(height) + 0.5) * camera.height / height
    rays = camera.rays(np.stack(np.meshgrid(x, y), axis=-1))
    drop = (np.asarray(scene.ground_plane.point) - camera.position) @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = drop / (rays @ normal)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.inf).astype(np.float32)


def _footprint(
    scene: SceneModel,
    vertices: NDArray[np.floating],
    sky_reach: float,
    lamps: Sequence[tuple[NDArray[np.float64], float]],
) -> NDArray[np.float64]:
    """Return points (N, 3) on the ground whose hull contains one object's shadow."""
    normal, origin = np.asarray(scene.ground_plane.normal), np.asarray(scene.ground_plane.point)
    points = np.asarray(vertices, dtype=np.float64)
    heights = np.clip((points - origin) @ normal, 0.0, None)
    feet = points - ((points - origin) @ normal)[:, None] * normal
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    reach = sky_reach * max(float(heights.max()), 0.25 * size)
    spans = [_grown(feet, normal, reach)]
    for direction, angle in lamps:
        cosine = max(float(direction @ normal), 0.05)
        # Half the lamp's disc either way, stretched by its inclination to the ground.
        penumbra = float(heights.max()) * math.tan(min(angle, 2.5) / 2) / cosine**2
        shadow = feet - heights[:, None] * (direction / cosine - normal)
        spans.append(_grown(shadow, normal, penumbra + 0.05 * size))
    return np.concatenate(spans)


def _grown(points: NDArray[np.float64], normal: NDArray[np.floating], by: float) -> NDArray[np.float64]:
    """Return a grid on the plane over the bounding box of ``points`` (N, 3) grown by ``by``.

    A grid, because one of four corners may lie behind the camera.
    """
    axes = np.stack(plane_axes(normal))
    flat = points @ axes.T
    low, high = flat.min(axis=0) - by, flat.max(axis=0) + by
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 17).T), axis=-1).reshape(-1, 2)
    return np.asarray(grid @ axes + float(points.mean(axis=0) @ normal) * normal)


def _bounds(camera: Camera, points: NDArray[np.floating], size: tuple[int, int], margin: int) -> Box | None:
    width, height = size
    projected = camera.project(points)
    ahead = projected[:, 2] > MIN_DEPTH_M
    if not ahead.any():
        return None
    if not ahead.all():
        return Box(0, 0, width, height)
    x = projected[:, 0] * (width / camera.width)
    y = projected[:, 1] * (height / camera.height)
    x0, x1 = math.floor(max(x.min(), -1e6)) - margin, math.ceil(min(x.max(), 1e6)) + margin
    y0, y1 = math.floor(max(y.min(), -1e6)) - margin, math.ceil(min(y.max(), 1e6)) + margin
    box = Box(max(x0, 0), max(y0, 0), min(x1, width), min(y1, height))
    return box if box.width > 0 and box.height > 0 else None


def feather(box: Box, size: tuple[int, int], share: float = 0.12) -> NDArray[np.float32]:
    """Return weights (H, W) of ``box`` that fall smoothly to 0 at its sides, except where these are the image's own."""

    def ramp(count: int, at_start: bool, at_end: bool) -> NDArray[np.float32]:
        width = max(1.0, share * count)
        position = np.arange(count) + 0.5
        weight = np.ones(count)
        if not at_start:
            weight = np.minimum(weight, position / width)
        if not at_end:
            weight = np.minimum(weight, (count - position) / width)
        return smoothstep(weight).astype(np.float32)

    width, height = size
    rows = ramp(box.height, box.y0 == 0, box.y1 == height)
    columns = ramp(box.width, box.x0 == 0, box.x1 == width)
    return rows[:, None] * columns
