# SPDX-License-Identifier: MIT
"""A filling and the photo around it made one picture, without a halo of what stood there."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Mask = NDArray[np.bool_]

FEATHER = 4.0
"""Pixels at 1024 over which the filling fades into the photo, inside the hole only."""
CLEAR = 2.0
"""Pixels beside an object that show a mixture with it."""
LEVEL, REACH = 3.0, 10.0
"""Pixels at 1024: blur in which filling and photo are compared along the border, and how far inside a difference of
level is evened out."""


def blend(
    photo: NDArray[np.uint8],
    filling: NDArray[np.uint8] | NDArray[np.float32],
    hole: Mask,
    objects: Mask,
    shade: Mask | None = None,
) -> NDArray[np.uint8]:
    """``filling`` (H, W, 3), 0 to 255, within ``hole`` (H, W), ``photo`` outside of it, bit for bit.

    objects: (H, W), may not be seen through the transition. Where there is room between them and the border of the
    hole, the photo is seen there, fading; and where the filling's level differs from the photo's along the border, it
    is led to it. shade: (H, W) shadow outside of the hole, to whose level nothing is led.
    """
    if not hole.any():
        return photo.copy()
    unit = max(hole.shape) / 1024.0
    filled = filling.astype(np.float32)
    filled = filled + _lead(photo.astype(np.float32), filled, hole, objects if shade is None else objects | shade, unit)
    alpha = feather(hole, objects)[..., None]
    mixed = np.where(alpha >= 1.0, filled, photo + alpha * (filled - photo))
    return np.where(hole[..., None], np.clip(mixed + 0.5, 0, 255).astype(np.uint8), photo)


def feather(hole: Mask, objects: Mask) -> NDArray[np.float32]:
    """Weight of the filling: 0 outside the hole, 1 deep inside and on the objects."""
    width = max(1.0, FEATHER * max(hole.shape) / 1024.0)
    depth = ndimage.distance_transform_edt(np.pad(hole, 1, mode="edge"))[1:-1, 1:-1]
    if objects.any():
        # Where an object comes close to the edge of its hole, the feather must end before it.
        away = ndimage.distance_transform_edt(~objects)
        room = np.maximum(depth + away - CLEAR, 1.0)
        weight = depth / np.minimum(width, room)
        weight[away <= CLEAR] = 1.0
    else:
        weight = depth / width
    return np.asarray(np.where(hole, np.clip(weight, 0.0, 1.0), 0.0), dtype=np.float32)


def _lead(
    photo: NDArray[np.float32], filled: NDArray[np.float32], hole: Mask, objects: Mask, unit: float
) -> NDArray[np.float32]:
    """What is added to ``filled`` so that its level meets the photo's at the border of the hole, (H, W, 3)."""
    rows, columns = np.flatnonzero(hole.any(axis=1)), np.flatnonzero(hole.any(axis=0))
    room = round(4 * REACH * unit) + 4
    window = (
        slice(max(0, rows[0] - room), rows[-1] + 1 + room),
        slice(max(0, columns[0] - room), columns[-1] + 1 + room),
    )
    inside, stood = hole[window], objects[window]
    depth = ndimage.distance_transform_edt(np.pad(inside, 1, mode="edge"))[1:-1, 1:-1]
    outer = ndimage.distance_transform_edt(~inside) if not inside.all() else np.full(inside.shape, np.inf)
    band = max(2.0, LEVEL * unit)
    clear = ndimage.distance_transform_edt(~stood) > CLEAR + 1.0 if stood.any() else np.ones_like(inside)
    shown = ~inside & (outer <= band) & clear
    new = inside & (depth <= band)
    result = np.zeros_like(filled)
    if not shown.any() or not new.any():
        return result

    def level(values: NDArray[np.float32], where: Mask) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        weight = cv2.GaussianBlur(where.astype(np.float32), (0, 0), band)
        total = cv2.GaussianBlur(values * where[..., None].astype(np.float32), (0, 0), band)
        mean = total / np.maximum(weight, 1e-6)[..., None]
        return np.asarray(mean, dtype=np.float32), np.asarray(weight, dtype=np.float32)

    seen, seen_weight = level(photo[window], shown)
    mine, my_weight = level(filled[window], new)
    rim = new & (depth <= 1.5) & (seen_weight > 1e-3) & (my_weight > 1e-3)
    if not rim.any():
        return result
    gap = np.where(rim[..., None], seen - mine, 0.0).astype(np.float32)
    spread = REACH * unit
    weight = cv2.GaussianBlur(rim.astype(np.float32), (0, 0), spread)
    smooth = cv2.GaussianBlur(gap, (0, 0), spread) / np.maximum(weight, 1e-6)[..., None]
    fade = np.exp(-np.square(depth / (2.0 * spread)))[..., None]
    result[window] = np.where(inside[..., None] & (weight > 1e-5)[..., None], smooth * fade, 0.0)
    return result
