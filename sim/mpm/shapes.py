# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Signed distances of solids on lattices, looked up on the device. Lengths in cells, points in the solid's own frame.

Shape s of all lattices: ``shape_numbers[4 s ..]`` first node xyz and spacing, ``shape_dims[4 s ..]`` nodes along x, y,
z and where its distances start in ``distances`` (C order, z fastest). Floats are as wide as the point passed in.
"""

import taichi as ti

from .layout import Integers, Scalars, ivec3


@ti.func
def outside_box(shape, point, shape_numbers: Scalars, shape_dims: Integers):
    """Vector from the nearest point of the lattice's box to ``point``; zero inside."""
    away = point
    for c in ti.static(range(3)):
        low = shape_numbers[4 * shape + c]
        high = low + shape_numbers[4 * shape + 3] * ti.cast(shape_dims[4 * shape + c] - 1, ti.f32)
        away[c] = point[c] - ti.min(ti.max(point[c], low), high)
    return away


@ti.func
def sample_distance(shape, point, shape_numbers: Scalars, shape_dims: Integers, distances: Scalars):
    """(gradient xyz, distance) of ``shape`` at ``point``, trilinear; the distance is negative inside the solid.

    Outside the lattice: the distance at the nearest point of its box plus the way there, which is no less than the true
    one, and the sum of both gradients, of length 1.
    """
    away = outside_box(shape, point, shape_numbers, shape_dims)
    inverse = 1.0 / shape_numbers[4 * shape + 3]
    low = point
    for c in ti.static(range(3)):
        low[c] = shape_numbers[4 * shape + c]
    g = (point - away - low) * inverse
    n = ivec3(shape_dims[4 * shape], shape_dims[4 * shape + 1], shape_dims[4 * shape + 2])
    i = ti.max(ti.min(ti.cast(g, ti.i32), n - 2), 0)
    f = g - i
    first = shape_dims[4 * shape + 3] + (i[0] * n[1] + i[1]) * n[2] + i[2]
    row, plane = n[2], n[1] * n[2]
    d000, d001 = distances[first], distances[first + 1]
    d010, d011 = distances[first + row], distances[first + row + 1]
    d100, d101 = distances[first + plane], distances[first + plane + 1]
    d110, d111 = distances[first + plane + row], distances[first + plane + row + 1]
    e00, e01 = d000 + f[2] * (d001 - d000), d010 + f[2] * (d011 - d010)
    e10, e11 = d100 + f[2] * (d101 - d100), d110 + f[2] * (d111 - d110)
    h0, h1 = e00 + f[1] * (e01 - e00), e10 + f[1] * (e11 - e10)
    gz0 = (d001 - d000) + f[1] * ((d011 - d010) - (d001 - d000))
    gz1 = (d101 - d100) + f[1] * ((d111 - d110) - (d101 - d100))
    gradient = inverse * ti.Vector(
        [h1 - h0, (e01 - e00) + f[0] * ((e11 - e10) - (e01 - e00)), gz0 + f[0] * (gz1 - gz0)]
    )
    phi = h0 + f[0] * (h1 - h0)
    far = away.norm()
    if far > 0.0:
        phi += far
        gradient += away / far
        gradient /= ti.max(gradient.norm(), 1e-12)
    return ti.Vector([gradient[0], gradient[1], gradient[2], phi])
