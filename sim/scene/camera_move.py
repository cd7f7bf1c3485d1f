# SPDX-License-Identifier: MIT
"""Where a camera is that has been moved from the photo's: around a pivot, nearer, aside, turned, zoomed.

How far it may go: the photo has seen things from one side, and what lies beyond is guessed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .checks import require_range
from .model import Camera, Ground

FloatArray = NDArray[np.float64]

MAX_ANGLE_DEG = 30.0
MAX_DISTANCE = 0.3
"""Change of the distance to the pivot, as a share of it."""
ZOOM_RANGE = (0.5, 4.0)
LOWEST = 0.05
"""Least height over the ground as a share of the distance to the pivot: below it the ground is a line."""
USUAL_ANGLE_DEG, USUAL_DISTANCE = 10.0, 0.1
"""Moves up to these look right; beyond, guesses begin to show."""
STILL_PX = 0.02
"""A camera whose picture would differ by less than this is the photo's own."""


@dataclass(frozen=True, kw_only=True)
class Offset:
    """A camera against the photo's, in this order; all zeros (and zoom 1) is the photo's own.

    azimuth_deg: around the pivot, about the ground's normal; positive goes to the camera's right.
    elevation_deg: around the pivot, positive rises.
    dolly: change of the distance to the pivot over that distance; -0.1 comes a tenth nearer.
    right_m, up_m: shift along the image's axes, metres.
    pan_deg, tilt_deg, roll_deg: turn of the camera where it stands: right, up, clockwise as seen from behind it.
    zoom: focal length over the photo's.
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    dolly: float = 0.0
    right_m: float = 0.0
    up_m: float = 0.0
    pan_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    zoom: float = 1.0

    def __post_init__(self) -> None:
        for item in fields(self):
            low, high, unit = -1e3, 1e3, "metres"
            if item.name.endswith("_deg"):
                low, high, unit = -MAX_ANGLE_DEG, MAX_ANGLE_DEG, "degrees"
            elif item.name == "dolly":
                low, high, unit = -MAX_DISTANCE, MAX_DISTANCE, "a share of the distance"
            elif item.name == "zoom":
                (low, high), unit = ZOOM_RANGE, "a factor"
            require_range(item.name, getattr(self, item.name), low, high, unit)


def moved(camera: Camera, offset: Offset, *, pivot: FloatArray, normal: FloatArray) -> Camera:
    """``camera`` after ``offset``; ``pivot`` (3,) in world metres, ``normal`` (3,) of the ground, of length 1."""
    pose = np.asarray(camera.world_from_camera, dtype=np.float64)
    turn, position = pose[:3, :3], pose[:3, 3]
    around = turn_matrix(math.radians(offset.azimuth_deg) * normal)
    turn, position = around @ turn, pivot + around @ (position - pivot)
    # Turned about the horizontal axis to the camera's right, but backwards: then it rises.
    right = np.cross(level_forward(turn, normal), normal)
    rise = turn_matrix(-math.radians(offset.elevation_deg) * right)
    turn, position = rise @ turn, pivot + (1.0 + offset.dolly) * (rise @ (position - pivot))
    position = position + offset.right_m * turn[:, 0] - offset.up_m * turn[:, 1]
    # OpenCV's y points down: a turn about it goes to the right, one about x goes up.
    x, y, z = np.eye(3)
    pan, tilt, roll = (math.radians(v) for v in (offset.pan_deg, offset.tilt_deg, offset.roll_deg))
    own = turn_matrix(pan * y) @ turn_matrix(tilt * x) @ turn_matrix(roll * z)
    return replace(posed(camera, turn @ own, position), fx=camera.fx * offset.zoom, fy=camera.fy * offset.zoom)


def turn_matrix(vector: FloatArray) -> FloatArray:
    """The rotation (3, 3) about ``vector`` (3,) by its length in radians (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-300)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross))


def turn_vector(matrix: FloatArray) -> FloatArray:
    """The vector (3,) of ``turn_matrix`` for a rotation by less than half a turn."""
    m = matrix
    axis = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / 2.0
    sine, cosine = float(np.linalg.norm(axis)), (float(np.trace(m)) - 1.0) / 2.0
    return np.asarray(axis * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0))


