# SPDX-License-Identifier: MIT
"""Cameras around an object, looking at it, as generators of views place them."""

from __future__ import annotations

import math
from typing import cast

import numpy as np

from ...scene.model import Camera, Matrix4


def orbit_camera(
    azimuth: float, elevation: float, distance: float, *, side: int, focal: float, target: tuple[float, ...] = (0, 0, 0)
) -> Camera:
    """The camera of a square picture at ``distance`` m from ``target`` (3,), upright, looking at it.

    azimuth: degrees counter-clockwise seen from above, 0 on the side of +x; elevation: degrees above the horizontal.
    side: pixels; focal: focal length over the side.
    """
    around, up = math.radians(azimuth), math.radians(elevation)
    outward = np.array([math.cos(up) * math.cos(around), math.cos(up) * math.sin(around), math.sin(up)])
    right = np.array([-math.sin(around), math.cos(around), 0.0])
    matrix = np.eye(4)
    # From the target outward is backward for the camera; right and down make the frame.
    matrix[:3, :3] = np.stack([right, np.cross(-outward, right), -outward], axis=1)
    matrix[:3, 3] = np.asarray(target, dtype=np.float64) + distance * outward
    return Camera(
        width=side,
        height=side,
        fx=focal * side,
        fy=focal * side,
        cx=side / 2,
        cy=side / 2,
        world_from_camera=cast(Matrix4, tuple(tuple(row) for row in matrix.tolist())),
    )
