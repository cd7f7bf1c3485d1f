# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Vectors in flat arrays of doubles, and turning. Numbers that are not powers of two are single precision here."""

import taichi as ti

dvec3 = ti.types.vector(3, ti.f64)
dvec4 = ti.types.vector(4, ti.f64)
dmat3 = ti.types.matrix(3, 3, ti.f64)

Doubles = ti.types.ndarray(dtype=ti.f64, ndim=1)


@ti.func
def load3(array: Doubles, i):
    """Three numbers from ``i`` on."""
    return dvec3(array[i], array[i + 1], array[i + 2])


@ti.func
def store3(array: Doubles, i, value):
    """Put three numbers at ``i``."""
    for c in ti.static(range(3)):
        array[i + c] = value[c]


@ti.func
def load33(array: Doubles, i):
    """Nine numbers from ``i`` on, row by row."""
    return dmat3(
        [array[i], array[i + 1], array[i + 2]],
        [array[i + 3], array[i + 4], array[i + 5]],
        [array[i + 6], array[i + 7], array[i + 8]],
    )


@ti.func
def store33(array: Doubles, i, value):
    """Put a matrix at ``i``, row by row."""
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            array[i + 3 * r + c] = value[r, c]


@ti.func
def quaternion_product(p, q):
    """Turn by ``q``, then by ``p``; w first."""
    return dvec4(
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@ti.func
def turned(q, way):
    """Quaternion ``q`` turned by the rotation vector ``way`` (world axes); of length 1 again."""
    angle = way.norm()
    half = angle / 2
    share = ti.cast(0.5, ti.f64)
    if angle > 1e-8:
        share = ti.sin(half) / angle
    p = quaternion_product(dvec4(ti.cos(half), share * way[0], share * way[1], share * way[2]), q)
    return p / p.norm()


@ti.func
def matrix_of(q):
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return dmat3(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )
