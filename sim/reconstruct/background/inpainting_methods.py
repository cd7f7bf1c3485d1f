# SPDX-License-Identifier: MIT
"""Methods of inpainting one part of a hole: by rows, as a surface, by stretches, from above, as a lattice.

Which one is used is a matter of trial (``method_choice``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite.inpaint import FillOptions, inpaint_once
from ...robust_deviation import robust_deviation
from ...scene.model import Camera
from .lattice_pattern import ENOUGH, Lattice
from .relit_ground import near_any, smoothed
from .stretch_inpainting import fill_stretches, is_even
from .surface_inpainting import clamp_to_surroundings, fill_surface, light_field, logarithms
from .texture_prediction import stretches
from .top_view import to_photo, to_top_view, top_views, visible_in_photo

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

BANDS = (1.0, 2.0)
"""Blurs in pixels that separate the bands of detail."""
GAINS = (0.6, 1.8)
"""Limits of the gain on details."""
REACH = 0.2
"""Blur of their strength over the hole's size."""


def match_grain(picture: Picture, hole: Mask, known: Mask) -> Picture:
    """Return ``picture`` (h, w, 3) with the details in ``hole`` as strong as in its ``known`` surroundings nearby."""
    reach = max(4.0, REACH * float(np.sqrt(hole.sum())))
    result, finer = np.zeros_like(picture), picture
    inner = cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    if inner.sum() < 100:
        return picture
    for blur in BANDS:
        coarser = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur), dtype=np.float32)
        detail = finer - coarser
        size = np.asarray(np.abs(detail).mean(axis=-1), dtype=np.float32)
        # Mean sizes with large ones clipped: a few edges are not grain.
        size = np.minimum(size, np.float32(4.0 * float(np.median(size[inner])) + 0.5))
        wanted, has = _local(size, inner, reach), _local(size, hole, reach)
        gain = np.clip(wanted / np.maximum(has, 1e-2), *GAINS)
        result += np.where(hole[..., None], gain[..., None] * detail, detail)
        finer = coarser
    return np.asarray(result + finer, dtype=np.float32)


def _local(values: NDArray[np.float32], where: Mask, blur: float) -> NDArray[np.float32]:
    """Local mean of ``values`` (h, w) over pixels ``where``."""
    scale = min(1.0, 6.0 / blur)
    size = (max(4, round(where.shape[1] * scale)), max(4, round(where.shape[0] * scale)))
    weight = where.astype(np.float32)
    total, share = (
        cv2.GaussianBlur(cv2.resize(part, size, interpolation=cv2.INTER_AREA), (0, 0), blur * scale)
        for part in (np.asarray(values * weight, dtype=np.float32), weight)
    )
    # Deep inside no known pixel is near: fall back to the global mean.
    mean = float(values[where].mean())
    local = (total + 1e-3 * mean) / (share + 1e-3)
    return np.asarray(
        cv2.resize(local, (where.shape[1], where.shape[0]), interpolation=cv2.INTER_LINEAR), dtype=np.float32
    )


FINE = 2.5
"""Blur over the scale at which a large hole is solved: finer detail is laid anew, from whole stretches."""
STRETCHES = 6
"""Most stretches from which the detail of one hole comes."""
LEVEL_ROWS = 0.6
"""Cost of a stretch from other rows over that of one at the same height, where grain is as large and as sharp."""
GRAINY = (0.5, 0.8)
"""Robust over plain deviation of the detail: edges are below the first, grain is above the second."""


def lay_grain(picture: Picture, hole: Mask, known: Mask) -> Picture:
    """Return ``picture`` (h, w, 3) with the detail in ``hole`` (h, w) as strong as in its ``known`` surroundings, and
    the finest of it copied from there.

    A hole larger than ``SOLVE_SIDE`` is solved on a smaller copy, whose detail is put together of many small pieces:
    some blurred, some repeated. Detail of a surface without edges is copied in stretches as large as possible.
    """
    side = float(np.sqrt(hole.sum()))
    blur = FINE * side / SOLVE_SIDE
    given, picture = picture, _continued_outside(picture, hole | known, max(blur, BANDS[-1]))
    laid = _with_grain(picture, hole, known, side, blur)
    return np.asarray(np.where((hole | known)[..., None], laid, given), dtype=np.float32)


def _continued_outside(picture: Picture, surface: Mask, blur: float) -> Picture:
    """Return ``picture`` (h, w, 3) with ``surface`` (h, w) continued beyond its border, as far as a ``blur`` reaches.

    What is there, such as the object or the other side of an edge, would mix with the surface in blurs.
    """
    there = ~surface & near_any(surface, blur)
    return np.asarray(np.where(there[..., None], smoothed(picture, surface, blur), picture), dtype=np.float32)


