# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102, SIM109
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Contact between bodies that deform: each has its own nodes, and nodes in the same place exchange impulses.

Bardenhagen et al. 2001 stop two bodies where both have mass at a node, which keeps them up to two cells apart. Here a
node knows how far it lies outside each body, so they meet where their surfaces do (as Nairn et al. 2020 find the gap
by regression). The share f of a body's volume around a node, smoothed by the B-spline, tells the distance: at d outside
of a plane face, in cells,

    f(d) = (3/2 - d)^3 / 6   for 1/2 <= d <= 3/2,     1/2 - 3/4 d + d^3 / 3   for |d| <= 1/2,     f(-d) = 1 - f(d)

exactly, where the face lies across an axis of the grid, and nearly elsewhere, since the spline has the same variance in
all directions. With the normal n from the gradients of both shares, gap = d_a + d_b, and the impulses j, t at the node

    j >= 0,   v_n + gap / dt >= 0,   one of the two an equality;     |t| <= mu j (Coulomb)

or, for the share e of it (the pair's restitution), j from a spring on the overlap, as in ``contact``.
They are equal and opposite and act at one point: momentum and angular momentum are exact. Edges and corners fill
less of their surroundings than faces do and count as rounded, by about a third of a cell.
"""

import taichi as ti

from .contact import HOLD, SPRING, coulomb, parting_speed
from .layout import (
    BLOCK_NODES,
    CONTROL_ROW,
    FIELD_INTEGERS,
    FIELDS,
    FIRST_FIELD,
    FIRST_PAIR,
    FIXED_ONE,
    FULL,
    MODE,
    PHASE,
    RECOVERY_SPEED,
    RESTITUTION,
    SEPARATE,
    SLIDING,
    SLIP,
    SPREAD,
    STEP,
    STICKING,
    TOUCH_ROW,
    WINDOW_NODES,
    WORLD,
    WORLD_INTEGERS,
    WORLD_ROW,
    Cells,
    Doubles,
    Integers,
    Matrices,
    Scalars,
    Vectors4,
    vec3,
    vec4,
)
from .materials import FLUID, ROW, SAND, SNOW
from .transfer import sum_chosen_windows, weights

LEAST_SHARE = 0.0026
"""Share below which a body is too far off (1.25 cells) for the node to say anything about it."""


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
def scatter_shares(
    laws: ti.template(),
    blocks: ti.i32,
    meet_p: Integers,
    p_field: Integers,
    starts: Integers,
    field_integers: Integers,
    control: Doubles,
    x: Cells,
    F: Matrices,
    volumes: Scalars,
    material: Integers,
    table: Scalars,
    memory: Scalars,
    scattered: Vectors4,
):
    """Scatter the particles' present volumes (cells^3) and the gradient of their spread to the blocks' windows."""
    for ss in range(blocks * SPREAD):
        if ss % SPREAD == 0:
            k = meet_p[ss // SPREAD]
            w = field_integers[p_field[k] * FIELD_INTEGERS + WORLD]
            if control[w * CONTROL_ROW + PHASE] == FULL:
                for i in range(WINDOW_NODES):
                    scattered[k * WINDOW_NODES + i] = vec4(0.0)
                for p in range(starts[k], starts[k + 1]):
                    volume = volumes[p]
                    law = 0
                    if ti.static(laws & ((1 << FLUID) | (1 << SNOW) | (1 << SAND))):
                        law = ti.cast(table[material[p] * ROW], ti.i32)
                    if law != FLUID:
                        volume *= ti.max(F[p].determinant(), 0.0)
                    if ti.static(laws & ((1 << FLUID) | (1 << SNOW) | (1 << SAND))):
                        # What these laws remember is the ln of the volume that F does not tell.
                        if law == FLUID or law == SNOW or law == SAND:
                            volume *= ti.exp(memory[p])
                    gp = ti.cast(x[p], ti.f32) * (1.0 / FIXED_ONE)
                    base = ti.cast(gp - 0.5, ti.i32)
                    fx = gp - ti.cast(base, ti.f32)
                    w3 = weights(fx)
                    # Derivatives of the weights by the node's place.
                    s3 = [1.5 - fx, 2.0 * (fx - 1.0), 0.5 - fx]
                    first = k * WINDOW_NODES + base[0] * 64 + base[1] * 8 + base[2]
                    for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
                        n = first + (i * 64 + j * 8 + m)
                        scattered[n] = scattered[n] + volume * vec4(
                            s3[i][0] * w3[j][1] * w3[m][2],
                            w3[i][0] * s3[j][1] * w3[m][2],
                            w3[i][0] * w3[j][1] * s3[m][2],
                            w3[i][0] * w3[j][1] * w3[m][2],
                        )


@ti.func
def gather_shares(
    blocks: ti.i32,
    meet_g: Integers,
    g_field: Integers,
    g_neighbours: Integers,
    field_integers: Integers,
    control: Doubles,
    meets_p: Integers,
    scattered: Vectors4,
    sums: Vectors4,
):
    """Sum the windows: gradient (1/cell) and share of the field at each node of the meeting blocks, in ``sums``."""
    for ss in range(blocks * SPREAD):
        if ss % SPREAD == 0:
            s = ss // SPREAD
            g = meet_g[s]
            w = field_integers[g_field[g] * FIELD_INTEGERS + WORLD]
            if control[w * CONTROL_ROW + PHASE] == FULL:
                sum_chosen_windows(g, s, g_neighbours, meets_p, scattered, sums)


@ti.func
def separate(
    blocks: ti.i32,
    leads: Integers,
    mate: Integers,
    meet: Integers,
    g_field: Integers,
    field_integers: Integers,
    world_integers: Integers,
    worlds: Scalars,
    pairs: Scalars,
    control: Doubles,
    sums: Vectors4,
    masses: Scalars,
    nodes: Vectors4,
):
    """Impulses between every two fields at every node that both reach; ``nodes`` holds their velocities."""
    for ss in range(blocks * SPREAD):
        if ss % SPREAD == 0:
            lead = leads[ss // SPREAD]
            f = g_field[lead]
            w = field_integers[f * FIELD_INTEGERS + WORLD]
            c = w * CONTROL_ROW
            if control[c + PHASE] == FULL:
                dt = ti.cast(control[c + STEP], ti.f32)
                recovery = worlds[w * WORLD_ROW + RECOVERY_SPEED]
                first = world_integers[w * WORLD_INTEGERS + FIRST_FIELD]
                count = world_integers[w * WORLD_INTEGERS + FIELDS]
                a = lead
                while mate[a] >= 0:
                    b = mate[a]
                    while b >= 0:
                        pair = (
                            world_integers[w * WORLD_INTEGERS + FIRST_PAIR]
                            + (g_field[a] - first) * count
                            + (g_field[b] - first)
                        ) * TOUCH_ROW
                        for i in range(BLOCK_NODES):
                            na, nb = a * BLOCK_NODES + i, b * BLOCK_NODES + i
                            if masses[na] > 0.0 and masses[nb] > 0.0:
                                sa, sb = sums[meet[a] * BLOCK_NODES + i], sums[meet[b] * BLOCK_NODES + i]
                                exchange(na, nb, sa, sb, pair, dt, recovery, pairs, masses, nodes)
                        b = mate[b]
                    a = mate[a]


@ti.func
def exchange(
    na: ti.i32,
    nb: ti.i32,
    sa: vec4,
    sb: vec4,
    pair: ti.i32,
    dt: ti.f32,
    recovery: ti.f32,
    pairs: Scalars,
    masses: Scalars,
    nodes: Vectors4,
):
    """The impulse between node ``na`` of one field and node ``nb`` of another in the same place."""
    normal = vec3(sb[0] - sa[0], sb[1] - sa[1], sb[2] - sa[2])
    length = normal.norm()
    if sa[3] > LEAST_SHARE and sb[3] > LEAST_SHARE and length > 1e-6:
        normal /= length
        gap = distance_of_share(sa[3]) + distance_of_share(sb[3])
        ua, ub = nodes[na], nodes[nb]
        relative = vec3(ua[0] - ub[0], ua[1] - ub[1], ua[2] - ub[2])
        closing = relative.dot(normal)
        wanted = parting_speed(gap, dt, recovery)
        mode = ti.cast(pairs[pair + MODE], ti.i32)
        elastic = pairs[pair + RESTITUTION]
        push = (1.0 - elastic) * ti.max(0.0, closing + wanted) + elastic * (SPRING * ti.max(0.0, -gap) / dt)
        touching = push > 0.0
        if mode != SEPARATE and gap < HOLD:
            push = closing
            touching = True
        if touching:
            rub = relative - closing * normal
            if mode == SLIP:
                rub *= 0.0
            elif mode == SEPARATE:
                rub = coulomb(rub, push, pairs[pair + STICKING], pairs[pair + SLIDING])
            change = push * normal + rub
            ma, mb = masses[na], masses[nb]
            part = mb / (ma + mb)
            nodes[na] = vec4(ua[0] - part * change[0], ua[1] - part * change[1], ua[2] - part * change[2], ua[3])
            part = ma / (ma + mb)
            nodes[nb] = vec4(ub[0] + part * change[0], ub[1] + part * change[1], ub[2] + part * change[2], ub[3])
