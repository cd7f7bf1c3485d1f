# SPDX-License-Identifier: GPL-3.0-or-later
"""Maths of the photo tools, without bpy: the horizon as a camera, and brush strokes as a mask."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...sim.reconstruct.reconstruct_options import ReconstructOptions
from ...sim.scene.model import Camera
from ...sim.validation import range_of

HIGHEST, LOWEST = range_of(ReconstructOptions, "horizon_y")
"""Range of the command; the horizon of a camera that looks straight down is infinitely high."""
MOST_ROLL = math.radians(range_of(ReconstructOptions, "roll_deg")[1])
USUAL_PITCH, USUAL_FOV = math.radians(20), math.radians(50)


def ends(horizon: float, roll: float, aspect: float) -> tuple[float, float]:
    """Return heights at the left and the right edge of a line at ``horizon`` in the middle."""
    half = aspect / 2 * math.tan(roll)
    return horizon - half, horizon + half


def of_ends(left: float, right: float, aspect: float) -> tuple[float, float]:
    """Return height in the middle, and roll, of the line with these heights at the edges, clamped to the command's
    range.
    """
    roll = max(-MOST_ROLL, min(math.atan2(right - left, aspect), MOST_ROLL))
    return max(HIGHEST, min((left + right) / 2, LOWEST)), roll


def dragged(left: float, right: float, at: float, by: float) -> tuple[float, float]:
    """Return ``left`` and ``right`` after a drag by ``by`` that began at the fraction ``at`` of the width.

    The outer thirds rotate the line about its other end, the middle one moves it.
    """
    if at < 1 / 3:
        return left + by, right
    return (left, right + by) if at > 2 / 3 else (left + by, right + by)


def of_camera(camera: Camera) -> tuple[float, float]:
    """Return height in the middle column, and roll, of the horizon of a level ground seen by ``camera``."""
    x, y, z = camera.world_from_camera[2][:3]
    # Looking straight down or upside down there is no horizon, or it is far above.
    if y > -1e-6:
        return HIGHEST, 0.0
    middle = camera.cy - camera.fy * (x * (camera.width / 2 - camera.cx) / camera.fx + z) / y
    return max(HIGHEST, min(middle / camera.height, LOWEST)), math.atan2(x, -y)


def pitch_of_camera(camera: Camera) -> float:
    """Return the angle in radians of the view below the horizontal."""
    return math.asin(max(-1.0, min(-camera.world_from_camera[2][2], 1.0)))


def fov_of_camera(camera: Camera) -> float:
    """Return the angle of view in radians along the longer side."""
    side, focal = max((camera.width, camera.fx), (camera.height, camera.fy))
    return 2 * math.atan(side / 2 / focal)


def usual(aspect: float) -> float:
    """Return the typical horizon height of a photo of objects on a table."""
    focal = max(aspect, 1.0) / 2 / math.tan(USUAL_FOV / 2)
    return 0.5 - focal * math.tan(USUAL_PITCH)


Mask = NDArray[np.bool_]
Place = tuple[float, float]

LEAST_RADIUS = 0.75
"""In pixels: a smaller brush could miss every pixel's centre."""
MOST_UNDONE = 64
"""Maximum number of undo steps."""
MOST_SHOWN = 1024
"""Maximum side in pixels of the tint, which is recomputed at every mouse move."""
TINT = (1.0, 0.15, 0.75, 0.45)
"""Magenta: rare in photos. Its border is white inside and black outside, visible on both."""


def stamp(mask: Mask, start: Place, end: Place, radius: float, *, value: bool) -> None:
    """Set the pixels of ``mask`` within ``radius`` pixels of the segment from ``start`` to ``end`` to ``value``."""
    radius = max(radius, LEAST_RADIUS)
    height, width = mask.shape
    (x0, y0), (x1, y1) = start, end
    left, right = max(int(min(x0, x1) - radius), 0), min(int(max(x0, x1) + radius) + 1, width)
    top, bottom = max(int(min(y0, y1) - radius), 0), min(int(max(y0, y1) + radius) + 1, height)
    if left >= right or top >= bottom:
        return
    x = np.arange(left, right)[None, :] + 0.5 - x0
    y = np.arange(top, bottom)[:, None] + 0.5 - y0
    along_x, along_y = x1 - x0, y1 - y0
    length = along_x**2 + along_y**2
    share = np.clip((x * along_x + y * along_y) / length, 0.0, 1.0) if length > 0 else 0.0
    near = (x - share * along_x) ** 2 + (y - share * along_y) ** 2 <= radius**2
    mask[top:bottom, left:right][near] = value


