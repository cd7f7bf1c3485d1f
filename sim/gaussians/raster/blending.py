# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index, attr-defined"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Ellipses → pixels, front to back, and the gradients of pixels → gradients of ellipses, back to front.

Kerbl et al. 2023, eq. 3. A tile is one thread's: it takes its splats one by one and of each the pixels within its
ellipse, so no two threads ever add to the same number, and sums do not depend on who came first.
"""

import taichi as ti

from .projection import ACROSS, ALONG, COLOUR, DEPTH, MIDDLE, OPACITY, REACH, SLANT, SUMS, Places, Reals2, Table
from .tiles import Counts, pixels_between, rows_of

vec3 = ti.types.vector(3, ti.f32)
Layers = ti.types.ndarray(dtype=ti.f32, ndim=3)
Image = ti.types.ndarray(dtype=ti.i32, ndim=2)

FADE = 2.0 / 512.0
"""Share of light (twice CUT_OFF) from which on a splat has its full share; below, it falls linearly to none at CUT_OFF:
a splat that moves does not jump in and out of pixels, and the gradient misses nothing."""

MOST_ALPHA = 0.999
"""Largest share of light that a splat holds back in a pixel. Its gradient is 0 where this is in force."""

LEAST_LIGHT = 1e-5
"""Share of light below which a pixel is finished."""

LIGHT, MEAN_DEPTH, STATE = 3, 4, 5
"""Of a pixel: its colour, what light is left, the sum of depths."""


@ti.func
def columns_of(ellipses: Table, i, y, first, last):
    """In pixel row ``y``: first and last of the columns ``first`` to ``last`` that splat ``i`` reaches, and (u, v) at
    the first. In double precision, as the middle may be far outside."""
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
    """α at (u, v), and its derivative by the logarithm of opacity·G."""
    whole = opacity * ti.exp(-0.5 * (u * u + v * v))
    alpha = ti.max(2.0 * whole - FADE, 0.0)
    slope = 2.0 * whole
    if whole > FADE:
        alpha, slope = whole, whole
    if whole < 0.5 * FADE:
        slope = 0.0
    if whole > MOST_ALPHA:
        alpha, slope = MOST_ALPHA, 0.0
    return alpha, slope


@ti.kernel
def blend(
    ellipses: Table,
    splats: Counts,
    order: Places,
    tile_starts: Places,
    tile: ti.i32,
    tile_ends: Places,
    pixels: Layers,
    last: Image,
):
    """Blend every tile's splats into ``pixels`` (H, W, STATE), which come empty with all their light.

    last (H, W): written where a pixel finished early: the place in ``order`` of its last splat. tile_ends: place of the
    first splat of each tile that no pixel wanted any more.
    """
    ti.loop_config(block_dim=1)
    for t in range(tile_ends.shape[0]):
        height, width = last.shape[0], last.shape[1]
        tiles_across = (width + tile - 1) // tile
        x_first, y_first = (t % tiles_across) * tile, (t // tiles_across) * tile
        x_last, y_last = ti.min(x_first + tile, width) - 1, ti.min(y_first + tile, height) - 1
        open_pixels = (x_last - x_first + 1) * (y_last - y_first + 1)
        k = ti.cast(tile_starts[t], ti.i32)
        end = ti.cast(tile_starts[t + 1], ti.i32)
        while k < end and open_pixels > 0:
            i = splats[order[k]]
            opacity = ti.cast(ellipses[i, OPACITY], ti.f32)
            step = ti.cast(ellipses[i, ACROSS], ti.f32)
            depth = ti.cast(ellipses[i, DEPTH], ti.f32)
            colour = vec3(ellipses[i, COLOUR], ellipses[i, COLOUR + 1], ellipses[i, COLOUR + 2])
            top, bottom = rows_of(ellipses, i, y_first, y_last)
            for y in range(top, bottom + 1):
                start, stop, u_start, v = columns_of(ellipses, i, y, x_first, x_last)
                for x in range(start, stop + 1):
                    light = pixels[y, x, LIGHT]
                    if light >= LEAST_LIGHT:
                        alpha, _ = alpha_of(opacity, u_start + step * ti.cast(x - start, ti.f32), v)
                        weight = alpha * light
                        light *= 1.0 - alpha
                        # Not +=, which is atomic on arrays.
                        for c in ti.static(range(3)):
                            pixels[y, x, c] = pixels[y, x, c] + weight * colour[c]
                        pixels[y, x, LIGHT] = light
                        pixels[y, x, MEAN_DEPTH] = pixels[y, x, MEAN_DEPTH] + weight * depth
                        if light < LEAST_LIGHT:
                            open_pixels -= 1
                            last[y, x] = k
            k += 1
        tile_ends[t] = k


@ti.kernel
def blend_back(
    ellipses: Table,
    splats: Counts,
    order: Places,
    tile_starts: Places,
    tile: ti.i32,
    tile_ends: Places,
    last: Image,
    upstream: Layers,
    behind: Layers,
    sums: Reals2,
):
    """Write SUMS numbers of every pair.

    upstream (H, W, 4): ∂L/∂colour and ∂L/∂alpha. behind (H, W, 2): the light that is left after all splats, and
    ∂L/∂that light; used up.
    """
    ti.loop_config(block_dim=1)
    for t in range(tile_ends.shape[0]):
        height, width = last.shape[0], last.shape[1]
        tiles_across = (width + tile - 1) // tile
        x_first, y_first = (t % tiles_across) * tile, (t // tiles_across) * tile
        x_last, y_last = ti.min(x_first + tile, width) - 1, ti.min(y_first + tile, height) - 1
        begin, done, end = (
            ti.cast(tile_starts[t], ti.i32),
            ti.cast(tile_ends[t], ti.i32),
            ti.cast(tile_starts[t + 1], ti.i32),
        )
        for k in range(done, end):
            for c in ti.static(range(SUMS)):
                sums[order[k], c] = 0.0
        for back in range(done - begin):
            k = done - 1 - back
            i = splats[order[k]]
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
                        light = behind[y, x, 0] / (1.0 - alpha)
                        value = behind[y, x, 1]
                        up = vec3(upstream[y, x, 0], upstream[y, x, 1], upstream[y, x, 2])
                        own = up.dot(colour) + upstream[y, x, 3]
                        g = light * (own - value) * slope
                        first += g * vec3(1.0, u, v)
                        second += g * vec3(u * u, u * v, v * v)
                        d_colour += alpha * light * up
                        behind[y, x, 0] = light
                        behind[y, x, 1] = value + alpha * (own - value)
            for c in ti.static(range(3)):
                sums[order[k], c] = first[c]
                sums[order[k], 3 + c] = second[c]
                sums[order[k], 6 + c] = d_colour[c]
