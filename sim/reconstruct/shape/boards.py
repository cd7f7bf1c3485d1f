# SPDX-License-Identifier: MIT
"""Boards: slabs of the world cut by regions of the photo, and the mesh of their union, by marching cubes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..camera.ground_camera import depth_below, ground_depth
from .inflate import Crop, signed_distance
from .inflated_mesh import BodyMesh, standing_mesh
from .surface_mesh import RayField, relax, surface_of_size

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

OVERLAP_PX = 3.0
"""Pixels by which neighbouring regions overlap, so that their boards are joined."""
MARGIN_PX = 6.0
"""Depth of the grid before and behind the boards."""
FOOT_PX = 2.0
"""Height over the ground in pixels of what stands on it: outlines of feet are no better known."""
FINEST_SHARE = 0.25
"""Smallest step in depth over the step in the photo's plane."""


@dataclass(frozen=True)
class Slab:
    """All points of the world whose position · normal lies between ``low`` and ``high``. normal: (3,) unit."""

    normal: Points
    low: float
    high: float


@dataclass(frozen=True)
class Board:
    """Material inside all ``slabs`` where the photo shows ``region`` (h, w), bool on the crop."""

    region: Mask
    slabs: tuple[Slab, ...]


def level_slab(low: float, high: float) -> Slab:
    """Return what lies between the heights ``low`` and ``high``, m."""
    return Slab(np.array([0.0, 0.0, 1.0]), low, high)


@dataclass(frozen=True)
class GroundAxes:
    """Axes of a piece on the ground. across, away: (2,) unit; coordinates u and v along them, m."""

    across: Points
    away: Points

    def u(self, points: Points) -> Points:
        """Return how far across ``points`` (..., 2 or 3) are."""
        return np.asarray(points[..., :2] @ self.across)

    def v(self, points: Points) -> Points:
        """Return how far away ``points`` (..., 2 or 3) are."""
        return np.asarray(points[..., :2] @ self.away)

    def slab(self, low: float, high: float) -> Slab:
        """Return what lies between the upright planes at v = ``low`` and ``high``."""
        return Slab(np.array([self.away[0], self.away[1], 0.0]), low, high)

    def around(self, v: float, thickness: float) -> Slab:
        """Return the upright slab of ``thickness`` whose middle is at ``v``."""
        return self.slab(v - thickness / 2.0, v + thickness / 2.0)

    def heights_on(self, camera: Camera, rays: Points, v: float) -> Points:
        """Return the heights (n) at which ``rays`` (n, 3) meet the upright plane at ``v``."""
        facing = np.maximum(rays[:, :2] @ self.away, 1e-3)
        depth = (v - float(self.v(camera.position))) / facing
        return np.asarray(camera.position[2] + depth * rays[:, 2])

    def reach_on(self, camera: Camera, rays: Points, height: float) -> Points:
        """Return the v (n) at which ``rays`` (n, 3) meet the level plane at ``height``; inf if they do not."""
        depth = depth_below(float(camera.position[2] - height), -rays[:, 2])
        with np.errstate(invalid="ignore"):
            found = float(self.v(camera.position)) + depth * (rays[:, :2] @ self.away)
        return np.asarray(np.where(np.isfinite(depth), found, np.inf))


class BoardField(RayField):
    """φ of the union of boards, in pixels. t: pixels behind the depth of their middle."""

    def __init__(self, camera: Camera, crop: Crop, boards: Sequence[Board]) -> None:
        self._camera, self._crop, self._boards = camera, crop, boards
        self._regions = [np.minimum(crop.distance, signed_distance(board.region) + OVERLAP_PX) for board in boards]
        low, high = np.inf, -np.inf
        rays = camera.rays(crop.pixels())
        ground = ground_depth(camera, rays)
        for board in boards:
            inside = board.region.ravel()
            slab = board.slabs[0]
            facing = rays[inside] @ slab.normal
            facing = np.where(np.abs(facing) < 1e-3, np.copysign(1e-3, facing), facing)
            ends = np.stack([(side - camera.position @ slab.normal) / facing for side in (slab.low, slab.high)])
            ends = np.minimum(ends, ground[inside])
            ends = ends[:, np.isfinite(ends).all(axis=0) & (ends > 0).all(axis=0)]
            if ends.size:
                low, high = min(low, float(ends.min())), max(high, float(np.quantile(ends.max(axis=0), 0.999)))
        self._middle = (low + high) / 2.0
        self.unit = self._middle / camera.fx
        self._range = ((low - self._middle) / self.unit - MARGIN_PX, (high - self._middle) / self.unit + MARGIN_PX)
        self.thinnest = min((slab.high - slab.low) / self.unit for board in boards for slab in board.slabs)

    def sample(self, points: Points) -> tuple[Points, Points]:
        """Return boards and ground (n), (n) at ``points`` (n, 3), in pixels."""
        at, world = points[:, 1::-1].T, self.world(points[:, :2], points[:, 2])
        best = np.full(len(points), -np.inf)
        for board, region in zip(self._boards, self._regions, strict=True):
            inside = np.full(len(points), np.inf)
            for slab in board.slabs:
                along = world @ slab.normal
                inside = np.minimum(inside, np.minimum(along - slab.low, slab.high - along) / self.unit)
            near = inside > best
            if near.any():
                cut = ndimage.map_coordinates(region, at[:, near], order=1, mode="nearest")
                best[near] = np.maximum(best[near], np.minimum(inside[near], cut))
        return best, world[:, 2] / self.unit

    def value(self, points: Points) -> Points:
        """Return φ (n,) at ``points`` (n, 3)."""
        body, ground = self.sample(points)
        return np.minimum(body, ground)

    def grid(self, spacing: float) -> tuple[NDArray[np.float32], Points, Points]:
        """Return φ on a grid (x, y, t), its first corner (3,) and its steps (3,)."""
        height, width = self._crop.mask.shape
        steps = np.array([spacing, spacing, max(min(spacing, self.thinnest / 3.0), FINEST_SHARE * spacing)])
        low, high = self._range
        first = np.array([0.25, 0.25, low])
        counts = (int((width - 1) // spacing) + 1, int((height - 1) // spacing) + 1, int((high - low) // steps[2]) + 2)
        return self.sampled(first, steps, counts), first, steps


def board_mesh(camera: Camera, crop: Crop, boards: Sequence[Board], target: int) -> tuple[BodyMesh, float]:
    """Return the closed surface of ``boards`` with the outline of ``crop``, about ``target`` vertices, on the ground.

    Also the share of it that was disconnected and removed. Raises InputError when the outline is too thin for a closed
    surface.
    """
    field = BoardField(camera, crop, boards)
    points, faces, lost = surface_of_size(field, float(crop.mask.sum()), target)
    points = relax(field, points, faces)
    pixels, depth, ground = field.depths(points)
    # Feet that end within a pixel or two of the ground stand on it.
    height = camera.position[2] + depth * camera.rays(pixels)[:, 2]
    depth = np.where(height < FOOT_PX * field.unit, ground, np.minimum(depth, ground))
    return standing_mesh(camera, pixels, depth, faces), lost
