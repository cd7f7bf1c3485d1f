# SPDX-License-Identifier: MIT
"""Inpainting by PatchMatch (Barnes et al., SIGGRAPH 2009; Wexler et al., PAMI 2007).

pypatchmatch (MIT) ships a compiled library; a fixed seed makes it repeatable.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from ..errors import InputError

Mask = NDArray[np.bool_]
Guide = NDArray[np.float32]

SOLVE_SIDE = 220.0
"""Pixels; larger holes are filled at a scale that makes them this large: on more pixels patches see too little of the
structure around them, and it is slow."""
GUIDE_SCALE, GUIDE_WEIGHT = 0.1, 0.015
"""Cost of a patch from another row, chosen by eye; ten times as much repeats rows like wallpaper."""
FEATHER = 4.0
"""Pixels (at 1024) over which the filling blends into the photo, inside the hole only."""


@dataclass(frozen=True, kw_only=True)
class FillOptions:
    """Inpainting options.

    radius: patches span (2 radius + 1)² pixels, 1 to 10. limit: pixels searched at most, 1e4 to 1e8. seed: 0 to 2³²−1.
    by_row: prefer sources in the same row, as where a wall meets a floor.
    """

    radius: int = 4
    limit: int = 2_800_000
    seed: int = 0
    by_row: bool = False


def inpaint(
    pixels: NDArray[np.uint8],
    hole: Mask,
    objects: Mask,
    options: FillOptions | None = None,
    guide: Guide | None = None,
) -> NDArray[np.uint8]:
    """Return ``pixels`` (H, W, 3) with ``hole`` inpainted; outside the hole equal to the photo bit for bit.

    objects: (H, W), inside ``hole``; must not show in the filling or through its feathered edge.
    guide: (H, W, 2), 0 to 1; sources with similar values are preferred. Replaces by_row.
    Raises InputError when hardly any background is left to fill from, or the native library is missing.
    """
    options = options or FillOptions()
    if not hole.any():
        return pixels.copy()
    if (~hole).mean() < 0.02:
        raise InputError(
            f"objects and shadows cover {100 * hole.mean():.0f} % of the photo: no background is left to fill from; "
            "use a photo with more room around the objects, or a smaller hole_dilation"
        )
    filling = pixels.copy()
    for part in hole_parts(hole):
        _fill_part(filling, part, hole, options, guide)
    alpha = _feather(hole, objects)[..., None]
    mixed = np.where(alpha >= 1.0, filling, pixels + alpha * (filling.astype(np.float32) - pixels))
    return np.where(hole[..., None], np.clip(mixed + 0.5, 0, 255).astype(np.uint8), pixels)


def inpaint_once(
    pixels: NDArray[np.uint8],
    hole: Mask,
    barred: Mask,
    options: FillOptions,
    guide: Guide | None = None,
    solve_side: float = SOLVE_SIDE,
) -> NDArray[np.uint8]:
    """Return ``pixels`` (h, w, 3) with ``hole`` inpainted at once from pixels outside it and ``barred``; no feather.

    guide: as for ``inpaint``. solve_side: larger holes are filled at a scale that makes them this large. Raises
    InputError as ``inpaint``.
    """
    closed = hole | barred
    if not hole.any():
        return pixels.copy()
    if closed.all():
        raise InputError("objects and shadows cover all of this surface: no background is left to fill from")
    side = float(np.sqrt(hole.sum()))
    scale = min(1.0, solve_side / max(side, 1.0), float(np.sqrt(options.limit / hole.size)))
    if scale > 0.8:
        return _patch_match(pixels, hole, closed, options, guide)
    return _at_scale(pixels, hole, closed, scale, options, guide)


def hole_parts(hole: Mask) -> list[Mask]:
    """Return the connected parts of ``hole``, smallest first: they are filled best and then serve as sources."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(hole.astype(np.uint8), connectivity=8)
    order = np.argsort(stats[1:count, cv2.CC_STAT_AREA], kind="stable") + 1
    return [np.asarray(labels == index) for index in order]


def _fill_part(pixels: NDArray[np.uint8], part: Mask, hole: Mask, options: FillOptions, guide: Guide | None) -> None:
    """Fill the connected ``part`` of ``hole`` in ``pixels``, in place, from its surroundings outside of ``hole``."""
    rows, columns = np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))
    margin = max(48, round(0.7 * max(np.ptp(rows), np.ptp(columns))))
    window = (
        slice(max(0, rows[0] - margin), rows[-1] + 1 + margin),
        slice(max(0, columns[0] - margin), columns[-1] + 1 + margin),
    )
    if (~hole[window]).mean() < 0.1:
        window = (slice(None), slice(None))
    crop, own, closed = pixels[window], part[window], hole[window]
    side = float(np.sqrt(np.ptp(rows) * np.ptp(columns)))
    scale = min(1.0, SOLVE_SIDE / max(side, 1.0), float(np.sqrt(options.limit / own.size)))
    if guide is not None:
        guide = guide[window]
    elif options.by_row:
        guide = np.zeros((*own.shape, 2), dtype=np.float32)
        guide[..., 0] = np.linspace(0.0, 1.0, len(guide), dtype=np.float32)[:, None]
    if scale > 0.8:
        filled = _patch_match(crop, own, closed, options, guide)
    else:
        filled = _at_scale(crop, own, closed, scale, options, guide)
    crop[own] = filled[own]


