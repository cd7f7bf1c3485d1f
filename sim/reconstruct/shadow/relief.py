# SPDX-License-Identifier: MIT
"""Points of a simple body behind a mask: enough to cast a shadow before the object has a shape of its own."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from ..shape.inflate import roundness
from ..view.camera import on_ground

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
Values = NDArray[np.float64]

SAMPLES = 1000
"""Pixels of a mask that become points of the body, in each of its layers."""
FEWEST = 20
"""Pixels below which a mask has no shape."""
LAYERS = tuple(np.linspace(-1.0, 1.0, 9))
"""Depths of the layers over the half thickness."""
LEAN = 0.73
"""How far the wall that carries a round outline leans back, over the angle by which one looks down on it: from where a
ball's lowest ray meets the ground to where its highest one touches it, at middling angles."""
FORWARD = 0.15
"""How far behind that wall the middle of a round body lies, over its radius."""
ROUND = 0.5
"""``shape.inflate.roundness`` above which an outline is a ball's."""
BOX_DEPTH = 0.8
"""Depth over width of all other bodies."""


@dataclass(frozen=True)
class Relief:
    """Points (M, 3) on and in a body, world units; foot: (2,) where it meets the ground; height: of its top."""

    points: Points
    foot: Points
    height: float


def relief(mask: Mask, camera: Camera) -> Relief | None:
    """A body with the outline ``mask`` (H, W), as thick as round, on the ground z = 0, or None where it cannot stand.

    Each pixel of the mask is put on a wall through the object's lowest point and given the thickness of a round body.
    None: an empty mask, or one whose lowest point lies above the horizon.
    """
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return None
    step = max(1, int(np.sqrt(len(rows) / SAMPLES)))
    kept = (rows % step == 0) & (columns % step == 0)
    if kept.sum() < FEWEST:
        kept = np.ones(len(rows), dtype=bool)
    distance = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    deep = distance[rows, columns].astype(np.float64)
    rays = camera.rays(np.column_stack([columns + 0.5, rows + 0.5]))
    # The steepest ray meets the ground nearest to the camera; a few pixels are no reason to trust it.
    fall = -rays[:, 2] / np.maximum(np.linalg.norm(rays[:, :2], axis=1), 1e-9)
    lowest = fall >= np.quantile(fall, 1.0 - min(0.02, 30.0 / len(fall))) - 1e-9
    pixel = np.array([columns[lowest].mean() + 0.5, rows[lowest].max() + 0.5])
    foot = on_ground(camera, pixel)
    if not np.isfinite(foot).all():
        return None
    away = foot[:2] - camera.position[:2]
    reach = max(float(np.linalg.norm(away)), 1e-9)
    away = away / reach if reach > 1e-9 else np.array([0.0, 1.0])
    radius = float(deep.max()) * float(np.linalg.norm(foot - camera.position)) / camera.fx
    depth = 2.0 * BOX_DEPTH * radius
    crop = mask[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    round_body = len(rows) >= FEWEST and roundness(crop) > ROUND
    if not round_body:
        # The highest ray passes the far upper edge, the lowest one the near lower edge.
        top = camera.position[2] - float(np.quantile(fall, 0.01)) * (reach + depth)
        lean = float(np.arctan2(depth, max(top, 0.2 * depth)))
    else:
        lean = LEAN * float(np.arctan2(camera.position[2], reach))
    normal = np.array([*(-away * np.cos(lean)), np.sin(lean)])
    toward = rays[kept] @ normal
    usable = toward < -1e-6
    along = ((foot - camera.position) @ normal) / np.where(usable, toward, -1.0)
    wall = camera.position + along[:, None] * rays[kept]
    usable &= (along > 0) & (np.linalg.norm(wall - foot, axis=1) < 20.0 * radius)
    back = np.array([*away, 0.0])
    if not round_body:
        behind = (wall - foot) @ back
        half = 0.5 * depth * _across(rows, columns)[kept]
        offsets = [0.5 * depth + layer * half - behind for layer in LAYERS]
    else:
        half = np.sqrt(np.clip(deep[kept] * (2.0 * deep.max() - deep[kept]), 0.0, None)) * along / camera.fx
        offsets = [FORWARD * radius + layer * half for layer in LAYERS]
    points = np.concatenate([(wall + offset[:, None] * back)[usable] for offset in offsets])
    points[:, 2] = np.maximum(points[:, 2], 0.0)
    if not len(points):
        return None
    return Relief(points=points, foot=foot[:2], height=float(points[:, 2].max()))


def _across(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Values:
    """How deep a body is at these pixels over how deep it is in its middle, between a box and a cylinder."""
    left, right = np.full(rows.max() + 1, np.iinfo(np.int64).max), np.full(rows.max() + 1, -1)
    np.minimum.at(left, rows, columns)
    np.maximum.at(right, rows, columns)
    place = (2.0 * columns - left[rows] - right[rows]) / (right[rows] - left[rows] + 1.0)
    return np.asarray((1.0 - place**4) ** 0.25)
