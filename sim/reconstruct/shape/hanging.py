# SPDX-License-Identifier: MIT
"""Objects whose foot lies above the horizon: they stand on no ground, and hang as far away as what does.

Such an object is made in a view that is turned about its own centre until the foot lies below the horizon. Turning and
scaling about the centre of projection change nothing in the photo.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from ..camera.ground_camera import camera_above_ground, declination, pitch_and_roll, stands_below, up_in_camera

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

SEEN_FROM_DEG = 15.0
"""How far below the horizontal the foot lies in the turned view: things that hang are seen nearly level."""
ALONE = 3.0
"""Distance of what hangs alone, in heights of the camera."""
CLEAR = 0.05
"""Least height of its lowest point, in heights of the camera."""


def turned_view(view: Camera, mask: Mask) -> Camera | None:
    """Return ``view`` turned until the foot of ``mask`` (H, W), not empty, lies below the horizon; None if it does."""
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask[rows[-1]])
    foot = np.array([(columns[0] + columns[-1] + 1) / 2.0, rows[-1] + 1.0])
    if stands_below(view, foot):
        return None
    pitch, roll = pitch_and_roll(up_in_camera(view))
    turned = view
    for _ in range(4):
        # At the sides of a wide photo the angle grows more slowly than the pitch.
        pitch = min(pitch + math.radians(SEEN_FROM_DEG) - float(declination(turned, foot)), math.radians(89.0))
        pose = camera_above_ground(view.width, view.height, view.fx, pitch, roll).world_from_camera
        turned = replace(view, world_from_camera=pose)
    return turned


def hung(view: Camera, turned: Camera, vertices: Points, standing: Sequence[Points]) -> Points:
    """Return ``vertices`` (V, 3), made in the view ``turned``, in the world of ``view``, above the ground z = 0.

    standing: (W, 3) vertices of the bodies on the ground; it hangs as far away as the nearest, or at a usual distance.
    """
    made = turned.project(vertices)
    wanted = min((float(np.median(view.project(points)[:, 2])) for points in standing), default=ALONE)
    rays = view.rays(made[:, :2]) * made[:, 2:]
    factor = wanted / float(np.median(made[:, 2]))
    drop = -float(rays[:, 2].min())
    if drop > 0.0:
        factor = min(factor, (1.0 - CLEAR) * view.position[2] / drop)
    return np.asarray(view.position + factor * rays)