def _patch_match(
    pixels: NDArray[np.uint8], hole: Mask, closed: Mask, options: FillOptions, guide: Guide | None
) -> NDArray[np.uint8]:
    """Return ``pixels`` with ``hole`` inpainted; ``closed`` pixels outside it are not sources."""
    # Imported late: it loads a native library.
    from patchmatch import patch_match

    if not getattr(patch_match, "patchmatch_available", False):
        raise InputError("the inpainting library pypatchmatch cannot be loaded; install it again for this Python")
    patch_match.set_random_seed(options.seed)
    image, holes = np.ascontiguousarray(pixels), hole.astype(np.uint8)
    barred = closed & ~hole
    excluded = barred.astype(np.uint8) if barred.any() else None
    try:
        if guide is not None:
            scaled = np.zeros(pixels.shape, dtype=np.float32)
            scaled[..., :2] = GUIDE_SCALE * guide
            return np.asarray(
                patch_match.inpaint_regularity(
                    image,
                    holes,
                    scaled,
                    global_mask=excluded,
                    patch_size=options.radius,
                    guide_weight=GUIDE_WEIGHT,
                )
            )
        return np.asarray(patch_match.inpaint(image, holes, global_mask=excluded, patch_size=options.radius))
    except RuntimeError as error:
        raise InputError(f"inpainting failed ({error}); use a photo with more room around the objects") from error


def _at_scale(
    pixels: NDArray[np.uint8], hole: Mask, closed: Mask, scale: float, options: FillOptions, guide: Guide | None
) -> NDArray[np.uint8]:
    """Return ``pixels`` inpainted at reduced ``scale``, where patches span whole structures, with fine detail restored.

    Detail of each filled pixel comes from the pixel outside the hole with the most similar coarse neighbourhood.
    """
    height, width = hole.shape
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    small_hole, small_closed = (
        cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0 for mask in (hole, closed)
    )
    if guide is not None:
        guide = np.asarray(cv2.resize(guide, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    filled = _patch_match(small, small_hole, small_closed, options, guide)
    enlarged = cv2.resize(filled, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    source_rows, source_columns = _alike(filled, small_hole, small_closed)
    rows, columns = np.indices(hole.shape)
    near_rows = np.clip(np.round((rows + 0.5) * size[1] / height - 0.5).astype(int), 0, size[1] - 1)
    near_columns = np.clip(np.round((columns + 0.5) * size[0] / width - 0.5).astype(int), 0, size[0] - 1)
    down = source_rows[near_rows, near_columns] - near_rows
    across = source_columns[near_rows, near_columns] - near_columns
    from_rows = np.clip(rows + np.round(down * height / size[1]).astype(int), 0, height - 1)
    from_columns = np.clip(columns + np.round(across * width / size[0]).astype(int), 0, width - 1)
    known = np.where(closed[..., None], enlarged, pixels).astype(np.float32)
    shrunk = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
    coarse = cv2.resize(shrunk, (width, height), interpolation=cv2.INTER_CUBIC)
    detail = known - coarse
    return np.asarray(np.clip(enlarged + detail[from_rows, from_columns] + 0.5, 0, 255), dtype=np.uint8)


def _alike(
    filled: NDArray[np.uint8], hole: Mask, closed: Mask, block: int = 3, sources: int = 60_000
) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """Return row and column (h, w) of each pixel's most similar one outside ``closed``; itself outside ``hole``.

    Matched once per ``block`` x ``block`` pixels and shared by its neighbours, so that details stay together.
    """
    height, width = hole.shape
    # Descriptor: mean colours of a 3x3 neighbourhood of small squares, 27 numbers.
    smooth = cv2.blur(filled, (2, 2)).astype(np.float32)
    padded = np.pad(smooth, ((2, 2), (2, 2), (0, 0)), mode="reflect")
    features = np.concatenate(
        [padded[2 + dy : 2 + dy + height, 2 + dx : 2 + dx + width] for dy in (-2, 0, 2) for dx in (-2, 0, 2)], axis=-1
    )
    inner = np.zeros_like(hole)
    inner[2 : height - 2, 2 : width - 2] = True
    source = np.argwhere(inner & ~ndimage.binary_dilation(closed, iterations=3))
    rows, columns = np.mgrid[:height, :width]
    if len(source) == 0:
        return rows, columns
    source = source[:: max(1, len(source) // sources)]
    anchors = np.argwhere(
        ndimage.binary_dilation(hole, iterations=block) & (rows % block == 1) & (columns % block == 1)
    )
    if len(anchors) == 0:
        return rows, columns
    tree = cKDTree(features[source[:, 0], source[:, 1]])
    match = source[tree.query(features[anchors[:, 0], anchors[:, 1]], eps=1.0)[1]]
    offset = np.zeros((height, width, 2), dtype=np.int64)
    offset[anchors[:, 0], anchors[:, 1]] = match - anchors
    centre_rows = np.minimum(rows // block * block + 1, height - 1)
    centre_columns = np.minimum(columns // block * block + 1, width - 1)
    carried = np.where(hole[..., None], offset[centre_rows, centre_columns], 0)
    return rows + carried[..., 0], columns + carried[..., 1]


def _feather(hole: Mask, objects: Mask) -> NDArray[np.float32]:
    """Return the filling's weight (H, W): 0 outside the hole, 1 deep inside and on the objects."""
    width = max(1.0, FEATHER * max(hole.shape) / 1024.0)
    depth = ndimage.distance_transform_edt(np.pad(hole, 1, mode="edge"))[1:-1, 1:-1]
    if objects.any():
        # Where an object is close to the edge of its hole, the feather ends before it.
        away = ndimage.distance_transform_edt(~objects)
        room = np.maximum(depth + away - 2.0, 1.0)
        weight = depth / np.minimum(width, room)
    else:
        weight = depth / width
    weight = np.clip(weight, 0.0, 1.0)
    weight[objects] = 1.0
    return np.asarray(np.where(hole, weight, 0.0), dtype=np.float32)