def posed(camera: Camera, turn: FloatArray, position: FloatArray) -> Camera:
    """``camera`` at ``position`` (3,) with the axes ``turn`` (3, 3: right, down and forward as columns)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, position
    a, b, c, d = (tuple(float(x) for x in row) for row in pose)
    return replace(camera, world_from_camera=(a, b, c, d))  # type: ignore[arg-type]


def level_forward(turn: FloatArray, normal: FloatArray) -> FloatArray:
    """Unit vector (3,) along the ground, away from a camera with the axes ``turn`` (3, 3)."""
    for axis in (turn[:, 2], -turn[:, 1]):
        level = axis - (axis @ normal) * normal
        length = float(np.linalg.norm(level))
        # A camera that looks straight down has its way forward up the image.
        if length > 0.05:
            break
    return np.asarray(level / length)


def at_size(camera: Camera, size: tuple[int, int]) -> Camera:
    """``camera`` for images of ``size`` (width, height) in the place of its own."""
    width, height = size
    x, y = width / camera.width, height / camera.height
    return replace(
        camera, width=width, height=height, fx=camera.fx * x, cx=camera.cx * x, fy=camera.fy * y, cy=camera.cy * y
    )


def is_still(camera: Camera, other: Camera, pivot: FloatArray) -> bool:
    """Whether what is at ``pivot`` (3,) or around it looks the same through both, to within ``STILL_PX``."""
    a, b = (np.asarray(c.world_from_camera, dtype=np.float64) for c in (camera, other))
    focal, side = max(camera.fx, camera.fy), max(camera.width, camera.height)
    distance = float(np.linalg.norm(a[:3, 3] - pivot))
    shift = focal * float(np.linalg.norm(a[:3, 3] - b[:3, 3])) / max(distance, 1e-9)
    turn = (focal + side) * float(np.abs(a[:3, :3] - b[:3, :3]).max())
    zoom = side * max(abs(other.fx / camera.fx - 1.0), abs(other.fy / camera.fy - 1.0))
    centre = max(abs(other.cx - camera.cx), abs(other.cy - camera.cy))
    return max(shift, turn, zoom, centre) < STILL_PX


def reach(camera: Camera, other: Camera, pivot: FloatArray) -> tuple[float, float]:
    """How far ``other`` is from ``camera``: degrees around ``pivot`` (3,), change of the distance to it over it."""
    here, there = camera.position - pivot, other.position - pivot
    near, far = float(np.linalg.norm(here)), float(np.linalg.norm(there))
    # Not by the cosine alone, which says nothing about angles below 1e-6.
    angle = math.atan2(float(np.linalg.norm(np.cross(here, there))), float(here @ there))
    return math.degrees(angle), far / max(near, 1e-12) - 1.0


def check_reach(camera: Camera, other: Camera, *, pivot: FloatArray, ground: Ground, where: str) -> None:
    """Raise InputError when ``other`` is too far from ``camera``; ``where`` begins the message."""
    around, nearer = reach(camera, other, pivot)
    if around > MAX_ANGLE_DEG + 1e-6:
        raise InputError(f"{where}: the camera is {around:.0f}° around the pivot; give up to {MAX_ANGLE_DEG:g}°")
    if abs(nearer) > MAX_DISTANCE + 1e-6:
        raise InputError(
            f"{where}: the camera's distance to the pivot changes by {100 * nearer:.0f} %; give up to "
            f"{100 * MAX_DISTANCE:g} %"
        )
    a, b = (np.asarray(c.world_from_camera, dtype=np.float64)[:3, :3] for c in (camera, other))
    turned = math.degrees(float(np.linalg.norm(turn_vector(a.T @ b))))
    if turned > 1.5 * MAX_ANGLE_DEG:
        raise InputError(f"{where}: the camera is turned by {turned:.0f}°; give up to {1.5 * MAX_ANGLE_DEG:g}°")
    height = float(ground.heights(other.position))
    least = LOWEST * float(np.linalg.norm(camera.position - pivot))
    if height < least:
        raise InputError(
            f"{where}: the camera is {height:.3g} m above the ground; keep it at least {least:.3g} m above: less "
            "elevation, or a smaller move down"
        )