def _with_grain(picture: Picture, hole: Mask, known: Mask, side: float, blur: float) -> Picture:
    inner = cv2.distanceTransform(known.astype(np.uint8), cv2.DIST_L2, 5) > blur
    if side <= SOLVE_SIDE or inner.sum() < 0.2 * hole.sum():
        return match_grain(picture, hole, known)
    smooth = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur), dtype=np.float32)
    detail = picture - smooth
    light = detail[inner].mean(axis=-1)
    grain = robust_deviation(light)
    share = float(np.clip((grain / max(float(light.std()), 1e-3) - GRAINY[0]) / (GRAINY[1] - GRAINY[0]), 0.0, 1.0))
    # Beside several surfaces, such as grass with a tree behind it, the bark would be seen in the grass.
    if share == 0.0 or not is_even(picture, known, side, float(light.std())):
        return match_grain(picture, hole, known)
    # Single spots and edges would be seen twice.
    source, laid = np.clip(detail, -4.0 * grain, 4.0 * grain), detail.copy()
    for stretch in stretches(hole, inner, most=STRETCHES, level=LEVEL_ROWS):
        new = stretch.copied(source)
        laid[stretch.new] = (1.0 - share) * detail[stretch.new] + share * new[stretch.new]
    return match_grain(np.asarray(np.where(hole[..., None], smooth + laid, picture), np.float32), hole, known)


VIEW_PIXELS = 1_300_000
"""Largest size of one view; larger ones are coarser than the photo."""
MIN_KNOWN = 0.06
"""Least visible share of the photo's part to inpaint the rest from."""
MIN_KNOWN_GROUND = 0.02
"""The same of a top view, much of which lies beside the photo: a trial hole between objects leaves 0.06 of it."""
BLEED = 1.5
"""Pixels of a top view within which others mix on the way back to the photo."""
MARGIN = 0.8
"""Margin of the photo around a hole, over the size of the hole."""
CONTRAST = 45.0
"""Standard deviation of a surface without its illumination in PatchMatch's 256 steps."""

SOLVE_SIDE = 160.0
"""Hole size in pixels for PatchMatch without illumination; larger holes are scaled down."""


@dataclass(frozen=True)
class InpaintingTask:
    """A part of the hole to inpaint.

    picture: (H, W, 3), values 0 to 255. target: (H, W) pixels to inpaint. closed: (H, W) other pixels that are not a
    source.
    """

    picture: Picture
    target: Mask
    closed: Mask
    camera: Camera
    options: FillOptions
    lattice: Lattice | None = None


Method = Callable[[InpaintingTask], Picture]


def by_rows(task: InpaintingTask) -> Picture:
    """Return the picture inpainted by PatchMatch as it is, preferring sources at the same height."""
    return _in_photo(task, _searched_by_rows)


def by_rows_without_light(task: InpaintingTask) -> Picture:
    """Like ``by_rows``, with the smooth illumination removed before and restored after."""
    return _in_photo(task, _searched_without_light)


def as_surface(task: InpaintingTask) -> Picture:
    """Return the picture inpainted as one surface seen frontally."""
    return _in_photo(task, fill_surface)


def by_stretches(task: InpaintingTask) -> Picture:
    """Return the picture inpainted with large copies from the same height, for irregular surfaces."""
    return _in_photo(task, fill_stretches)


def as_ground(task: InpaintingTask) -> Picture:
    """Return the picture inpainted as ground in top views; ground too far away for that, in the photo's view."""
    result, left = task.picture.copy(), task.target.copy()
    for view, part in top_views(task.camera, task.target, VIEW_PIXELS):
        # Ground inpainted so far is known to the next view, so that patterns continue.
        shown = visible_in_photo(view, np.zeros_like(left))
        known = visible_in_photo(view, task.closed | left)
        hole = shown & ~visible_in_photo(view, left & ~task.closed) & ~known
        if known.mean() < MIN_KNOWN_GROUND or not hole.any():
            continue
        filled = fill_surface(to_top_view(result, view), hole, ~known & ~hole, task.options)
        filled = _continued_outside(filled, hole | known, BLEED)
        rows, columns = box(part, 0)
        back = to_photo(filled, view, rows, columns)
        inner = part[rows, columns]
        result[rows, columns][inner] = back[inner]
        left &= ~part
    if left.any():
        return by_rows(InpaintingTask(result, left, task.closed, task.camera, task.options))
    return result


