# SPDX-License-Identifier: MIT
"""Masks as COCO writes them: runs of pixels down the columns, as numbers or packed into text; and polygons.

The packed form, as COCO's mask API documents it: characters from code 48 on carry 6 bits each, 5 of the number, lowest
first, and one that says that more follow; the last one's highest data bit is the sign. From the fourth run on, a number
is the difference to the run two before it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.draw import polygon

from ..errors import InputError

Mask = NDArray[np.bool_]
MAX_PIXELS = 100_000_000
MAX_RUNS = 20_000_000
MAX_POLYGONS = 10_000
_MOST_CHARACTERS = 13
"""Of one number: 64 bits. A longer one is garbage."""


def mask_from_rle(value: Any, where: str) -> Mask:
    """The mask (H, W) of ``{"size": [H, W], "counts": …}``, counts being text or a list. Raises InputError."""
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected size and counts of a mask")
    size, counts = value.get("size"), value.get("counts")
    good = isinstance(size, list) and len(size) == 2 and all(type(side) is int and side > 0 for side in size)
    if not good or size[0] * size[1] > MAX_PIXELS:  # type: ignore[index]
        raise InputError(f"{where}: size is {str(size)[:60]}, expected height and width in pixels")
    height, width = size  # type: ignore[misc]
    if isinstance(counts, str):
        runs = _unpacked(counts, where)
    elif isinstance(counts, list) and all(type(run) is int and 0 <= run <= MAX_PIXELS for run in counts):
        runs = np.array(counts, dtype=np.int64)
    else:
        raise InputError(f"{where}: counts are neither text nor a list of whole numbers from 0")
    if (runs < 0).any() or (runs > MAX_PIXELS).any() or int(runs.sum()) != height * width:
        raise InputError(f"{where}: its runs do not add up to {height}x{width} pixels; the mask is damaged")
    flat = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return np.ascontiguousarray(flat.reshape(width, height).T)


def _unpacked(text: str, where: str) -> NDArray[np.int64]:
    if len(text) > MAX_RUNS:
        raise InputError(f"{where}: counts have {len(text)} characters; the mask is damaged")
    runs: list[int] = []
    value = shift = 0
    for character in text:
        code = ord(character) - 48
        if not 0 <= code < 64 or shift >= 5 * _MOST_CHARACTERS:
            raise InputError(f"{where}: counts hold {character!r} where no number goes on; the mask is damaged")
        value |= (code & 31) << shift
        shift += 5
        if code & 32:
            continue
        if code & 16:
            value -= 1 << shift
        run = value + (runs[-2] if len(runs) > 2 else 0)
        if not 0 <= run <= MAX_PIXELS:
            raise InputError(f"{where}: has a run of {run} pixels; the mask is damaged")
        runs.append(run)
        value = shift = 0
    if shift:
        raise InputError(f"{where}: counts end in the middle of a number; the mask is damaged")
    return np.array(runs, dtype=np.int64)


def mask_from_polygons(value: list[Any], width: int, height: int, where: str) -> Mask:
    """The mask (H, W) of COCO's polygons, lists x0, y0, x1, y1, …: pixels whose centres lie in any of them."""
    if len(value) > MAX_POLYGONS:
        raise InputError(f"{where}: has {len(value)} polygons, more than the {MAX_POLYGONS} allowed")
    mask = np.zeros((height, width), dtype=bool)
    for points in value:
        numeric = isinstance(points, list) and all(
            isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e6 for x in points
        )
        if not numeric or len(points) < 6 or len(points) % 2:
            raise InputError(f"{where}: a polygon needs at least three points x, y as one list of numbers")
        corners = np.array(points, dtype=np.float64).reshape(-1, 2) - 0.5
        rows, columns = polygon(corners[:, 1], corners[:, 0], shape=mask.shape)
        mask[rows, columns] = True
    return mask
