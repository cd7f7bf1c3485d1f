# SPDX-License-Identifier: MIT
"""Where the camera was: a pinhole without roll above a flat ground, as if 1 unit above it until the scale is known.

World axes: X to the right of the camera, Y away from it, Z up; the ground is z = 0. With pitch p below the
horizontal, the horizon lies in the row  cy − fy tan p.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.model import Camera, Matrix4

DEFAULT_FOV_DEG = 50.0
"""Along the longer side: between a phone's main camera (65°) and its portrait lens (40°)."""
DEFAULT_PITCH_DEG = 20.0
"""How people hold a camera over things on a table."""
MIN_DECLINATION_DEG = 4.0
"""Contacts nearer to the horizon than this would lie many object sizes away."""


def focal_px(width: int, height: int, exif_focal: float | None, fov_deg: float | None) -> tuple[float, str]:
    """Focal length in pixels, and where it comes from: the option, EXIF, or the default angle of view."""
    if fov_deg is None and exif_focal is not None:
        return exif_focal, "EXIF"
    chosen = DEFAULT_FOV_DEG if fov_deg is None else fov_deg
    source = "the default angle of view" if fov_deg is None else "fov_deg"
    return max(width, height) / 2.0 / math.tan(math.radians(chosen) / 2.0), source


def camera_above_ground(width: int, height: int, focal: float, pitch: float) -> Camera:
    """A camera 1 unit above the origin that looks along +Y, ``pitch`` radians downward. Focal length in pixels."""
    sine, cosine = math.sin(pitch), math.cos(pitch)
    pose: Matrix4 = (
        (1.0, 0.0, 0.0, 0.0),
        (0.0, -sine, cosine, 0.0),
        (0.0, -cosine, -sine, 1.0),
        (0.0, 0.0, 0.0, 1.0),
    )
    return Camera(
        width=width, height=height, fx=focal, fy=focal, cx=width / 2.0, cy=height / 2.0, world_from_camera=pose
    )


def horizon_row(height: int, focal: float, pitch: float) -> float:
    """Row of the horizon in pixels; may lie outside the photo."""
    return height / 2.0 - focal * math.tan(pitch)


def pitch_of_horizon(height: int, focal: float, row: float) -> float:
    """Pitch in radians of a camera that sees the horizon in ``row``."""
    return math.atan2(height / 2.0 - row, focal)


def check_horizon(height: int, focal: float, pitch: float, lowest_contact: float, name: str) -> None:
    """Raise InputError when the object that touches the ground in row ``lowest_contact`` is not below the horizon."""
    horizon = horizon_row(height, focal, pitch)
    declination = math.degrees(math.atan2(lowest_contact - height / 2.0, focal) + pitch)
    if declination < MIN_DECLINATION_DEG * 0.5:
        raise InputError(
            f"horizon at {horizon / height:.2f} of the photo's height, {name} stands at "
            f"{lowest_contact / height:.2f}: give a smaller horizon_y or a larger pitch_deg, "
            "the horizon lies above where things stand"
        )


def ground_depth(camera: Camera, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth (...) along the optical axis at which ``rays`` (..., 3) of unit depth meet z = 0; inf when they do not."""
    down = -rays[..., 2]
    with np.errstate(divide="ignore"):
        return np.where(down > 1e-9, camera.position[2] / np.maximum(down, 1e-12), np.inf)


def on_ground(camera: Camera, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """World points (..., 3) on z = 0 that are seen at ``pixels`` (..., 2); inf above the horizon."""
    rays = camera.rays(pixels)
    depth = ground_depth(camera, rays)[..., None]
    with np.errstate(invalid="ignore"):
        return camera.position + depth * rays


def scaled_to_metres(camera: Camera, origin: NDArray[np.floating], metres_per_unit: float) -> Camera:
    """``camera`` with the world's origin moved to ``origin`` (units) and lengths turned into metres."""
    pose = np.asarray(camera.world_from_camera, dtype=np.float64).copy()
    pose[:3, 3] = (pose[:3, 3] - origin) * metres_per_unit
    rows = [(float(a), float(b), float(c), float(d)) for a, b, c, d in pose]
    return replace(camera, world_from_camera=tuple(rows))
