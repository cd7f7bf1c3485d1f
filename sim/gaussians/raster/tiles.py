# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index, attr-defined"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""The splats that each tile of the image blends, nearest first.

A pair is a splat and a tile that its ellipse touches. Pairs are counted and written by the device, in order of depth,
and sorted by tile on the host: a stable sort of 16-bit integers is a radix sort in NumPy, faster than the transfer to a
device and back.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ...errors import InputError
from ...mpm.kernels.kernel_bundles import kernel
from .splat_projection import ACROSS, ALONG, DEPTH, MIDDLE, REACH, SLANT, Places, Table

Counts = ti.types.ndarray(dtype=ti.i32, ndim=1)

MAX_PAIRS = 16_000_000
"""Bounds memory: a pair takes about 60 bytes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TilePairs:
    """P pairs ordered by splat (in order of depth), and their order by tile."""

    ranked: NDArray[np.int64]
    """(M,) indices of the drawn splats, nearest first."""

    splat_starts: NDArray[np.int64]
    """(M + 1,) index of the first pair of the n-th drawn splat."""

    splats: NDArray[np.int32]
    """(P,) the splat of each pair."""

    order: NDArray[np.int64]
    """(P,) pairs ordered by tile, within a tile nearest first."""

    tile_starts: NDArray[np.int64]
    """(tiles + 1,) index in ``order`` of each tile's first pair."""


class TileLayout(NamedTuple):
    """Side of a tile and size of the image, pixels."""

    tile: ti.i32
    width: ti.i32
    height: ti.i32


class PairLists(NamedTuple):
    """Pairs of M drawn splats and the tiles that they touch."""

    ranked: Places
    """(M,) drawn splats, nearest first."""

    starts: Places
    """(M,) or longer: first pair of a drawn splat."""

    counts: Places
    """(M,) written: pairs of a drawn splat."""

    splats: Counts
    """(P,) written: splat of a pair."""

    tiles: Counts
    """(P,) written: tile of a pair."""


@ti.func
def stretch(ellipses: Table, i, low, high):
    """Return the horizontal extent, left and right of its centre in pixels, of splat ``i`` within rows ``low`` to
    ``high`` below the centre; left > right where it does not reach there."""
    across, slant, along = ellipses[i, ACROSS], ellipses[i, SLANT], ellipses[i, ALONG]
    reach = ellipses[i, REACH]
    top = ti.sqrt(reach) / along
    first, last = ti.max(low, -top), ti.min(high, top)
    left, right = ti.cast(1.0, ti.f64), ti.cast(0.0, ti.f64)
    if first <= last:
        # In this row it reaches furthest right; in the mirrored row, furthest left.
        furthest = -slant / along * ti.sqrt(reach / (slant * slant + along * along))
        right_row = ti.min(ti.max(furthest, first), last)
        left_row = ti.min(ti.max(-furthest, first), last)
        right = (ti.sqrt(ti.max(reach - (along * right_row) ** 2, 0.0)) - slant * right_row) / across
        left = -(ti.sqrt(ti.max(reach - (along * left_row) ** 2, 0.0)) + slant * left_row) / across
    return left, right


@ti.func
def pixels_between(low, high, first, last):
    """Return the first and last of the pixels ``first`` to ``last`` with centres between ``low`` and ``high``; first >
    last if there is none."""
    start = ti.min(ti.max(ti.ceil(low - 0.5), ti.cast(first, ti.f64)), ti.cast(last + 1, ti.f64))
    end = ti.max(ti.min(ti.floor(high - 0.5), ti.cast(last, ti.f64)), ti.cast(first - 1, ti.f64))
    return ti.cast(start, ti.i32), ti.cast(end, ti.i32)


@ti.func
def rows_of(ellipses: Table, i, first, last):
    """Return the first and last of the rows ``first`` to ``last`` that splat ``i`` touches."""
    top = ti.sqrt(ellipses[i, REACH]) / ellipses[i, ALONG]
    middle = ellipses[i, MIDDLE + 1]
    return pixels_between(middle - top, middle + top, first, last)


