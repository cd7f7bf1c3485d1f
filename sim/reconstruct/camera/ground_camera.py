# SPDX-License-Identifier: MIT
"""A pinhole camera above flat ground, 1 unit high until the scale is known.

World axes: X to the right of the camera and level, Y away from it, Z up; the ground is z = 0. Pitch p is the angle of
the optical axis below the horizontal, roll r the rotation about it, positive where the horizon falls to the right. In
pixels (x, y) from the middle of the photo, with focal length f, the horizon is the line y = x tan r − f tan p / cos r.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera, Matrix4

DEFAULT_FOV_DEG = 50.0
"""Angle of view along the longer side: between a phone's main camera (65°) and its portrait lens (40°)."""
DEFAULT_PITCH_DEG = 25.0
"""Usual pitch for objects on a table."""
MIN_DECLINATION_DEG = 4.0
"""Smallest angle of a contact below the horizon; nearer ones would lie many object sizes away."""


def focal_of_fov(width: int, height: int, fov_deg: float) -> float:
    """Return the focal length in pixels of an angle of view along the longer side."""
    return max(width, height) / 2.0 / math.tan(math.radians(fov_deg) / 2.0)


def fov_of_focal(width: int, height: int, focal: float) -> float:
    """Return the angle of view in degrees along the longer side."""
    return 2.0 * math.degrees(math.atan(max(width, height) / 2.0 / focal))


def camera_above_ground(width: int, height: int, focal: float, pitch: float, roll: float = 0.0) -> Camera:
    """Return a camera 1 unit above the origin that looks along +Y, ``pitch`` radians downward, rolled by ``roll``
    radians.

    focal: pixels.
    """
    axes = camera_from_world(pitch, roll).T
    pose: Matrix4 = (
        (float(axes[0, 0]), float(axes[0, 1]), float(axes[0, 2]), 0.0),
        (float(axes[1, 0]), float(axes[1, 1]), float(axes[1, 2]), 0.0),
        (float(axes[2, 0]), float(axes[2, 1]), float(axes[2, 2]), 1.0),
        (0.0, 0.0, 0.0, 1.0),
    )
    return Camera(
        width=width, height=height, fx=focal, fy=focal, cx=width / 2.0, cy=height / 2.0, world_from_camera=pose
    )


def camera_from_world(pitch: float | NDArray[np.float64], roll: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotations (..., 3, 3) from world axes to the camera's (x right, y down, z forward), for angles (...) in
    radians.

    Their columns are the world's right, away and up in the camera's axes.
    """
    sp, cp, sr, cr = np.broadcast_arrays(np.sin(pitch), np.cos(pitch), np.sin(roll), np.cos(roll))
    rows = ((cr, sr * sp, sr * cp), (sr, -cr * sp, -cr * cp), (np.zeros_like(sp), cp, -sp))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def pitch_and_roll(up: NDArray[np.floating]) -> tuple[float, float]:
    """Return pitch and roll in radians of a camera in whose axes the world's up is ``up`` (3,)."""
    x, y, z = (float(v) for v in np.asarray(up, dtype=np.float64) / np.linalg.norm(up))
    return math.asin(max(-1.0, min(1.0, -z))), math.atan2(x, -y)


def up_in_camera(camera: Camera) -> NDArray[np.float64]:
    """Return the ground's normal (3,) in the camera's axes (x right, y down, z forward)."""
    return np.asarray(camera.world_from_camera, dtype=np.float64)[2, :3]


def horizon_at_edges(camera: Camera) -> tuple[float, float]:
    """Return the rows in pixels where the horizon meets the left and the right edge; may lie outside the photo."""
    x, y, z = up_in_camera(camera)
    left, right = (camera.cy - camera.fy * (x * (c - camera.cx) / camera.fx + z) / y for c in (0.0, camera.width))
    return float(left), float(right)


def declination(camera: Camera, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the angles (...) in radians below the horizontal of ``pixels`` (..., 2)."""
    rays = camera.rays(pixels)
    return np.arcsin(np.clip(-rays[..., 2] / np.linalg.norm(rays, axis=-1), -1.0, 1.0))


def stands_below(camera: Camera, contact: NDArray[np.floating]) -> bool:
    """Return whether the pixel ``contact`` (2,) is far enough below the horizon for something to stand there."""
    return float(declination(camera, contact)) >= math.radians(MIN_DECLINATION_DEG * 0.5)


def depth_below(height: float, descent: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the depth (...) along the optical axis at which rays meet a plane ``height`` below the camera; inf if
    they do not.

    descent: (...) of rays of unit depth toward the plane, along its normal.
    """
    with np.errstate(divide="ignore"):
        return np.where(descent > 1e-9, height / np.maximum(descent, 1e-12), np.inf)


def ground_depth(camera: Camera, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the depth (...) along the optical axis at which ``rays`` (..., 3) of unit depth meet z = 0; inf if they do
    not."""
    return depth_below(float(camera.position[2]), -rays[..., 2])


def on_ground(camera: Camera, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return world points (..., 3) on z = 0 at ``pixels`` (..., 2); inf above the horizon."""
    rays = camera.rays(pixels)
    depth = ground_depth(camera, rays)[..., None]
    with np.errstate(invalid="ignore"):
        return camera.position + depth * rays


def scaled_to_metres(camera: Camera, origin: NDArray[np.floating], metres_per_unit: float) -> Camera:
    """Return ``camera`` with the world's origin moved to ``origin`` (units) and lengths in metres."""
    pose = np.asarray(camera.world_from_camera, dtype=np.float64).copy()
    pose[:3, 3] = (pose[:3, 3] - origin) * metres_per_unit
    rows = [(float(a), float(b), float(c), float(d)) for a, b, c, d in pose]
    return replace(camera, world_from_camera=tuple(rows))
