# SPDX-License-Identifier: GPL-3.0-or-later
"""What brush strokes make of a mask. Plain numpy, without bpy.

Masks are (H, W) bool, row 0 at the top; places are x, y in their pixels, pixel centres at (x + 0.5, y + 0.5).
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Place = tuple[float, float]

LEAST_RADIUS = 0.75
"""In pixels: a smaller brush could miss every pixel's centre."""
MOST_UNDONE = 64
"""Strokes that can be taken back."""
MOST_SHOWN = 1024
"""Longest side in pixels of the tint: it is made anew at every move of the mouse."""
TINT = (1.0, 0.15, 0.75, 0.45)
"""Magenta: few things in photos have that colour. Its border is white inside and black outside, to be seen on both."""


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


def ellipse(width: int, height: int, box: tuple[float, float, float, float]) -> Mask:
    """A mask (height, width) of the ellipse that fills the ``box`` x0, y0, x1, y1 in its pixels."""
    x0, y0, x1, y1 = box
    x = (np.arange(width)[None, :] + 0.5 - (x0 + x1) / 2) / max((x1 - x0) / 2, 1e-9)
    y = (np.arange(height)[:, None] + 0.5 - (y0 + y1) / 2) / max((y1 - y0) / 2, 1e-9)
    return x**2 + y**2 <= 1.0


def resized(mask: Mask, width: int, height: int) -> Mask:
    """``mask`` at another size: each pixel is the one that its centre lies in."""
    rows = ((np.arange(height) + 0.5) * mask.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * mask.shape[1] / width).astype(int)
    return mask[rows[:, None], columns[None, :]]


def extent(mask: Mask) -> tuple[int, int, int, int] | None:
    """The smallest x0, y0, x1, y1 (ends exclusive) around what is set; None for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def tint(mask: Mask) -> NDArray[np.float32]:
    """RGBA (h, w, 4) to lay over the photo, not premultiplied; every n-th pixel of a mask that is large."""
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

    mask: as it is now. revision: another number after every change. changed: whether a stroke is left that was made.
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
        """Whether a stroke is left."""
        return self._strokes > 0

    @property
    def is_in_stroke(self) -> bool:
        """Whether the brush is down."""
        return self._last is not None

    def press(self, place: Place, radius: float, *, adds: bool) -> None:
        """Put the brush down at ``place``; it adds or removes until ``release``."""
        self._before.append(np.packbits(self.mask))
        self._strokes += 1
        self._value, self._last = adds, place
        self.move(place, radius)

    def move(self, place: Place, radius: float) -> None:
        """Draw the brush to ``place``; nothing while it is up."""
        if self._last is None:
            return
        stamp(self.mask, self._last, place, radius, value=self._value)
        self._last = place
        self.revision += 1

    def release(self) -> None:
        """Lift the brush."""
        self._last = None

    def undo(self) -> bool:
        """Take the last stroke back; whether there was one."""
        if not self._before:
            return False
        bits = np.unpackbits(self._before.pop(), count=self.mask.size)
        self.mask = bits.reshape(self.mask.shape).astype(bool)
        self._last = None
        self._strokes -= 1
        self.revision += 1
        return True
