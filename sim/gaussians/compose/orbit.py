# SPDX-License-Identifier: MIT
"""Cameras all around a thing, as SyncDreamer has them: 16, every 22.5°, from 30° above."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from ..views.orbit import orbit_camera

VIEWS = 16
ELEVATION = 30.0
"""Degrees."""

FIELD_OF_VIEW = 49.1
"""Degrees, as published for SyncDreamer (Liu et al. 2023): a lens of 35 mm on a sensor of 32 mm."""

ROOM = 1.1
"""Times the thing's radius that has to fit into the picture."""


def orbit(points: NDArray[np.float64], size: int) -> tuple[Camera, ...]:
    """Cameras of ``size``² pixels that see all ``points`` (N, 3), world metres, z up."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = ROOM * float(np.linalg.norm(points - middle, axis=1).max())
    half = math.radians(FIELD_OF_VIEW / 2)
    x, y, z = (float(v) for v in middle)
    return tuple(
        orbit_camera(
            360.0 / VIEWS * i,
            ELEVATION,
            radius / math.sin(half),
            side=size,
            focal=0.5 / math.tan(half),
            target=(x, y, z),
        )
        for i in range(VIEWS)
    )
