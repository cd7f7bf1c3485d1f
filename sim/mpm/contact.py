# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Coulomb contact with the ground plane, resolved at the particles.

Zeroing the velocity of nodes below the plane stops a body up to a cell too early, because a particle feels nodes 1.5
cells away. Here the unknowns are one contact impulse m_p a_p per particle near the plane, spread to the nodes with the
particle's own weights (so momentum is exact), and the conditions hold at the particles, whose distance to the plane is
known far below a cell:

    phi_p = n . (x_p - x_0) - r_p            r_p: contact radius, the particle's distance to its body's surface
    a_n >= 0,   v_n + phi_p / dt >= 0,   one of the two an equality         (no attraction, no penetration)
    |a_t| <= mu a_n,   v_t = 0 inside the cone                              (Coulomb)

One projected Jacobi sweep a substep, started from the impulses of the last substep, which the particles have already
added to the grid. The sweep divides by the row sums of the contact matrix W M^-1 W^T (the share of contacting mass at
the particle), which makes it exact for even contact and stable for any, by Gershgorin's theorem.
"""

import taichi as ti

from .layout import (
    BLOCK_NODES,
    FIXED_ONE,
    SPREAD,
    WINDOW_NODES,
    Cells,
    Integers,
    Scalars,
    Vectors4,
    vec3,
    vec4,
)
from .transfer import load_window, weights

RECOVERY = 0.2
"""Share of a particle's depth that one substep may take back."""


@ti.func
def solve_contact(
    ground_blocks: ti.i32,
    dt: ti.f32,
    reach: ti.f32,
    recovery_speed: ti.f32,
    friction: ti.f32,
    normal: vec3,
    offset: ti.f32,
    ground_p: Integers,
    block_cells: Cells,
    starts: Integers,
    neighbours: Integers,
    x: Cells,
    constants: Vectors4,
    reaction: Vectors4,
    window: Vectors4,
    nodes: Vectors4,
    scattered: Vectors4,
):
    """One Jacobi sweep: update ``reaction`` (cells/s^2) and scatter the change of impulse and the contacting mass.

    reach: particles farther than this many cells from the plane cannot touch it in this substep.
    recovery_speed: fastest speed (cells/s) at which a sunk particle may be pushed out, so that nothing is launched.
    """
    for ss in range(ground_blocks * SPREAD):
        if ss % SPREAD == 0:
            s = ss // SPREAD
            k = ground_p[s]
            load_window(k, neighbours, window, nodes)
            for i in range(WINDOW_NODES):
                scattered[k * WINDOW_NODES + i] = vec4(0.0)
            level = normal.dot(ti.cast(block_cells[k] * 4 - 1, ti.f32)) - offset
            for p in range(starts[k], starts[k + 1]):
                gp = ti.cast(x[p], ti.f32) * (1.0 / FIXED_ONE)
                fixed = constants[p]
                phi = level + normal.dot(gp) - fixed[3]
                past = reaction[p]
                old = dt * vec3(past[0], past[1], past[2])
                if phi < reach or old.norm_sqr() > 0.0:
                    base = ti.cast(gp - 0.5, ti.i32)
                    fx = gp - ti.cast(base, ti.f32)
                    w = weights(fx)
                    first = k * WINDOW_NODES + base[0] * 64 + base[1] * 8 + base[2]
                    u = vec4(0.0)
                    for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
                        u += (w[i][0] * w[j][1] * w[m][2]) * window[first + (i * 64 + j * 8 + m)]
                    share = 1.0
                    if old.norm_sqr() > 0.0 and past[3] > 0.0:
                        share = ti.max(past[3], 0.02)
                    velocity = vec3(u[0], u[1], u[2])
                    v_n = velocity.dot(normal)
                    v_t = velocity - v_n * normal
                    wanted = -phi / dt
                    if phi < 0.0:
                        wanted = ti.min(RECOVERY * wanted, recovery_speed)
                    old_n = old.dot(normal)
                    new_n = ti.max(0.0, old_n + (wanted - v_n) / share)
                    new_t = old - old_n * normal - v_t / share
                    length = new_t.norm()
                    if length > friction * new_n:
                        new_t *= friction * new_n / length
                    new = new_n * normal + new_t
                    reaction[p] = vec4(new[0] / dt, new[1] / dt, new[2] / dt, past[3])
                    if new_n > 0.0 or old_n > 0.0:
                        change = fixed[0] * (new - old)
                        mass = ti.select(new_n > 0.0, fixed[0], 0.0)
                        q = vec4(change[0], change[1], change[2], mass)
                        for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
                            n = first + (i * 64 + j * 8 + m)
                            scattered[n] = scattered[n] + (w[i][0] * w[j][1] * w[m][2]) * q


@ti.func
def apply_contact(
    ground_grid_blocks: ti.i32,
    ground_g: Integers,
    neighbours: Integers,
    near_ground: Integers,
    scattered: Vectors4,
    nodes: Vectors4,
    masses: Scalars,
    sums: Vectors4,
):
    """Add the change of impulse to the nodes' velocity; leave the share of contacting mass in their fourth number."""
    for ss in range(ground_grid_blocks * SPREAD):
        if ss % SPREAD == 0:
            s = ss // SPREAD
            g = ground_g[s]
            for i in range(BLOCK_NODES):
                sums[s * BLOCK_NODES + i] = vec4(0.0)
            for d in range(27):
                k = neighbours[g * 27 + d]
                near = False
                if k >= 0:
                    near = near_ground[k] >= 0
                if near:
                    di, dj, dm = d // 9 - 1, d // 3 % 3 - 1, d % 3 - 1
                    il, ih = ti.select(di == 1, 3, 0), ti.select(di == -1, 3, 4)
                    jl, jh = ti.select(dj == 1, 3, 0), ti.select(dj == -1, 3, 4)
                    ml, mh = ti.select(dm == 1, 3, 0), ti.select(dm == -1, 3, 4)
                    shift = k * WINDOW_NODES + (1 - di * 4) * 64 + (1 - dj * 4) * 8 + (1 - dm * 4)
                    for i in range(il, ih):
                        for j in range(jl, jh):
                            for m in range(ml, mh):
                                n = s * BLOCK_NODES + i * 16 + j * 4 + m
                                sums[n] = sums[n] + scattered[i * 64 + j * 8 + m + shift]
            for i in range(BLOCK_NODES):
                n = g * BLOCK_NODES + i
                if masses[n] > 0.0:
                    q = sums[s * BLOCK_NODES + i] / masses[n]
                    u = nodes[n]
                    nodes[n] = vec4(u[0] + q[0], u[1] + q[1], u[2] + q[2], q[3])
