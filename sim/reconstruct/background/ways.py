# SPDX-License-Identifier: MIT
"""The ways in which a part of the hole can be filled; which suits it, ``trial`` finds out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...composite.inpaint import FillOptions, searched
from ...scene.model import Camera
from .bounds import bounded
from .grain import as_grainy
from .shading import light_field, logarithms
from .surface import fill_surface
from .top_view import inside_photo, seen_from_above, seen_in_photo, views_of

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]

VIEW_PIXELS = 1_300_000
"""Of one view, at most; larger ones are coarser than the photo."""
MIN_KNOWN = 0.06
"""Share of a view that must be seen to fill the rest from it."""
MARGIN = 0.8
"""How much of the photo around a hole is looked at, over the hole's size."""
CONTRAST = 45.0
"""Standard deviation that a surface without its light gets in PatchMatch's 256 steps, at most 3 times its own."""

SOLVE_SIDE = 160.0
"""Pixels; larger holes are searched at a scale that makes them this large, where the light is taken off."""


@dataclass(frozen=True)
class Task:
    """A part of the hole to be filled.

    picture: (H, W, 3), values 0 to 255. target: (H, W) what to fill. closed: (H, W) what else is no source.
    """

    picture: Picture
    target: Mask
    closed: Mask
    camera: Camera
    options: FillOptions


Way = Callable[[Task], Picture]


def by_rows(task: Task) -> Picture:
    """The picture filled by PatchMatch as it is, preferring sources at the same height."""
    return _in_photo(task, _searched_by_rows)


def by_rows_without_light(task: Task) -> Picture:
    """As ``by_rows``, with the slow light taken off before and put on again."""
    return _in_photo(task, _searched_without_light)


def as_surface(task: Task) -> Picture:
    """The picture filled as one surface seen square on."""
    return _in_photo(task, fill_surface)


def as_ground(task: Task) -> Picture:
    """The picture filled as ground, seen from above; what is too far away for that, as the photo shows it."""
    result, left = task.picture.copy(), task.target.copy()
    for view, part in views_of(task.camera, task.target, VIEW_PIXELS):
        # Ground that is filled already is known to the next view, so that patterns go on.
        shown = inside_photo(view, np.zeros_like(left))
        known = inside_photo(view, task.closed | left)
        hole = shown & ~inside_photo(view, left & ~task.closed) & ~known
        if known.mean() < MIN_KNOWN or not hole.any():
            continue
        filled = fill_surface(seen_from_above(result, view), hole, ~known & ~hole, task.options)
        rows, columns = box(part, 0)
        back = seen_in_photo(filled, view, rows, columns)
        inner = part[rows, columns]
        result[rows, columns][inner] = back[inner]
        left &= ~part
    if left.any():
        return by_rows(Task(result, left, task.closed, task.camera, task.options))
    return result


def _in_photo(task: Task, fill: Callable[[Picture, Mask, Mask, FillOptions], Picture]) -> Picture:
    extent = int(np.ptp(np.argwhere(task.target), axis=0).max())
    rows, columns = box(task.target, max(48, round(MARGIN * extent)))
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
    filled = searched(pixels, hole, barred, options, _heights(hole)).astype(np.float32)
    return as_grainy(np.where(hole[..., None], filled, picture), hole, ~(hole | barred))


def _searched_without_light(picture: Picture, hole: Mask, barred: Mask, options: FillOptions) -> Picture:
    known = ~(hole | barred)
    logs = logarithms(picture)
    slow, lack = light_field(logs, known, hole)
    pattern = logs - slow - lack
    centre = pattern[known].mean(axis=0)
    pattern = np.where(known[..., None], pattern - centre, 0.0)
    gain = min(CONTRAST / max(float(pattern[known].std()), 1e-3), 400.0)
    pixels = np.clip(127.5 + gain * pattern, 0, 255).astype(np.uint8)
    filled = searched(pixels, hole, barred, options, _heights(hole), SOLVE_SIDE).astype(np.float32)
    new = np.where(hole[..., None], (filled - 127.5) / gain + slow + centre, logs).astype(np.float32)
    result = np.where(hole[..., None], np.exp(bounded(new, hole, known)), picture)
    return as_grainy(result.astype(np.float32), hole, known)


def _heights(hole: Mask) -> NDArray[np.float32]:
    guide = np.zeros((*hole.shape, 2), dtype=np.float32)
    guide[..., 0] = np.linspace(0.0, 1.0, len(guide), dtype=np.float32)[:, None]
    return guide


def box(mask: Mask, margin: int) -> tuple[slice, slice]:
    """Rows and columns that ``mask`` (H, W) takes up, and ``margin`` pixels around."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - margin), min(len(mask), int(rows[-1]) + 1 + margin)),
        slice(max(0, int(columns[0]) - margin), min(mask.shape[1], int(columns[-1]) + 1 + margin)),
    )


WAYS: dict[str, Way] = {
    "by rows": by_rows,
    "by rows without light": by_rows_without_light,
    "as a surface": as_surface,
    "as ground": as_ground,
}
