# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index, attr-defined"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""The splats that each tile of the image blends, nearest first; and their ellipses → pixels, with gradients.

A pair is a splat and a tile that its ellipse touches. Pairs are counted and written by the device, in order of depth,
and sorted by tile on the host: a stable sort of 16-bit integers is a radix sort in NumPy, faster than the transfer to a
device and back.

Pixels are blended front to back, and their gradients become gradients of ellipses, back to front (Kerbl et al. 2023,
eq. 3). One thread processes a tile: its splats one by one, and of each the pixels within its ellipse. So no two threads
add to the same number, and sums are deterministic.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ...errors import InputError
from ...mpm.kernels.kernel_bundles import kernel
from .splat_projection import ACROSS, ALONG, COLOUR, DEPTH, MIDDLE, OPACITY, REACH, SLANT, SUMS, Places, Reals2, Table

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


vec3 = ti.types.vector(3, ti.f32)
Layers = ti.types.ndarray(dtype=ti.f32, ndim=3)
Image = ti.types.ndarray(dtype=ti.i32, ndim=2)

FADE = 2.0 / 512.0
"""Alpha (twice CUT_OFF) above which a splat is drawn unchanged; below, it is faded linearly to 0 at CUT_OFF: a moving
splat does not pop in and out of pixels, and the gradient is complete."""

MAX_ALPHA = 0.999
"""Largest alpha of a splat in a pixel. The gradient is 0 where it is clamped."""

MIN_TRANSMITTANCE = 1e-5
"""Transmittance below which a pixel is finished."""

LIGHT, MEAN_DEPTH, STATE = 3, 4, 5
"""Offsets in the array of a pixel, after its colour: transmittance, weighted sum of depths; and its length."""


class PictureArrays(NamedTuple):
    """Image being blended, H x W pixels."""

    pixels: Layers
    """(H, W, STATE) colour, light that is left, sum of depths; comes empty with all its light."""

    last: Image
    """(H, W) place in ``PairArrays.order`` of the last splat of a pixel that finished early; written there only."""


class BackwardArrays(NamedTuple):
    """Gradients of pixels, and of pairs of splats and tiles."""

    upstream: Layers
    """(H, W, 4) dL/dcolour and dL/dalpha."""

    behind: Layers
    """(H, W, 2) light that is left after all splats, and dL/d that light; overwritten."""

    sums: Reals2
    """(P, SUMS) or longer: written, see ``SUMS``."""


class PairArrays(NamedTuple):
    """P pairs of splats and tiles, tile by tile."""

    tile: ti.i32
    """Side of a tile, pixels."""

    splats: Counts
    """(P,) splat of a pair."""

    order: Places
    """(P,) pairs in order of tiles, within a tile nearest first."""

    tile_starts: Places
    """(tiles + 1,) first place of a tile in ``order``."""

    tile_ends: Places
    """(tiles,) place of the first splat of a tile that no pixel needs any more; written by ``blend``."""


@ti.func
def columns_of(ellipses: Table, i, y, first, last):
    """Return, in pixel row ``y``, the first and last of the columns ``first`` to ``last`` that splat ``i`` touches, and
    (u, v) at the first. In double precision, as the centre may be far outside."""
    across, slant = ellipses[i, ACROSS], ellipses[i, SLANT]
    dy = ti.cast(y, ti.f64) + 0.5 - ellipses[i, MIDDLE + 1]
    v = ellipses[i, ALONG] * dy
    rest = ellipses[i, REACH] - v * v
    start, end = first, first - 1
    u = ti.cast(0.0, ti.f64)
    if rest > 0.0:
        half = ti.sqrt(rest)
        x = ellipses[i, MIDDLE]
        start, end = pixels_between(x - (slant * dy + half) / across, x - (slant * dy - half) / across, first, last)
        u = across * (ti.cast(start, ti.f64) + 0.5 - x) + slant * dy
    return start, end, ti.cast(u, ti.f32), ti.cast(v, ti.f32)


@ti.func
def alpha_of(opacity, u, v):
    """Return α at (u, v), and its derivative by the logarithm of opacity·G."""
    whole = opacity * ti.exp(-0.5 * (u * u + v * v))
    alpha = ti.max(2.0 * whole - FADE, 0.0)
    slope = 2.0 * whole
    if whole > FADE:
        alpha, slope = whole, whole
    if whole < 0.5 * FADE:
        slope = 0.0
    if whole > MAX_ALPHA:
        alpha, slope = MAX_ALPHA, 0.0
    return alpha, slope


