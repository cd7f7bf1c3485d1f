# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index, attr-defined"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Which splats each tile of the picture has to blend, nearest first.

A pair is a splat and a tile that its ellipse touches. Pairs are counted and written by the device, in order of depth,
and put in order of tiles by the host: a stable sort of 16-bit numbers is a radix sort in numpy, quicker than the way
to a device and back that the list takes for it.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ...errors import InputError
from .projection import ACROSS, ALONG, DEPTH, MIDDLE, REACH, SLANT, Places, Table

Counts = ti.types.ndarray(dtype=ti.i32, ndim=1)

MOST_PAIRS = 16_000_000
"""Bound of memory: a pair takes some 60 bytes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pairs:
    """P pairs in order of splats (which are in order of depth), and how the tiles find theirs."""

    ranked: NDArray[np.int64]
    """(M,) the splats that are drawn, nearest first."""

    splat_starts: NDArray[np.int64]
    """(M + 1,) where the pairs of the n-th drawn splat begin."""

    splats: NDArray[np.int32]
    """(P,) the splat of each pair."""

    order: NDArray[np.int64]
    """(P,) pairs in order of tiles, within a tile nearest first."""

    tile_starts: NDArray[np.int64]
    """(tiles + 1,) where a tile's pairs begin in ``order``."""


@ti.func
def stretch(ellipses: Table, i, low, high):
    """How far splat ``i`` reaches left and right of its middle within rows ``low`` to ``high`` below it, in pixels; the
    first above the second where it does not reach there."""
    across, slant, along = ellipses[i, ACROSS], ellipses[i, SLANT], ellipses[i, ALONG]
    reach = ellipses[i, REACH]
    top = ti.sqrt(reach) / along
    first, last = ti.max(low, -top), ti.min(high, top)
    left, right = ti.cast(1.0, ti.f64), ti.cast(0.0, ti.f64)
    if first <= last:
        # In this row it reaches furthest right; on the other side of the middle, furthest left.
        furthest = -slant / along * ti.sqrt(reach / (slant * slant + along * along))
        right_row = ti.min(ti.max(furthest, first), last)
        left_row = ti.min(ti.max(-furthest, first), last)
        right = (ti.sqrt(ti.max(reach - (along * right_row) ** 2, 0.0)) - slant * right_row) / across
        left = -(ti.sqrt(ti.max(reach - (along * left_row) ** 2, 0.0)) + slant * left_row) / across
    return left, right


@ti.func
def pixels_between(low, high, first, last):
    """First and last of the pixels ``first`` to ``last`` whose centres lie between ``low`` and ``high``; the first of
    them after the last if there is none."""
    start = ti.min(ti.max(ti.ceil(low - 0.5), ti.cast(first, ti.f64)), ti.cast(last + 1, ti.f64))
    end = ti.max(ti.min(ti.floor(high - 0.5), ti.cast(last, ti.f64)), ti.cast(first - 1, ti.f64))
    return ti.cast(start, ti.i32), ti.cast(end, ti.i32)


@ti.func
def rows_of(ellipses: Table, i, first, last):
    """First and last of the rows ``first`` to ``last`` that splat ``i`` reaches."""
    top = ti.sqrt(ellipses[i, REACH]) / ellipses[i, ALONG]
    middle = ellipses[i, MIDDLE + 1]
    return pixels_between(middle - top, middle + top, first, last)


@ti.func
def tiles_in_row(ellipses: Table, i, row, tile, width, height):
    """First and last tile of splat ``i`` in the ``row``-th row of tiles."""
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


@ti.kernel
def find_pairs(
    ellipses: Table,
    ranked: Places,
    starts: Places,
    tile: ti.i32,
    width: ti.i32,
    height: ti.i32,
    write: ti.i32,
    counts: Places,
    splats: Counts,
    tiles: Counts,
):
    """Number of pairs of each drawn splat; with ``write`` their splats and tiles, from starts[n] on.

    One kernel for both, as two might round differently and not fit each other.
    """
    for n in range(ranked.shape[0]):
        i = ti.cast(ranked[n], ti.i32)
        found = 0
        top, bottom = rows_of(ellipses, i, 0, height - 1)
        if top <= bottom:
            for row in range(top // tile, bottom // tile + 1):
                first, last = tiles_in_row(ellipses, i, row, tile, width, height)
                if write == 1:
                    for column in range(first, last + 1):
                        slot = ti.cast(starts[n], ti.i32) + found + column - first
                        splats[slot] = i
                        tiles[slot] = row * ((width + tile - 1) // tile) + column
                found += last - first + 1
        counts[n] = found


def pairs_of(ellipses: NDArray[np.float64], width: int, height: int, tile: int) -> Pairs:
    """All pairs of ``ellipses`` (N, ELLIPSE) and the tiles of a picture. Raises InputError on more than MOST_PAIRS.

    Splats of the same depth keep their order.
    """
    drawn = np.flatnonzero(ellipses[:, REACH] > 0)
    ranked = drawn[np.argsort(ellipses[drawn, DEPTH], kind="stable")].astype(np.int64)
    counts, starts = np.zeros(len(ranked), dtype=np.int64), np.zeros(len(ranked) + 1, dtype=np.int64)
    splats, tiles = np.zeros(1, dtype=np.int32), np.zeros(1, dtype=np.int32)
    if len(ranked):
        find_pairs(ellipses, ranked, starts, tile, width, height, 0, counts, splats, tiles)
    # Splats beside the picture take no further part.
    seen = counts > 0
    ranked, counts = ranked[seen], counts[seen]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    total = int(starts[-1])
    if total > MOST_PAIRS:
        raise InputError(
            f"rendering: {len(ranked)} splats in a picture of {width}x{height} cover {total} tiles of {tile} pixels "
            f"together, more than {MOST_PAIRS}: give fewer or smaller splats, or a smaller picture"
        )
    splats, tiles = np.empty(total, dtype=np.int32), np.empty(total, dtype=np.int32)
    if total:
        find_pairs(ellipses, ranked, starts, tile, width, height, 1, counts, splats, tiles)
    tile_count = -(-width // tile) * -(-height // tile)
    ends = np.cumsum(np.bincount(tiles, minlength=tile_count))
    return Pairs(
        ranked=ranked,
        splat_starts=starts,
        splats=splats,
        order=_sorted(tiles, tile_count),
        tile_starts=np.concatenate([[0], ends]).astype(np.int64),
    )


def _sorted(tiles: NDArray[np.int32], tile_count: int) -> NDArray[np.int64]:
    """Stable order of ``tiles``, 16 bits at a time: those numpy sorts by radix."""
    order = np.argsort((tiles & 0xFFFF).astype(np.uint16), kind="stable")
    if tile_count > 0x10000:
        order = order[np.argsort((tiles[order] >> 16).astype(np.uint16), kind="stable")]
    return order.astype(np.int64, copy=False)
