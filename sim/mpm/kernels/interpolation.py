# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Between particles and the nodes of their windows: interpolation at a particle, spreading from one.

Quadratic B-splines; APIC (Jiang et al. 2015) with second derivatives for solids (PolyPIC, Fu et al. 2017).
"""

import taichi as ti

from .layout import mat3, vec3, vec4
from .windows import add_to, add_whole, is_whole, layer, node_of

CURVED = 0.95
"""Share of the second derivatives of the velocity around a particle of a solid that it carries from substep to substep
(PolyPIC, Fu et al. 2017). 0 is plain APIC; 1 would damp third derivatives only, and keep noise of one cell for long."""

LARGEST_WEIGHT = 0.75**3
"""Largest weight of a particle at a node."""


@ti.func
def weights(fx: vec3):
    """Quadratic B-spline weights (list of three vectors) at distance ``fx`` from the lowest node, 0.5 <= fx < 1.5."""
    return [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]


@ti.func
def columns(matrix: mat3):
    """The columns of ``matrix``, each with a fourth number 0."""
    return (
        vec4(matrix[0, 0], matrix[1, 0], matrix[2, 0], 0.0),
        vec4(matrix[0, 1], matrix[1, 1], matrix[2, 1], 0.0),
        vec4(matrix[0, 2], matrix[1, 2], matrix[2, 2], 0.0),
    )


@ti.func
def along_line(first: ti.i32, w: ti.template(), window: ti.template()):
    """Of three nodes from ``first`` on: their mean under the weights of the last axis, and first moment."""
    u1 = w[1][2] * node_of(window, first + 1)
    u2 = w[2][2] * node_of(window, first + 2)
    slope = u1 + u2
    return w[0][2] * node_of(window, first) + slope, slope + u2


@ti.func
def across_layer(first: ti.i32, w: ti.template(), window: ti.template()):
    """Of nine nodes from ``first`` on: mean, and first moments along the last two axes."""
    S0, T0 = along_line(first, w, window)
    S1, T1 = along_line(first + 8, w, window)
    S2, T2 = along_line(first + 16, w, window)
    t1, t2 = w[1][1] * S1, w[2][1] * S2
    B1 = t1 + t2
    return w[0][1] * S0 + B1, B1 + t2, w[0][1] * T0 + w[1][1] * T1 + w[2][1] * T2


@ti.func
def interpolate(first: ti.i32, fx: vec3, window: ti.template()):
    """Mean of the window's numbers at ``fx`` from its node ``first``, and a quarter of their slope along each axis.

    The compiler adds what is written, zeros too: no sum begins with one.
    """
    w = weights(fx)
    step = ti.static(layer(window))
    A0, L0, M0 = across_layer(first, w, window)
    A1, L1, M1 = across_layer(first + step, w, window)
    A2, L2, M2 = across_layer(first + 2 * step, w, window)
    a1, a2 = w[1][0] * A1, w[2][0] * A2
    B0 = a1 + a2
    A = w[0][0] * A0 + B0
    B1 = w[0][0] * L0 + w[1][0] * L1 + w[2][0] * L2
    B2 = w[0][0] * M0 + w[1][0] * M1 + w[2][0] * M2
    return A, B0 + a2 - fx[0] * A, B1 - fx[1] * A, B2 - fx[2] * A


@ti.func
def along_curved_line(first: ti.i32, w: ti.template(), window: ti.template()):
    """As ``along_line``, and the second difference."""
    u0, u1, u2 = node_of(window, first), node_of(window, first + 1), node_of(window, first + 2)
    v1, v2 = w[1][2] * u1, w[2][2] * u2
    slope = v1 + v2
    return w[0][2] * u0 + slope, slope + v2, u0 + u2 - (u1 + u1)


@ti.func
def across_curved_layer(first: ti.i32, w: ti.template(), window: ti.template()):
    """As ``across_layer``, and the mixed second moment and the second differences along the last two axes."""
    S0, T0, C0 = along_curved_line(first, w, window)
    S1, T1, C1 = along_curved_line(first + 8, w, window)
    S2, T2, C2 = along_curved_line(first + 16, w, window)
    s1, s2 = w[1][1] * S1, w[2][1] * S2
    t1, t2 = w[1][1] * T1, w[2][1] * T2
    B1, M12 = s1 + s2, t1 + t2
    A, B2 = w[0][1] * S0 + B1, w[0][1] * T0 + M12
    D2 = w[0][1] * C0 + w[1][1] * C1 + w[2][1] * C2
    return A, B1 + s2, B2, M12 + t2, S0 + S2 - (S1 + S1), D2


@ti.func
def interpolate_curved(first: ti.i32, fx: vec3, window: ti.template()):
    """As ``interpolate``, and second derivatives per cell²: a sixteenth of those along two axes (01, 02, 12), and
    those along one (0, 1, 2)."""
    w = weights(fx)
    step = ti.static(layer(window))
    A, B1, B2, M12, D1, D2 = across_curved_layer(first, w, window)
    D0 = A
    A *= w[0][0]
    B1 *= w[0][0]
    B2 *= w[0][0]
    M12 *= w[0][0]
    D1 *= w[0][0]
    D2 *= w[0][0]
    A1, L1, M1, N1, E1, F1 = across_curved_layer(first + step, w, window)
    D0 -= A1 + A1
    B0, M01, M02 = w[1][0] * A1, w[1][0] * L1, w[1][0] * M1
    A += B0
    B1 += M01
    B2 += M02
    M12 += w[1][0] * N1
    D1 += w[1][0] * E1
    D2 += w[1][0] * F1
    A2, L2, M2, N2, E2, F2 = across_curved_layer(first + 2 * step, w, window)
    D0 += A2
    a2, l2, m2 = w[2][0] * A2, w[2][0] * L2, w[2][0] * M2
    A += a2
    B1 += l2
    B2 += m2
    M12 += w[2][0] * N2
    D1 += w[2][0] * E2
    D2 += w[2][0] * F2
    B0 += a2 + a2
    M01 += l2 + l2
    M02 += m2 + m2
    C0 = B0 - fx[0] * A
    C1 = B1 - fx[1] * A
    C2 = B2 - fx[2] * A
    # Moments about the particle from those about the first node.
    E01 = M01 - fx[0] * B1 - fx[1] * C0
    E02 = M02 - fx[0] * B2 - fx[2] * C0
    E12 = M12 - fx[1] * B2 - fx[2] * C1
    return A, C0, C1, C2, E01, E02, E12, D0, D1, D2


@ti.func
def spread(first: ti.i32, fx: vec3, b4: vec4, c0: vec4, c1: vec4, c2: vec4, window: ti.template()):
    """Add b4 + i c0 + j c1 + m c2 to the window's node (i, j, m) from ``first``, times its weight at ``fx``."""
    w = weights(fx)
    left = vec4(0.0)
    b = b4
    for i in ti.static(range(3)):
        if ti.static(i > 0):
            b += c0
        bi, step, ci = w[i][0] * b, w[i][0] * c1, w[i][0] * c2
        for j in ti.static(range(3)):
            if ti.static(j > 0):
                bi += step
            bj, cj = w[j][1] * bi, w[j][1] * ci
            for m in ti.static(range(3)):
                if ti.static(m > 0):
                    bj += cj
                n = first + (i * ti.static(layer(window)) + j * 8 + m)
                if ti.static(is_whole(window)):
                    left = add_whole(window, n, left + w[m][2] * bj)
                else:
                    add_to(window, n, w[m][2] * bj)


