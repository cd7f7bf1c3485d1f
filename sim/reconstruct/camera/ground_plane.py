# SPDX-License-Identifier: MIT
"""Fit the ground plane under the objects to a depth map, by RANSAC (Fischler & Bolles, 1981).

In the camera's axes a plane n·p = −h at depth z has 1/z = −n·r / h along the ray r = (x/f, y/f, 1): inverse depth on a
plane is linear in the pixel, whatever its scale. Disparity is inverse depth scaled and shifted, so it is linear as
well: its gradient gives the roll; the shift, and with it the pitch, is bounded only by the farthest points, whose
inverse depth is not negative.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .depth_map import DepthMap
from .ground_camera import pitch_and_roll

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

POINTS = 5000
ROUNDS = 400
TOLERANCE = 0.02
"""Inlier tolerance, relative to the depth (to the range, for disparity)."""
LEAST_INLIERS = 0.25
"""Smallest weighted share of inliers."""
NEAR_WEIGHT = 4.0
"""Weight of points beside and below the objects: the plane they stand on counts, not the floor beyond."""
BLOCKS = 8
FLOOR_SIGMA_DEG = 0.7
"""Depth maps by networks bend by about this much, which the jackknife cannot measure."""
SHIFT_SIGMA_DEG = 8.0
"""Standard deviation of the pitch from disparity of unknown shift."""
PITCH_LIMITS_DEG, ROLL_LIMIT_DEG = (-15.0, 89.0), 45.0


@dataclass(frozen=True)
class GroundPlane:
    """The ground in the camera's axes (x right, y down, z forward).

    normal: (3,) unit, upward. camera_height: above the ground, in the map's lengths; metres if ``metric``. pitch, roll
    and their standard deviations: radians. inliers: weighted share of inliers beside the objects.
    """

    normal: Array
    camera_height: float
    metric: bool
    pitch: float
    roll: float
    pitch_sigma: float
    roll_sigma: float
    inliers: float


def fit_ground_plane(depth: DepthMap, focal: float, masks: Sequence[Mask]) -> GroundPlane | None:
    """Return the plane under the objects ``masks`` (H, W) in ``depth``; None if there is none.

    focal: pixels of the photo.
    """
    nearness = np.asarray(depth.nearness, dtype=np.float64)
    pixels, weight = _points(nearness, masks)
    if len(pixels) < 50:
        return None
    value = nearness[pixels[:, 1], pixels[:, 0]]
    height, width = nearness.shape
    rays = np.column_stack([(pixels + 0.5 - np.array([width, height]) / 2.0) / focal, np.ones(len(pixels))])
    if depth.disparity:
        value = value - np.percentile(nearness[np.isfinite(nearness)], 0.5)
        allowed = np.full(len(value), TOLERANCE * float(np.percentile(value, 98)))
    else:
        # A relative error of the depth is the same relative error of its inverse.
        allowed = TOLERANCE * value
    if not (np.isfinite(value).all() and float(np.max(np.abs(value))) > 0):
        return None
    scale = float(np.median(np.abs(value)))
    value, allowed = value / scale, np.maximum(allowed / scale, 1e-9)
    plane = _consensus(rays, value, allowed, weight)
    if plane is None:
        return None
    slope, inside = plane
    share = float(weight[inside].sum() / weight.sum())
    if share < LEAST_INLIERS:
        return None
    normal, pitch, roll = _pose(slope)
    pitch_sigma, roll_sigma = _spread(rays[inside], value[inside], allowed[inside], pixels[inside], slope)
    if depth.disparity:
        pitch_sigma = math.hypot(pitch_sigma, math.radians(SHIFT_SIGMA_DEG))
    return GroundPlane(
        normal=normal,
        camera_height=1.0 / (float(np.linalg.norm(slope)) * scale),
        metric=depth.metric,
        pitch=pitch,
        roll=roll,
        pitch_sigma=pitch_sigma,
        roll_sigma=roll_sigma,
        inliers=share,
    )


def _points(nearness: Array, masks: Sequence[Mask]) -> tuple[NDArray[np.int64], Array]:
    """Pixels (N, 2) off the objects as x, y, on a regular grid, and their weights (N,)."""
    height, width = nearness.shape
    objects = np.zeros((height, width), np.uint8)
    near = np.zeros((height, width), np.uint8)
    for mask in masks:
        rows, columns = np.nonzero(mask)
        if not len(rows):
            continue
        objects |= mask.astype(np.uint8)
        reach = round(0.5 * max(np.ptp(rows), np.ptp(columns))) + 2
        foot = int(rows.max())
        top, left = max(foot - reach // 2, 0), max(int(columns.min()) - reach, 0)
        near[top : foot + reach, left : int(columns.max()) + reach] = 1
    # Depth is unreliable along edges.
    blocked = cv2.dilate(objects, np.ones((2 * (max(height, width) // 150) + 1,) * 2, np.uint8))
    usable = np.isfinite(nearness) & (blocked == 0)
    step = max(1, round(math.sqrt(height * width / POINTS)))
    rows, columns = (side.ravel() for side in np.mgrid[step // 2 : height : step, step // 2 : width : step])
    kept = usable[rows, columns]
    rows, columns = rows[kept], columns[kept]
    return np.column_stack([columns, rows]), np.where(near[rows, columns] > 0, NEAR_WEIGHT, 1.0)


def _pose(slope: Array) -> tuple[Array, float, float]:
    """Upward normal, pitch and roll of the plane whose inverse depth along a ray r is ``slope`` · r; it lies below."""
    normal = -slope / np.linalg.norm(slope)
    return normal, *pitch_and_roll(normal)


def _consensus(rays: Array, value: Array, allowed: Array, weight: Array) -> tuple[Array, NDArray[np.bool_]] | None:
    """The plane's slope (3,) and its inliers; None if no plane could be a ground."""
    rng = np.random.default_rng(0)
    triple = rng.choice(len(rays), size=(ROUNDS, 3), p=weight / weight.sum())
    systems, right = rays[triple], value[triple]
    sound = np.abs(np.linalg.det(systems)) > 1e-6
    if not sound.any():
        return None
    slopes = np.linalg.solve(systems[sound], right[sound][..., None])[..., 0]
    slopes = slopes[[_is_ground(slope) for slope in slopes]]
    if not len(slopes):
        return None
    off = np.abs(slopes @ rays.T - value) / allowed
    best = slopes[int(np.argmax((np.maximum(1.0 - off**2, 0.0)) @ weight))]
    inside = np.abs(rays @ best - value) < allowed
    for _ in range(5):
        if inside.sum() < 30:
            return None
        best = _least_squares(rays[inside], value[inside], allowed[inside])
        inside = np.abs(rays @ best - value) < allowed
    return (best, inside) if inside.sum() >= 30 and _is_ground(best) else None