@kernel
def blend(ellipses: Table, pairs: PairArrays, picture: PictureArrays):
    """Blend every tile's splats into ``picture``."""
    ti.loop_config(block_dim=1)
    for t in range(pairs.tile_ends.shape[0]):
        height, width = picture.last.shape[0], picture.last.shape[1]
        tiles_across = (width + pairs.tile - 1) // pairs.tile
        x_first, y_first = (t % tiles_across) * pairs.tile, (t // tiles_across) * pairs.tile
        x_last, y_last = ti.min(x_first + pairs.tile, width) - 1, ti.min(y_first + pairs.tile, height) - 1
        open_pixels = (x_last - x_first + 1) * (y_last - y_first + 1)
        k = ti.cast(pairs.tile_starts[t], ti.i32)
        end = ti.cast(pairs.tile_starts[t + 1], ti.i32)
        while k < end and open_pixels > 0:
            i = pairs.splats[pairs.order[k]]
            opacity = ti.cast(ellipses[i, OPACITY], ti.f32)
            step = ti.cast(ellipses[i, ACROSS], ti.f32)
            depth = ti.cast(ellipses[i, DEPTH], ti.f32)
            colour = vec3(ellipses[i, COLOUR], ellipses[i, COLOUR + 1], ellipses[i, COLOUR + 2])
            top, bottom = rows_of(ellipses, i, y_first, y_last)
            for y in range(top, bottom + 1):
                start, stop, u_start, v = columns_of(ellipses, i, y, x_first, x_last)
                for x in range(start, stop + 1):
                    light = picture.pixels[y, x, LIGHT]
                    if light >= MIN_TRANSMITTANCE:
                        alpha, _ = alpha_of(opacity, u_start + step * ti.cast(x - start, ti.f32), v)
                        weight = alpha * light
                        light *= 1.0 - alpha
                        # Not +=, which is atomic on arrays.
                        for c in ti.static(range(3)):
                            picture.pixels[y, x, c] = picture.pixels[y, x, c] + weight * colour[c]
                        picture.pixels[y, x, LIGHT] = light
                        picture.pixels[y, x, MEAN_DEPTH] = picture.pixels[y, x, MEAN_DEPTH] + weight * depth
                        if light < MIN_TRANSMITTANCE:
                            open_pixels -= 1
                            picture.last[y, x] = k
            k += 1
        pairs.tile_ends[t] = k


@kernel
def blend_back(ellipses: Table, last: Image, pairs: PairArrays, backward: BackwardArrays):
    """Write SUMS numbers of every pair."""
    ti.loop_config(block_dim=1)
    for t in range(pairs.tile_ends.shape[0]):
        height, width = last.shape[0], last.shape[1]
        tiles_across = (width + pairs.tile - 1) // pairs.tile
        x_first, y_first = (t % tiles_across) * pairs.tile, (t // tiles_across) * pairs.tile
        x_last, y_last = ti.min(x_first + pairs.tile, width) - 1, ti.min(y_first + pairs.tile, height) - 1
        begin, done, end = (
            ti.cast(pairs.tile_starts[t], ti.i32),
            ti.cast(pairs.tile_ends[t], ti.i32),
            ti.cast(pairs.tile_starts[t + 1], ti.i32),
        )
        for k in range(done, end):
            for c in ti.static(range(SUMS)):
                backward.sums[pairs.order[k], c] = 0.0
        for back in range(done - begin):
            k = done - 1 - back
            i = pairs.splats[pairs.order[k]]
            opacity = ti.cast(ellipses[i, OPACITY], ti.f32)
            step = ti.cast(ellipses[i, ACROSS], ti.f32)
            colour = vec3(ellipses[i, COLOUR], ellipses[i, COLOUR + 1], ellipses[i, COLOUR + 2])
            first, second, d_colour = vec3(0.0), vec3(0.0), vec3(0.0)
            top, bottom = rows_of(ellipses, i, y_first, y_last)
            for y in range(top, bottom + 1):
                start, stop, u_start, v = columns_of(ellipses, i, y, x_first, x_last)
                for x in range(start, stop + 1):
                    if k <= last[y, x]:
                        u = u_start + step * ti.cast(x - start, ti.f32)
                        alpha, slope = alpha_of(opacity, u, v)
                        light = backward.behind[y, x, 0] / (1.0 - alpha)
                        value = backward.behind[y, x, 1]
                        up = vec3(backward.upstream[y, x, 0], backward.upstream[y, x, 1], backward.upstream[y, x, 2])
                        own = up.dot(colour) + backward.upstream[y, x, 3]
                        g = light * (own - value) * slope
                        first += g * vec3(1.0, u, v)
                        second += g * vec3(u * u, u * v, v * v)
                        d_colour += alpha * light * up
                        backward.behind[y, x, 0] = light
                        backward.behind[y, x, 1] = value + alpha * (own - value)
            for c in ti.static(range(3)):
                backward.sums[pairs.order[k], c] = first[c]
                backward.sums[pairs.order[k], 3 + c] = second[c]
                backward.sums[pairs.order[k], 6 + c] = d_colour[c]
