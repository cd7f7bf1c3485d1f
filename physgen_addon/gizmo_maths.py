# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the arrows of a body are, and what a drag makes of them. Plain numpy; lengths in the scene's own units."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GRAVITY = 9.81
TURN = 2 * math.pi

FREE, LEVEL, UPRIGHT = "free", "level", "upright"
"""How a tip moves: in the plane of the view, in a horizontal plane, up and down."""


def seconds_shown(size: float, metres_per_unit: float) -> float:
    """How many seconds of way a velocity arrow is long, for a body of this ``size``.

    The time to fall about half the body's size: an arrow as long as the body throws it about that high.
    """
    return math.sqrt(max(size, 1e-9) * metres_per_unit / GRAVITY)


def spin_length(size: float) -> float:
    """Length of a spin arrow for each radian a second: a turn a second is as long as the body."""
    return max(size, 1e-9) / TURN


def pixel_size(perspective: Array, point: Array, width: int) -> float:
    """Size of a pixel at ``point`` (3,) of a view ``width`` pixels wide with the matrix ``perspective`` (4, 4)."""
    depth = float(perspective[3, :3] @ point + perspective[3, 3])
    return 2.0 * abs(depth) / (width * max(float(np.linalg.norm(perspective[0, :3])), 1e-30))


def on_screen(perspective: Array, point: Array, width: int, height: int) -> Array | None:
    """Pixel (2,) from the lower left corner at which ``point`` (3,) is seen; None behind the viewer."""
    x, y, _, w = perspective @ np.append(point, 1.0)
    if w <= 0:
        return None
    return np.array([(x / w + 1) * width / 2, (y / w + 1) * height / 2])


def dragged(start: Array, origin: Array, ray: Array, forward: Array, mode: str) -> Array | None:
    """Where a tip that was at ``start`` (3,) goes under the mouse.

    origin, ray: of the line of sight through the mouse, (3,). forward: viewing direction (3,), of length 1. mode:
    ``FREE``, ``LEVEL`` or ``UPRIGHT``. None where the line of sight meets the plane nowhere in front of the viewer.
    """
    normal = forward
    if mode == LEVEL:
        normal = np.array([0.0, 0.0, 1.0])
    elif mode == UPRIGHT:
        # The upright plane that is seen best.
        normal = np.array([forward[0], forward[1], 0.0])
    slope = float(ray @ normal)
    length = float(np.linalg.norm(normal))
    if abs(slope) <= 0.02 * length * float(np.linalg.norm(ray)) or length < 1e-6:
        return None
    found: Array = origin + ray * (float((start - origin) @ normal) / slope)
    if mode == UPRIGHT:
        found = np.array([start[0], start[1], found[2]])
    return found


def frame_along(direction: Array) -> Array:
    """A rotation (3, 3) whose third column is along ``direction`` (3,); upright for a direction of no length."""
    length = float(np.linalg.norm(direction))
    z = direction / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
