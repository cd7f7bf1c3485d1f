# SPDX-License-Identifier: MIT
"""The photo without its objects: PatchMatch (Barnes et al., SIGGRAPH 2009; Wexler et al., PAMI 2007).

pypatchmatch (MIT) ships a compiled library; with a fixed seed equal inputs give equal results.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..errors import InputError

Mask = NDArray[np.bool_]

FEATHER = 4.0
"""Pixels at 1024 over which the filling fades into the photo, inside the hole only."""


def inpaint(
    pixels: NDArray[np.uint8], hole: Mask, objects: Mask, *, radius: int = 3, limit: int = 2_800_000, seed: int = 0
) -> NDArray[np.uint8]:
    """``pixels`` (H, W, 3) with ``hole`` filled from elsewhere; outside the hole equal to the photo bit for bit.

    objects: what may be seen neither in the filling nor through the feather at its edge, inside ``hole``.
    radius: patches span (2 radius + 1)² pixels. limit: more pixels than this are filled at lower resolution.
    Raises InputError when hardly any background is left to fill from, or the native library is missing.
    """
    if not hole.any():
        return pixels.copy()
    if (~hole).mean() < 0.02:
        raise InputError(
            f"objects and shadows cover {100 * hole.mean():.0f} % of the photo: no background is left to fill from; "
            "use a photo with more room around the objects, or a smaller hole_dilation"
        )
    scale = min(1.0, float(np.sqrt(limit / hole.size)))
    filling = _patch_match(pixels, hole, radius, seed) if scale == 1.0 else _at_scale(pixels, hole, scale, radius, seed)
    alpha = _feather(hole, objects)[..., None]
    mixed = np.where(alpha >= 1.0, filling, pixels + alpha * (filling.astype(np.float32) - pixels))
    return np.where(hole[..., None], np.clip(mixed + 0.5, 0, 255).astype(np.uint8), pixels)


def _patch_match(pixels: NDArray[np.uint8], hole: Mask, radius: int, seed: int) -> NDArray[np.uint8]:
    # Imported late: loading a native library must not be the price of importing the package.
    from patchmatch import patch_match

    if not getattr(patch_match, "patchmatch_available", False):
        raise InputError("the inpainting library pypatchmatch cannot be loaded; install it again for this Python")
    patch_match.set_random_seed(seed)
    # Only the surroundings of the hole: far away patches cost time and seldom fit.
    rows, columns = np.flatnonzero(hole.any(axis=1)), np.flatnonzero(hole.any(axis=0))
    margin = max(64, round(0.6 * max(np.ptp(rows), np.ptp(columns))))
    window = (
        slice(max(0, rows[0] - margin), rows[-1] + 1 + margin),
        slice(max(0, columns[0] - margin), columns[-1] + 1 + margin),
    )
    result = pixels.copy()
    try:
        result[window] = patch_match.inpaint(
            np.ascontiguousarray(pixels[window]), hole[window].astype(np.uint8), patch_size=radius
        )
    except RuntimeError as error:
        raise InputError(f"inpainting failed ({error}); use a photo with more room around the objects") from error
    return result


def _at_scale(pixels: NDArray[np.uint8], hole: Mask, scale: float, radius: int, seed: int) -> NDArray[np.uint8]:
    """Fill a smaller copy, enlarge the filling, and give it back the grain that the enlargement lacks."""
    height, width = hole.shape
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    small_hole = cv2.resize(hole.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    filled = _patch_match(small, small_hole, radius, seed)
    enlarged = cv2.resize(filled, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    blurred = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    detail = pixels - blurred
    # Detail of the photo left of the hole, mirrored into it column by column, is grain in the right place.
    inside = ndimage.distance_transform_edt(hole, return_distances=False, return_indices=True)
    rows, columns = np.indices(hole.shape)
    source_rows = np.clip(2 * inside[0] - rows, 0, height - 1)
    source_columns = np.clip(2 * inside[1] - columns, 0, width - 1)
    grain = np.clip(detail[source_rows, source_columns], -12, 12)
    grain[hole[source_rows, source_columns]] = 0
    return np.asarray(np.clip(enlarged + grain + 0.5, 0, 255), dtype=np.uint8)


def _feather(hole: Mask, objects: Mask) -> NDArray[np.float32]:
    """Weight of the filling: 0 outside the hole, 1 deep inside and on the objects."""
    width = max(1.0, FEATHER * max(hole.shape) / 1024.0)
    depth = ndimage.distance_transform_edt(np.pad(hole, 1, mode="edge"))[1:-1, 1:-1]
    if objects.any():
        # Where an object comes close to the edge of its hole, the feather must end before it.
        away = ndimage.distance_transform_edt(~objects)
        room = np.maximum(depth + away - 2.0, 1.0)
        weight = depth / np.minimum(width, room)
    else:
        weight = depth / width
    weight = np.clip(weight, 0.0, 1.0)
    weight[objects] = 1.0
    return np.asarray(np.where(hole, weight, 0.0), dtype=np.float32)