def _is_ground(slope: Array) -> bool:
    if not np.isfinite(slope).all() or not float(np.linalg.norm(slope)) > 1e-9:
        return False
    _, pitch, roll = _pose(slope)
    low, high = PITCH_LIMITS_DEG
    return low < math.degrees(pitch) < high and abs(math.degrees(roll)) < ROLL_LIMIT_DEG


def _least_squares(rays: Array, value: Array, allowed: Array) -> Array:
    return np.asarray(np.linalg.lstsq(rays / allowed[:, None], value / allowed, rcond=None)[0])


def _spread(rays: Array, value: Array, allowed: Array, pixels: NDArray[np.int64], slope: Array) -> tuple[float, float]:
    """Standard deviations of pitch and roll: a jackknife over blocks, because neighbouring errors are correlated."""
    _, pitch, roll = _pose(slope)
    column = np.argsort(np.argsort(pixels[:, 0], kind="stable")) * (BLOCKS // 2) // len(pixels)
    row = np.argsort(np.argsort(pixels[:, 1], kind="stable")) * 2 // len(pixels)
    block = column + (BLOCKS // 2) * row
    found = []
    for left_out in np.unique(block):
        kept = block != left_out
        if kept.sum() >= 10:
            found.append(_pose(_least_squares(rays[kept], value[kept], allowed[kept]))[1:])
    floor = math.radians(FLOOR_SIGMA_DEG)
    if len(found) < 2:
        return 10 * floor, 10 * floor
    off = np.array(found) - np.array([pitch, roll])
    pitch_sigma, roll_sigma = np.sqrt((len(found) - 1) / len(found) * (off**2).sum(axis=0))
    return math.hypot(float(pitch_sigma), floor), math.hypot(float(roll_sigma), floor)
