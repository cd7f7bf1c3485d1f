# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the horizon runs through a photo, and the camera that sees it there. Plain numbers, without bpy.

Heights are fractions of the photo's height from the top and may lie outside 0 to 1. Roll in radians, positive where the
horizon falls to the right. aspect: width over height. In pixels from the middle of the photo, with focal length f and
pitch p below the horizontal, the horizon is  y = x tan r − f tan p / cos r  (sim/reconstruct/view/camera.py).
"""

from __future__ import annotations

import math

from ..sim.scene.model import Camera

LOWEST, HIGHEST = 0.95, -10.0
"""What the command takes; the horizon of a camera that looks straight down is infinitely high."""
MOST_ROLL = math.radians(45)
USUAL_PITCH, USUAL_FOV = math.radians(20), math.radians(50)


def ends(horizon: float, roll: float, aspect: float) -> tuple[float, float]:
    """Heights at the left and the right edge of a line at ``horizon`` in the middle."""
    half = aspect / 2 * math.tan(roll)
    return horizon - half, horizon + half


def of_ends(left: float, right: float, aspect: float) -> tuple[float, float]:
    """Height in the middle, and roll, of the line with these heights at the edges; as near as the command takes."""
    roll = max(-MOST_ROLL, min(math.atan2(right - left, aspect), MOST_ROLL))
    return max(HIGHEST, min((left + right) / 2, LOWEST)), roll


def dragged(left: float, right: float, at: float, by: float) -> tuple[float, float]:
    """``left`` and ``right`` after a drag by ``by`` that began at the fraction ``at`` of the width.

    The outer thirds turn the line about its other end, the middle one moves it.
    """
    if at < 1 / 3:
        return left + by, right
    return (left, right + by) if at > 2 / 3 else (left + by, right + by)


def of_camera(camera: Camera) -> tuple[float, float]:
    """Height of the horizon in the middle column, and roll, as ``camera`` sees a level ground."""
    x, y, z = camera.world_from_camera[2][:3]
    # Level or upside down there is no horizon, or it is far above.
    if y > -1e-6:
        return HIGHEST, 0.0
    middle = camera.cy - camera.fy * (x * (camera.width / 2 - camera.cx) / camera.fx + z) / y
    return max(HIGHEST, min(middle / camera.height, LOWEST)), math.atan2(x, -y)


def pitch_of_camera(camera: Camera) -> float:
    """Angle in radians of the view below the horizontal."""
    return math.asin(max(-1.0, min(-camera.world_from_camera[2][2], 1.0)))


def fov_of_camera(camera: Camera) -> float:
    """Angle of view in radians along the longer side."""
    side, focal = max((camera.width, camera.fx), (camera.height, camera.fy))
    return 2 * math.atan(side / 2 / focal)


def usual(aspect: float) -> float:
    """Height of the horizon for a usual photo of things on a table."""
    focal = max(aspect, 1.0) / 2 / math.tan(USUAL_FOV / 2)
    return 0.5 - focal * math.tan(USUAL_PITCH)