@ti.func
def tiles_in_row(ellipses: Table, i, row, tile, width, height):
    """Return the first and last tile of splat ``i`` in row ``row`` of tiles."""
    middle = ellipses[i, MIDDLE + 1]
    low = ti.cast(row * tile, ti.f64) + 0.5 - middle
    high = ti.cast(ti.min((row + 1) * tile, height), ti.f64) - 0.5 - middle
    left, right = stretch(ellipses, i, low, high)
    first, last = 0, -1
    if left <= right:
        x = ellipses[i, MIDDLE]
        start, end = pixels_between(x + left, x + right, 0, width - 1)
        if start <= end:
            first, last = start // tile, end // tile
    return first, last


@kernel
def find_pairs(ellipses: Table, write: ti.i32, layout: TileLayout, lists: PairLists):
    """Count the pairs of each drawn splat; if ``write``, store their splats and tiles from starts[n].

    One kernel for both passes, because two could round differently.
    """
    for n in range(lists.ranked.shape[0]):
        i = ti.cast(lists.ranked[n], ti.i32)
        found = 0
        top, bottom = rows_of(ellipses, i, 0, layout.height - 1)
        if top <= bottom:
            for row in range(top // layout.tile, bottom // layout.tile + 1):
                first, last = tiles_in_row(ellipses, i, row, layout.tile, layout.width, layout.height)
                if write == 1:
                    for column in range(first, last + 1):
                        slot = ti.cast(lists.starts[n], ti.i32) + found + column - first
                        lists.splats[slot] = i
                        lists.tiles[slot] = row * ((layout.width + layout.tile - 1) // layout.tile) + column
                found += last - first + 1
        lists.counts[n] = found


def pairs_of(ellipses: NDArray[np.float64], width: int, height: int, tile: int) -> TilePairs:
    """Return all pairs of ``ellipses`` (N, ELLIPSE) and the tiles of an image; splats of equal depth keep their order.

    width, height, tile: pixels. Raises InputError for more than ``MAX_PAIRS``.
    """
    drawn = np.flatnonzero(ellipses[:, REACH] > 0)
    ranked = drawn[np.argsort(ellipses[drawn, DEPTH], kind="stable")].astype(np.int64)
    counts, starts = np.zeros(len(ranked), dtype=np.int64), np.zeros(len(ranked) + 1, dtype=np.int64)
    splats, tiles = np.zeros(1, dtype=np.int32), np.zeros(1, dtype=np.int32)
    layout = TileLayout(tile, width, height)
    if len(ranked):
        find_pairs(ellipses, 0, layout, PairLists(ranked, starts, counts, splats, tiles))
    # Splats outside the image are dropped.
    seen = counts > 0
    ranked, counts = ranked[seen], counts[seen]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    total = int(starts[-1])
    if total > MAX_PAIRS:
        raise InputError(
            f"rendering: {len(ranked)} splats in an image of {width}x{height} cover {total} tiles of {tile} pixels in "
            f"total, more than {MAX_PAIRS}: use fewer or smaller splats, or a smaller image"
        )
    splats, tiles = np.empty(total, dtype=np.int32), np.empty(total, dtype=np.int32)
    if total:
        find_pairs(ellipses, 1, layout, PairLists(ranked, starts, counts, splats, tiles))
    tile_count = -(-width // tile) * -(-height // tile)
    ends = np.cumsum(np.bincount(tiles, minlength=tile_count))
    return TilePairs(
        ranked=ranked,
        splat_starts=starts,
        splats=splats,
        order=_sorted(tiles, tile_count),
        tile_starts=np.concatenate([[0], ends]).astype(np.int64),
    )


def _sorted(tiles: NDArray[np.int32], tile_count: int) -> NDArray[np.int64]:
    """Return the stable order of ``tiles``, sorted 16 bits at a time: NumPy uses radix sort for those."""
    order = np.argsort((tiles & 0xFFFF).astype(np.uint16), kind="stable")
    if tile_count > 0x10000:
        order = order[np.argsort((tiles[order] >> 16).astype(np.uint16), kind="stable")]
    return order.astype(np.int64, copy=False)
