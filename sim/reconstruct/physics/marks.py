# SPDX-License-Identifier: MIT
"""The photo with numbered outlines, so that what is answered about object 2 is about object 2."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError

LONGEST_SIDE = 1024
"""Of the picture that is sent, in pixels."""

JPEG_QUALITY = 90
COLOURS = ((255, 64, 64), (64, 160, 255), (64, 220, 64), (255, 200, 0), (220, 80, 255), (0, 220, 220))
"""sRGB of the outlines, in turn: far apart from each other, and with a dark seam visible on anything."""

_FONT = cv2.FONT_HERSHEY_SIMPLEX


def marked_picture(pixels: NDArray[np.uint8], masks: Sequence[NDArray[np.bool_]]) -> NDArray[np.uint8]:
    """A copy of ``pixels`` (H, W, 3) sRGB with the outline and number of each of the ``masks`` (H, W).

    Numbers count from 1 in the order of ``masks``. The copy's longer side is at most ``LONGEST_SIDE``. A number stands
    inside its outline where it hides little of the object, else beside it. Raises InputError where sizes differ.
    """
    for number, mask in enumerate(masks, start=1):
        if mask.shape != pixels.shape[:2]:
            raise InputError(f"mask of object {number} is {mask.shape!r}: give one of the photo's {pixels.shape[:2]!r}")
    scale = min(1.0, LONGEST_SIDE / max(pixels.shape[:2]))
    height, width = (max(1, round(side * scale)) for side in pixels.shape[:2])
    picture = np.array(pixels, dtype=np.uint8)
    if scale < 1.0:
        picture = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    line = max(1, round(max(height, width) / 500))
    small: list[NDArray[np.uint8]] = [
        np.asarray(cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
        for mask in masks
    ]
    any_object = np.asarray(np.any(small, axis=0), dtype=np.uint8)
    for index, shape in enumerate(small):
        outlines, _ = cv2.findContours(shape, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, outlines, -1, (0, 0, 0), line + 2, cv2.LINE_AA)
        cv2.drawContours(picture, outlines, -1, COLOURS[index % len(COLOURS)], line, cv2.LINE_AA)
    taken = np.zeros((height, width), dtype=np.uint8)
    for index, shape in enumerate(small):
        _write_number(picture, shape, taken, any_object, index)
    return picture


def jpeg_bytes(picture: NDArray[np.uint8]) -> bytes:
    """The sRGB ``picture`` (H, W, 3) as a JPEG file, without any metadata."""
    good, data = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not good:
        raise InputError(f"photo of {picture.shape!r}: cannot be written as JPEG")
    return bytes(data.tobytes())


def _write_number(
    picture: NDArray[np.uint8],
    mask: NDArray[np.uint8],
    taken: NDArray[np.uint8],
    any_mask: NDArray[np.uint8],
    index: int,
) -> None:
    """Write the number of object ``index`` into ``picture`` and note in ``taken`` where it stands."""
    if not mask.any():
        return
    height, width = mask.shape
    text, size, thickness = str(index + 1), max(height, width) / 1000.0, max(1, round(max(height, width) / 500))
    (wide, high), _ = cv2.getTextSize(text, _FONT, size, thickness)
    half_w, half_h = wide // 2 + 4, high // 2 + 4
    centre = _place(mask, taken, any_mask, half_w, half_h)
    low, top = (centre[0] - half_w, centre[1] - half_h), (centre[0] + half_w, centre[1] + half_h)
    cv2.rectangle(picture, low, top, (255, 255, 255), -1)
    cv2.rectangle(picture, low, top, COLOURS[index % len(COLOURS)], max(1, thickness // 2))
    corner = (centre[0] - wide // 2, centre[1] + high // 2)
    cv2.putText(picture, text, corner, _FONT, size, (0, 0, 0), thickness, cv2.LINE_AA)
    cv2.rectangle(taken, low, top, 1, -1)


def _place(
    mask: NDArray[np.uint8], taken: NDArray[np.uint8], any_mask: NDArray[np.uint8], half_w: int, half_h: int
) -> tuple[int, int]:
    """Pixel (x, y) of the middle of a number of half the size ``half_w``, ``half_h``."""
    height, width = mask.shape
    # A border of zeros: what the photo's edge cuts off is no inside.
    inside = cv2.distanceTransform(cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0), cv2.DIST_L2, 5)
    inside = inside[1:-1, 1:-1] * (taken == 0)
    y, x = np.unravel_index(int(np.argmax(inside)), inside.shape)
    if inside[y, x] >= 2.5 * max(half_w, half_h):
        return int(x), int(y)
    left, top, wide, high = cv2.boundingRect(mask)
    ring = [
        (left + wide // 2, top - half_h - 2),
        (left - half_w - 2, top + high // 2),
        (left + wide + half_w + 2, top + high // 2),
        (left + wide // 2, top + high + half_h + 2),
        (left - half_w - 2, top - half_h - 2),
        (left + wide + half_w + 2, top - half_h - 2),
        (left + wide // 2, top + high // 2),
    ]
    spots = [
        (min(max(x, half_w), max(half_w, width - 1 - half_w)), min(max(y, half_h), max(half_h, height - 1 - half_h)))
        for x, y in ring
    ]

    def hidden(spot: tuple[int, int]) -> int:
        window = np.s_[max(0, spot[1] - half_h) : spot[1] + half_h, max(0, spot[0] - half_w) : spot[0] + half_w]
        return int(any_mask[window].sum()) + 100 * int(taken[window].sum())

    return min(spots, key=hidden)