@ti.func
def spread_curved(
    first: ti.i32,
    fx: vec3,
    b4: vec4,
    c0: vec4,
    c1: vec4,
    c2: vec4,
    e01: vec4,
    e02: vec4,
    e12: vec4,
    d0: vec4,
    d1: vec4,
    d2: vec4,
    window: ti.template(),
):
    """As ``spread``, with ij e01 + im e02 + jm e12 more, and along each axis a mode (1, -2, 1) d that carries neither
    momentum nor angular momentum."""
    w = weights(fx)
    # Where whole numbers are added, a node gets what rounding has left at the one before: the sum is the particle's.
    left = vec4(0.0)
    b, s1, s2, mode = b4, c1, c2, d0
    for i in ti.static(range(3)):
        if ti.static(i > 0):
            b += c0
            s1 += e01
            s2 += e02
            mode = d0
        if ti.static(i == 1):
            mode = -2.0 * d0
        bi, ci = w[i][0] * b + mode, w[i][0] * s2
        step, turn = w[i][0] * s1, w[i][0] * e12
        x1, x2 = w[i][0] * d1, w[i][0] * d2
        for j in ti.static(range(3)):
            if ti.static(j > 0):
                bi += step
                ci += turn
            bj, cj, dj = w[j][1] * bi, w[j][1] * ci, w[j][1] * x2
            if ti.static(j == 1):
                bj -= x1 + x1
            else:
                bj += x1
            n = first + (i * ti.static(layer(window)) + j * 8)
            near, far = bj + cj, bj + cj + cj
            q0, q1, q2 = w[0][2] * bj + dj, w[1][2] * near - (dj + dj), w[2][2] * far + dj
            if ti.static(is_whole(window)):
                left = add_whole(window, n, left + q0)
                left = add_whole(window, n + 1, left + q1)
                left = add_whole(window, n + 2, left + q2)
            else:
                add_to(window, n, q0)
                add_to(window, n + 1, q1)
                add_to(window, n + 2, q2)


