# SPDX-License-Identifier: MIT
"""A depth map cut into the stage and the things that stand before it, each a surface of its own.

A depth map that is turned into one mesh has rubber sheets between near and far. Here it is cut where it jumps: a thing
has an outline and a smooth depth that goes on beyond it, and what it hides belongs to the stage.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..scene.model import Camera
from .canvas import Borders, grid, remapped
from .revealed import push_pull
from .stage import Stage

Mask = NDArray[np.bool_]

GROUND_SHARE = 0.06
"""Depth nearer to the stage's than this share is the stage: depth maps are no better, and nothing may swim on it."""
JUMP = 1.08
"""Ratio of neighbouring depths at which a surface ends."""
SMALLEST = 0.0005
"""Share of the image below which a part goes to its neighbour."""
MOST = 16
ROUNDS = 12
"""Steps of the search for where a pixel is on a thing; each leaves a tenth or so of the error of the last."""


@dataclass(frozen=True)
class Seen:
    """One thing as a camera sees it: where its pixels are on the canvas (h, w, 2), cover (h, w), mean depth, metres."""

    at: NDArray[np.float32]
    cover: NDArray[np.float32]
    depth: float


@dataclass(frozen=True, kw_only=True)
class Thing:
    """A surface before the stage, on the canvas.

    cover: (H, W) 0 to 1. depth: (H, W) metres along the photo camera's axis, also beyond its outline.
    """

    cover: NDArray[np.float32]
    depth: NDArray[np.float32]

    def seen(self, photo: Camera, camera: Camera, pixels: NDArray[np.float64], shift: NDArray[np.float64]) -> Seen:
        """As ``camera`` sees it at ``pixels`` (h, w, 2); ``shift`` (2,) leads from the photo to the canvas.

        What a pixel shows is found by iteration: guess where on the photo, look where the camera sees that, correct.
        """
        middle = float(np.median(self.depth[self.cover > 0.5]))
        # The first guess takes the thing for a plane across the photo camera's axis.
        at = photo.project(_on_plane(photo, camera, pixels, middle))[..., :2]
        at = np.where(np.isfinite(at), at, -1e4)
        for _ in range(ROUNDS):
            depth = remapped(self.depth, (at + shift).astype(np.float32))
            back = camera.project(photo.position + depth[..., None] * photo.rays(at))
            at = at + np.clip(pixels - back[..., :2], -200.0, 200.0)
        where = (at + shift).astype(np.float32)
        # Where the search has not settled, the surface turns away from the camera: nothing of it is seen.
        settled = np.linalg.norm(pixels - back[..., :2], axis=-1) < 1.0
        inside = np.asarray((where >= 0).all(-1) & (where[..., 0] <= self.cover.shape[1]) & (back[..., 2] > 0))
        cover = np.where(settled & inside, remapped(self.cover, where), 0.0).astype(np.float32)
        return Seen(at=where, cover=cover, depth=middle)


def _on_plane(photo: Camera, camera: Camera, pixels: NDArray[np.float64], depth: float) -> NDArray[np.float64]:
    """World points (..., 3) at ``depth`` of the photo's camera that ``camera`` sees at ``pixels`` (..., 2)."""
    axis = np.asarray(photo.world_from_camera, dtype=np.float64)[:3, 2]
    rays = camera.rays(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        length = (depth - (camera.position - photo.position) @ axis) / (rays @ axis)
    return np.asarray(camera.position + length[..., None] * rays)


def stage_depth(stage: Stage, photo: Camera, borders: Borders) -> NDArray[np.float64]:
    """Depth (H, W) of the stage on the canvas, metres along the axis of ``photo``, of the frames' size."""
    size = (photo.width + borders.left + borders.right, photo.height + borders.top + borders.bottom)
    pixels = grid(size) - np.array([borders.left, borders.top], dtype=np.float64)
    return np.asarray(photo.project(stage.hits(photo.position, photo.rays(pixels)))[..., 2])


@dataclass(frozen=True, kw_only=True)
class Cut:
    """What a depth map falls apart into, on the canvas.

    hidden: (H, W) where the things are. ratio: (H, W), depth of the background behind them over the stage's.
    """

    things: tuple[Thing, ...]
    hidden: Mask
    ratio: NDArray[np.float32]


def cut(depth: NDArray[np.floating], objects: Mask, stage: Stage, photo: Camera, borders: Borders) -> Cut:
    """The things in ``depth`` (h, w), and what is behind them.

    depth: of the photo, metres along the axis; not finite or not above 0: unknown. objects: (h, w) where the scene's
    own objects are, which are no background.
    """
    base = stage_depth(stage, photo, borders)
    inner = borders.inner((photo.width, photo.height))
    known = np.isfinite(depth) & (depth > 0)
    own = cv2.dilate(objects.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    # Unknown depth is the stage's; so is that under the objects.
    flat = np.where(known & ~own, depth, base[inner])
    things = flat < (1.0 - GROUND_SHARE) * base[inner]
    parts = _parts(things, flat)
    shape = base.shape
    found, where = [], np.zeros(shape, dtype=bool)
    for part in parts:
        cover = np.asarray(borders.padded(part))
        # What stands on the photo's border goes on beyond it, except the ground below.
        where |= cover
        distance, (rows, columns) = ndimage.distance_transform_edt(~cover, return_indices=True)
        spread = np.asarray(borders.padded(np.where(part, flat, 0.0)))[rows, columns]
        soft = cv2.GaussianBlur(spread.astype(np.float32), (0, 0), 3.0)
        smooth = np.where(distance > 0, soft, spread)
        edge = cv2.GaussianBlur(cover.astype(np.float32), (3, 3), 0.8)
        found.append(Thing(cover=edge.astype(np.float32), depth=smooth.astype(np.float32)))
    # What is not quite the stage, such as a wall nearer than the backdrop or beyond it, has its own depth; smoothly,
    # because a step would tear the surface.
    share = np.where(things, 1.0, flat / base[inner])
    away = np.clip((np.abs(share - 1.0) - GROUND_SHARE / 2) / GROUND_SHARE, 0.0, 1.0)
    wanted = (1.0 + (share - 1.0) * away * away * (3.0 - 2.0 * away)).astype(np.float32)
    behind = push_pull(np.repeat(wanted[..., None], 3, axis=-1), ~(things | own))[..., 0]
    return Cut(things=tuple(found), hidden=where, ratio=np.asarray(borders.padded(behind), dtype=np.float32))


def _parts(things: Mask, depth: NDArray[np.floating]) -> list[Mask]:
    """``things`` (h, w) cut where ``depth`` jumps; small parts go to the nearest large one."""
    kernel = np.ones((3, 3), np.uint8)
    values = depth.astype(np.float32)
    jumps = cv2.dilate(values, kernel) > JUMP * cv2.erode(values, kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((things & ~jumps).astype(np.uint8), connectivity=4)
    areas = stats[1:count, cv2.CC_STAT_AREA]
    large = [int(i) + 1 for i in np.argsort(areas)[::-1][:MOST] if areas[i] >= SMALLEST * things.size]
    if not large:
        return []
    keep = np.isin(labels, large)
    rows, columns = ndimage.distance_transform_edt(~keep, return_indices=True)[1]
    owner = np.where(things, labels[rows, columns], 0)
    return [np.asarray(owner == label) for label in large]
