# SPDX-License-Identifier: MIT
"""Strokes that say what belongs to an object and what does not, drawn into masks, and checked against its box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..photo import Photo
from ..reconstruct_options import ObjectRequest, Stroke
from ..stage_cache import Notice

Mask = NDArray[np.bool_]
Box = tuple[int, int, int, int]

WIDTH = 3.0
"""Width of a stroke in pixels of a photo of 1024 pixels: thin enough for the leg of a chair."""


@dataclass(frozen=True)
class Strokes:
    """keep, drop: (H, W) pixels that certainly are, or certainly are not, the object."""

    keep: Mask
    drop: Mask

    def __bool__(self) -> bool:
        """Whether there is any stroke."""
        return bool(self.keep.any() or self.drop.any())


def no_strokes(shape: tuple[int, ...]) -> Strokes:
    """Return strokes on no pixel of a picture of ``shape``."""
    empty = np.zeros(shape[:2], dtype=bool)
    return Strokes(empty, empty)


def drawn_strokes(item: ObjectRequest, picture: Photo, box: Box, notice: Notice) -> Strokes:
    """Return the strokes of ``item``, which has a name, in working pixels of ``picture``.

    box: the object's, in working pixels. notice: called for a stroke without effect. Raises InputError for strokes
    beside a mask, outside the photo, that keep what lies outside the box, or that contradict each other.
    """
    where, shape = item.name or "", (picture.height, picture.width)
    if not item.keep and not item.drop:
        return no_strokes(shape)
    if item.mask is not None:
        raise InputError(f"{where}: has a mask and strokes; strokes refine a box, so paint the mask, or leave it out")
    for flag, strokes in (("keep", item.keep), ("drop", item.drop)):
        for x, y in (place for stroke in strokes for place in stroke):
            if not (0.0 <= x <= picture.original_size[0] and 0.0 <= y <= picture.original_size[1]):
                size = "x".join(map(str, picture.original_size))
                raise InputError(f"{where}: {flag} stroke at {x:g},{y:g} lies outside the photo of {size} pixels")
    keep, drop = (_drawn(strokes, picture.scale, shape) for strokes in (item.keep, item.drop))
    inside = np.zeros(shape, dtype=bool)
    inside[box[1] : box[3], box[0] : box[2]] = True
    for x, y in (place for stroke in item.keep for place in stroke):
        u, v = x * picture.scale, y * picture.scale
        if not (box[0] - 1 <= u <= box[2] + 1 and box[1] - 1 <= v <= box[3] + 1):
            raise InputError(
                f"{where}: keep stroke at {x:g},{y:g} lies outside its box; draw the box larger, or the stroke inside"
            )
    if (keep & drop).any():
        x, y = (np.argwhere(keep & drop)[0][::-1] + 0.5) / picture.scale
        raise InputError(f"{where}: keep and drop strokes cross at {x:.0f},{y:.0f}; a pixel can only be one of them")
    if item.drop and not (drop & inside).any():
        notice(f"{where}: its drop strokes lie outside its box, which is background already; they change nothing")
    if inside.any() and (drop | ~inside).all():
        raise InputError(f"{where}: drop strokes fill its whole box; leave the object free of them")
    return Strokes(keep & inside, drop)


def require_apart(strokes: Sequence[Strokes], names: Sequence[str], scale: float) -> None:
    """Raise InputError when two objects keep the same pixel."""
    for i, first in enumerate(strokes):
        for j in range(i + 1, len(strokes)):
            common = first.keep & strokes[j].keep
            if common.any():
                x, y = (np.argwhere(common)[0][::-1] + 0.5) / scale
                raise InputError(
                    f"keep strokes of {names[i]} and {names[j]} cross at {x:.0f},{y:.0f}; a pixel belongs to one object"
                )


def _drawn(strokes: Sequence[Stroke], scale: float, shape: tuple[int, int]) -> Mask:
    """Polylines of the original's pixels, drawn into a mask of ``shape``; a single place is a dot."""
    canvas = np.zeros(shape, dtype=np.uint8)
    thick = max(1, round(WIDTH * max(shape) / 1024.0))
    for stroke in strokes:
        # The centre of the top left pixel is (0.5, 0.5) here and (0, 0) in OpenCV.
        places = np.round((np.array(stroke, dtype=np.float64) * scale - 0.5) * 16.0).astype(np.int32)
        cv2.polylines(canvas, [places], isClosed=False, color=1, thickness=thick, lineType=cv2.LINE_8, shift=4)
        for place in places // 16:
            cv2.circle(canvas, (int(place[0]), int(place[1])), thick // 2, 1, -1)
    return canvas > 0