def box_overlap(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the intersection over union of two boxes x0, y0, x1, y1."""
    width, height = (min(first[i + 2], second[i + 2]) - max(first[i], second[i]) for i in (0, 1))
    common = max(0.0, width) * max(0.0, height)
    return common / max(1e-9, sum((b[2] - b[0]) * (b[3] - b[1]) for b in (first, second)) - common)


def simplified(places: Sequence[Place], least: float = 3.0) -> list[Place]:
    """Return ``places`` of a stroke without those nearer than ``least`` to the one before; the last one stays."""
    result = [places[0]]
    for place in places[1:]:
        if math.dist(place, result[-1]) >= least:
            result.append(place)
    if places[-1] != result[-1]:
        result.append(places[-1])
    return result


def ellipse(width: int, height: int, box: tuple[float, float, float, float]) -> Mask:
    """Return a mask (height, width) of the ellipse inscribed in the ``box`` x0, y0, x1, y1."""
    x0, y0, x1, y1 = box
    x = (np.arange(width)[None, :] + 0.5 - (x0 + x1) / 2) / max((x1 - x0) / 2, 1e-9)
    y = (np.arange(height)[:, None] + 0.5 - (y0 + y1) / 2) / max((y1 - y0) / 2, 1e-9)
    return x**2 + y**2 <= 1.0


def resized(mask: Mask, width: int, height: int) -> Mask:
    """Return ``mask`` resampled by nearest neighbour."""
    rows = ((np.arange(height) + 0.5) * mask.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * mask.shape[1] / width).astype(int)
    return mask[rows[:, None], columns[None, :]]


def extent(mask: Mask) -> tuple[int, int, int, int] | None:
    """Return x0, y0, x1, y1 (ends exclusive) of the set pixels; None for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def tint(mask: Mask) -> NDArray[np.float32]:
    """Return RGBA (h, w, 4) to overlay on the photo, not premultiplied; every n-th pixel of a large mask."""
    step = -(-max(mask.shape) // MOST_SHOWN)
    shown = np.pad(mask[::step, ::step], 1, mode="edge")
    middle = shown[1:-1, 1:-1]
    sides = (shown[:-2, 1:-1], shown[2:, 1:-1], shown[1:-1, :-2], shown[1:-1, 2:])
    picture = np.zeros((*middle.shape, 4), dtype=np.float32)
    picture[middle] = TINT
    picture[middle & ~np.logical_and.reduce(sides)] = (1.0, 1.0, 1.0, 1.0)
    picture[~middle & np.logical_or.reduce(sides)] = (0.0, 0.0, 0.0, 1.0)
    return picture


class Painting:
    """A mask under the brush, stroke by stroke.

    mask: current state. revision: increases with every change. changed: whether there are strokes to undo.
    """

    def __init__(self, mask: Mask) -> None:
        self.mask = mask.copy()
        self.revision = 0
        self._before: deque[NDArray[np.uint8]] = deque(maxlen=MOST_UNDONE)
        self._last: Place | None = None
        self._value = True
        self._strokes = 0

    @property
    def changed(self) -> bool:
        """Whether there are strokes to undo."""
        return self._strokes > 0

    @property
    def is_in_stroke(self) -> bool:
        """Whether the brush is down."""
        return self._last is not None

    def press(self, place: Place, radius: float, *, adds: bool) -> None:
        """Start a stroke at ``place``; it adds or removes until ``release``."""
        self._before.append(np.packbits(self.mask))
        self._strokes += 1
        self._value, self._last = adds, place
        self.move(place, radius)

    def move(self, place: Place, radius: float) -> None:
        """Extend the stroke to ``place``; no effect while the brush is up."""
        if self._last is None:
            return
        stamp(self.mask, self._last, place, radius, value=self._value)
        self._last = place
        self.revision += 1

    def release(self) -> None:
        """End the stroke."""
        self._last = None

    def undo(self) -> bool:
        """Undo the last stroke; return whether there was one."""
        if not self._before:
            return False
        bits = np.unpackbits(self._before.pop(), count=self.mask.size)
        self.mask = bits.reshape(self.mask.shape).astype(bool)
        self._last = None
        self._strokes -= 1
        self.revision += 1
        return True
