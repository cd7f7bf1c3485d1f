# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Distance of a node to a body's surface, from the share of the node's surroundings that the body fills.

``deformable_contact`` has the equations, for thick and for thin bodies.
"""

import taichi as ti

from .layout import vec3

BISECTIONS = 10
"""Halvings of 2 cells or so: to 0.002 cells."""

LEAST_SLOPE = 0.05
"""Gradient (1/cell) of a share below which it tells no direction: that of a half-space 1.2 cells away."""


@ti.func
def distance_of_share(share: ti.f32):
    """Distance in cells outside a plane face at which a body fills ``share`` of a node's surroundings; see above."""
    q = ti.min(ti.max(share, 1e-6), 1.0 - 1e-6)
    outside = ti.min(q, 1.0 - q)
    d = 0.0
    if outside < 1.0 / 6.0:
        d = 1.5 - ti.pow(6.0 * outside, 1.0 / 3.0)
    else:
        d = (0.5 - outside) / 0.75
        for _ in ti.static(range(3)):
            d -= (0.5 - 0.75 * d + d * d * d / 3.0 - outside) / (d * d - 0.75)
    return ti.select(q > 0.5, -d, d)


@ti.func
def share_of_distance(d: ti.f32):
    """The share f(d) of a node's surroundings that a half-space fills whose face is ``d`` cells away; see above."""
    outside = ti.min(ti.abs(d), 1.5)
    far = 1.5 - outside
    q = far * far * far / 6.0
    if outside < 0.5:
        q = 0.5 - 0.75 * outside + outside * outside * outside / 3.0
    return ti.select(d < 0.0, 1.0 - q, q)


@ti.func
def slope_of_distance(d: ti.f32):
    """-f'(d) (1/cell), how steeply that share falls."""
    outside = ti.abs(d)
    slope = 0.75 - outside * outside
    if outside > 0.5:
        slope = 0.5 * ti.max(1.5 - outside, 0.0) ** 2
    return slope


@ti.func
def distance_from_middle(share: ti.f32, slope: ti.f32, thickness: ti.f32):
    """Distance in cells from the middle of a thin body whose share at a node is ``share`` and falls by ``slope``."""
    near, far = 0.0, 1.5 + 0.5 * thickness
    for _ in range(BISECTIONS):
        s = 0.5 * (near + far)
        g = share_of_distance(s - 0.5 * thickness) - share_of_distance(s + 0.5 * thickness)
        falls = slope_of_distance(s - 0.5 * thickness) - slope_of_distance(s + 0.5 * thickness)
        if g * slope > share * falls:
            near = s
        else:
            far = s
    return 0.5 * (near + far)


@ti.func
def slope_along(slope: vec3, other: vec3, thick: ti.i32):
    """Slope of a thin body's share across its face: along the other body's slope where that one is thick."""
    steep = slope.norm()
    if thick == 1 and other.norm() > LEAST_SLOPE:
        steep = ti.abs(slope.dot(other)) / other.norm()
    return steep