@ti.func
def spread_kept(
    first: ti.i32,
    fx: vec3,
    mass: ti.f32,
    b4: vec4,
    c0: vec4,
    c1: vec4,
    c2: vec4,
    E01: vec4,
    E02: vec4,
    E12: vec4,
    D0: vec4,
    D1: vec4,
    D2: vec4,
    window: ti.template(),
):
    """As ``spread``, with what a particle of ``mass`` keeps of the second derivatives that ``interpolate_curved``
    gave."""
    # The last is 0, but the compiler shall do with it what it does with the others.
    keep = CURVED * vec4(mass, mass, mass, ti.min(mass, 0.0))
    e01 = 16.0 * keep * E01
    e02 = 16.0 * keep * E02
    e12 = 16.0 * keep * E12
    # i j e01 stands for (i - x) (j - y) e01, and so on.
    b4c = b4 + (fx[0] * fx[1]) * e01 + (fx[0] * fx[2]) * e02 + (fx[1] * fx[2]) * e12
    c0c = c0 - fx[1] * e01 - fx[2] * e02
    c1c = c1 - fx[0] * e01 - fx[2] * e12
    c2c = c2 - fx[0] * e02 - fx[1] * e12
    w3 = weights(fx)
    # Factor from a second derivative to the mode that is orthogonal to 1 and x under the weights.
    h = w3[0] * w3[1] * w3[2] / (w3[1] * w3[2] + 4.0 * w3[0] * w3[2] + w3[0] * w3[1])
    d0, d1, d2 = h[0] * keep * D0, h[1] * keep * D1, h[2] * keep * D2
    spread_curved(first, fx, b4c, c0c, c1c, c2c, e01, e02, e12, d0, d1, d2, window)


@ti.func
def largest_share(mass: ti.f32, v: vec3, Q: mat3, E01: vec4, E02: vec4, E12: vec4, D0: vec4, D1: vec4, D2: vec4):
    """Momentum (kg cells/s) that no node gets more of, on any axis, from a particle of ``mass`` with velocity ``v``
    that ``spread_kept`` spreads with the slopes ``Q`` (kg/s) of its momentum."""
    size = 0.0
    for r in ti.static(range(3)):
        # Nodes are within 1.5 cells on each axis; the last three modes have 1/8 at most, as h in ``spread_kept`` has.
        slopes = ti.abs(Q[r, 0]) + ti.abs(Q[r, 1]) + ti.abs(Q[r, 2])
        mixed = ti.abs(E01[r]) + ti.abs(E02[r]) + ti.abs(E12[r])
        along = ti.abs(D0[r]) + ti.abs(D1[r]) + ti.abs(D2[r])
        size = ti.max(size, mass * (ti.abs(v[r]) + 16.0 * 2.25 * mixed + 0.125 * along) + 1.5 * slopes)
    return LARGEST_WEIGHT * size
