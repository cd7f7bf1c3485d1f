# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index, attr-defined"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Ellipses → pixels, front to back, and the gradients of pixels → gradients of ellipses, back to front.

Kerbl et al. 2023, eq. 3. One thread processes a tile: its splats one by one, and of each the pixels within its ellipse.
So no two threads add to the same number, and sums are deterministic.
"""

from typing import NamedTuple

import taichi as ti

from ...mpm.kernels.kernel_bundles import kernel
from .splat_projection import ACROSS, ALONG, COLOUR, DEPTH, MIDDLE, OPACITY, REACH, SLANT, SUMS, Places, Reals2, Table
from .tiles import Counts, pixels_between, rows_of

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