def as_lattice(task: InpaintingTask) -> Picture:
    """Return the picture with the pattern of ``task.lattice`` continued; by rows where there is none, or where what it
    repeats is seen nowhere."""
    if task.lattice is None:
        return by_rows(task)
    rows, columns = around(task)
    hole, barred = task.target[rows, columns], task.closed[rows, columns] & ~task.target[rows, columns]
    known = ~(hole | barred)
    if known.mean() < MIN_KNOWN:
        return by_rows(task)
    piece = np.ascontiguousarray(task.picture[rows, columns])
    logs = logarithms(piece)
    slow, lack = light_field(logs, known, hole)
    pattern = np.where(known[..., None], logs - slow - lack, 0.0).astype(np.float32)
    y, x = np.nonzero(hole)
    lattice = task.lattice.moved(columns.start, rows.start)
    found, weights = lattice.foretold(pattern, known, np.stack([x, y], axis=1).astype(np.float64) + 0.5)
    told = weights > ENOUGH
    new = piece.copy()
    new[y[told], x[told]] = np.exp(slow[y[told], x[told]] + found[told])
    left = np.zeros_like(hole)
    left[y[~told], x[~told]] = True
    result = task.picture.copy()
    result[rows, columns][hole & ~left] = new[hole & ~left]
    if not left.any():
        return result
    rest = np.zeros_like(task.target)
    rest[rows, columns] = left
    return by_rows(replace(task, picture=result, target=rest))


def around(task: InpaintingTask) -> tuple[slice, slice]:
    """Return the rows and columns of ``task``'s hole with its surroundings."""
    extent = int(np.ptp(np.argwhere(task.target), axis=0).max())
    return box(task.target, max(48, round(MARGIN * extent)))


def _in_photo(task: InpaintingTask, fill: Callable[[Picture, Mask, Mask, FillOptions], Picture]) -> Picture:
    rows, columns = around(task)
    hole, barred = task.target[rows, columns], task.closed[rows, columns] & ~task.target[rows, columns]
    if (~(hole | barred)).mean() < MIN_KNOWN:
        rows, columns = slice(0, len(task.target)), slice(0, task.target.shape[1])
        hole, barred = task.target, task.closed & ~task.target
    result = task.picture.copy()
    if (hole | barred).all():
        return result
    piece = np.ascontiguousarray(task.picture[rows, columns])
    filled = fill(piece, hole, barred, task.options)
    result[rows, columns][hole] = filled[hole]
    return result


def _searched_by_rows(picture: Picture, hole: Mask, barred: Mask, options: FillOptions) -> Picture:
    pixels = np.clip(picture + 0.5, 0, 255).astype(np.uint8)
    filled = inpaint_once(pixels, hole, barred, options, _heights(hole)).astype(np.float32)
    return lay_grain(np.where(hole[..., None], filled, picture), hole, ~(hole | barred))


def _searched_without_light(picture: Picture, hole: Mask, barred: Mask, options: FillOptions) -> Picture:
    known = ~(hole | barred)
    logs = logarithms(picture)
    slow, lack = light_field(logs, known, hole)
    pattern = logs - slow - lack
    centre = pattern[known].mean(axis=0)
    pattern = np.where(known[..., None], pattern - centre, 0.0)
    gain = min(CONTRAST / max(float(pattern[known].std()), 1e-3), 400.0)
    pixels = np.clip(127.5 + gain * pattern, 0, 255).astype(np.uint8)
    filled = inpaint_once(pixels, hole, barred, options, _heights(hole), SOLVE_SIDE).astype(np.float32)
    new = np.where(hole[..., None], (filled - 127.5) / gain + slow + centre, logs).astype(np.float32)
    result = np.where(hole[..., None], np.exp(clamp_to_surroundings(new, hole, known)), picture)
    return lay_grain(result.astype(np.float32), hole, known)


def _heights(hole: Mask) -> NDArray[np.float32]:
    guide = np.zeros((*hole.shape, 2), dtype=np.float32)
    guide[..., 0] = np.linspace(0.0, 1.0, len(guide), dtype=np.float32)[:, None]
    return guide


def box(mask: Mask, margin: int) -> tuple[slice, slice]:
    """Return rows and columns of the bounding box of ``mask`` (H, W) with a ``margin`` in pixels."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - margin), min(len(mask), int(rows[-1]) + 1 + margin)),
        slice(max(0, int(columns[0]) - margin), min(mask.shape[1], int(columns[-1]) + 1 + margin)),
    )


BY_STRETCHES, AS_LATTICE = "by stretches", "as a lattice"
METHODS: dict[str, Method] = {
    "by rows": by_rows,
    "by rows without light": by_rows_without_light,
    "as a surface": as_surface,
    BY_STRETCHES: by_stretches,
    "as ground": as_ground,
    AS_LATTICE: as_lattice,
}
