# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Crowding of fluids: what their particles fill against the volume that they have integrated.

The pressure of a fluid follows ln J, which is integrated at the particles. Between them the flow may converge unseen: a
few particles of a cell are too coarse a quadrature of its volume, and gravity gains energy by every motion that brings
them together (Baumgarten and Kamrin 2023 analyse these errors; Kugelstadt et al. 2019 hold the density of liquids
besides their divergence). So nodes compare both. With the mass m that a node has, the mass M of a full cell and the
share A of the node's surroundings that neither ground nor bodies fill,

    d = ln(m / M A) + mean ln J            0 where the particles fill what ln J says

and crowding pushes particles apart as the energy k K A d² / 2 of a node would (Monaghan 2005 has such forces between
the particles of SPH). It is no stress, because a stress acts only on what changes ln J. Particle p and node i exchange

    4 dt k K/rho0 m_p d_i w_ip (x_i - x_p)

along their line, so both momenta stay; what takes room at a node is pushed by k K d_i |grad A|, and pushes back.
Besides, ln J of the particles slowly gives way, in gaps as well. Where it is above 0, so that there is no pressure, it
follows the nodes at once: fluid that has flown apart and comes together meets no resistance before it is full again.
Its own integral, which forgets how far (``fluid.LOOSE``), would keep it apart for good. Where particles fill what ln J
says, all d are 0 and nothing changes. Nodes at a free surface are not full either; ``inside`` tells them from gaps by
the nodes around (as cells beside empty ones are the surface in FLIP, Zhu and Bridson 2005).
"""

import taichi as ti

from ..rigid.rigid_layout import DYNAMIC, KIND, KINDS, STATE, X
from .collider_distance import PUSH, body_distance, single3
from .fluid_room import FARTHEST, LEAST_FILL, NOTHING, PUSHED, is_beside_edge, share_beyond, slope_beyond
from .interpolation import weights
from .kernel_arrays import (
    CouplingArrays,
    FlowArrays,
    GridBlocks,
    NodeArrays,
    OverlapBlocks,
    RigidArrays,
    ShapeArrays,
    WorldArrays,
)
from .kernel_bundles import func
from .layout import (
    BLOCK_NODES,
    CONTROL_ROW,
    FIELD_INTEGERS,
    FIELD_ROW,
    FIRST_RIGID_BODY,
    FULL,
    FULL_MASS,
    HAS_PLANE,
    PHASE,
    PLANE_NORMAL,
    PLANE_OFFSET,
    RIGID_BODIES,
    SOUND_SPEED_SQUARED,
    SPREAD,
    STEP,
    WINDOW_NODES,
    WORLD,
    WORLD_INTEGERS,
    WORLD_ROW,
    Integers,
    Scalars,
    ivec3,
    triple,
    vec3,
    vec4,
)
from .sorting import node_beside
from .windows import add_to, grid_node, layer

STIFFNESS = 0.02
"""k: stiffness against crowding over the bulk modulus. In two dimensions a pond holds its volume from 0.02 on and is
unstable at 0.5; at 0.05 a column that breaks stays 15 % too high at the wall."""

RELAXED = 0.001
"""Share of the crowding that ln J takes up per substep, so that the pressure at rest is that of the fluid there. What
lags behind the motion feeds it: a share above the stiffness times what the transfers damp would keep a pond moving."""

LOOSE = 0.03
"""Crowding below 0 that pulls fully; from twice that on nothing pulls, so that splashes do not clump."""

FREE = 0.1
"""Share of the crowding that ln J of fluid without pressure takes up per substep. It has no force there, so this feeds
no motion."""

MOST = 1.0
"""Largest ln J that crowding gives."""

OUTER, INNER = 0.5, 0.75
"""A node belongs to the surface where one of the 26 around is less than OUTER times as full, and to the inside where
none is less than INNER times. At a plane surface 1.15 cells away these are 0.6 times as full, and the node lacks a
hundredth; disorder makes nodes differ by a twentieth to a tenth."""

BESIDE = 0.03
"""Largest crowding of a node beside edges of bodies, and beside bodies that deform. Surfaces count as faces, which at a
convex edge leaves as little as half of the room that there is: ln of that is some twenty times the crowding of a pond,
and lifted what floats."""

AT_FACE = 0.5
"""Largest crowding of a node beside the ground and plane faces, where the room is known exactly. With only BESIDE,
water that has sloshed stays packed on the floor: its lowest half cell is 1.6 times as dense as its ln J says."""

LEAST_SHARE = 0.0026
"""Share of a body at a node below which nothing pushes it there, as in ``deformable_contact``."""


@func
def inside(g: ti.i32, i: ti.i32, fill: ti.f32, grid: GridBlocks, flow: FlowArrays):
    """Share, 0 to 1, to which node ``i`` of grid block ``g`` lies inside of the fluid and not at its surface."""
    least = fill
    for d in range(27):
        block, n = node_beside(g, i, d, flow.around)
        other = ti.log(LEAST_FILL)
        if block >= 0:
            other = flow.fill[block * BLOCK_NODES + n]
        least = ti.min(least, other)
    return ti.min(ti.max((ti.exp(least - fill) - OUTER) / (INNER - OUTER), 0.0), 1.0)


@func
def find_crowding(
    meeting: ti.template(),
    worlds: WorldArrays,
    grid: GridBlocks,
    overlap: OverlapBlocks,
    nodes: NodeArrays,
    flow: FlowArrays,
    bodies: RigidArrays,
    shapes: ShapeArrays,
    coupling: CouplingArrays,
):
    """Crowding of all nodes of fluids, from ``measure_fill`` and mean ln J, and what it does to rigid bodies."""
    for gg in range(grid.count * SPREAD):
        if gg % SPREAD == 0:
            g = gg // SPREAD
            f = grid.field[g]
            w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
            full = worlds.field_numbers[f * FIELD_ROW + FULL_MASS]
            if worlds.control[w * CONTROL_ROW + PHASE] == FULL and full > 0.0:
                first = g * BLOCK_NODES
                shared = False
                if ti.static(meeting):
                    shared = overlap.slot[g] >= 0
                dt = ti.cast(worlds.control[w * CONTROL_ROW + STEP], ti.f32)
                modulus = full * worlds.field_numbers[f * FIELD_ROW + SOUND_SPEED_SQUARED]
                for i in range(BLOCK_NODES):
                    fill, room = flow.fill[first + i], flow.crowding[first + i]
                    crowding = NOTHING
                    if nodes.mass[first + i] > 0.0 and fill < NOTHING:
                        crowding = fill + flow.velocity[first + i][3]
                        if fill < 0.0:
                            crowding *= inside(g, i, fill, grid, flow)
                        if room < 1.0:
                            crowding = ti.min(ti.max(crowding, -2.0 * LOOSE), AT_FACE)
                            if crowding > BESIDE:
                                if shared or is_beside_edge(g, i, w, worlds, grid, flow, bodies, shapes, coupling):
                                    crowding = BESIDE
                            if shared:
                                crowding = felt(crowding)
                            strength = dt * STIFFNESS * modulus * felt(crowding) * room
                            push_apart(g, i, w, strength, worlds, grid, nodes, flow, bodies, shapes, coupling)
                    flow.crowding[first + i] = crowding


@ti.func
def felt(crowding: ti.f32):
    """Crowding as far as it pushes and pulls: gaps beyond ``LOOSE`` pull less, and from twice that on not at all."""
    return ti.max(crowding, ti.min(-(2.0 * LOOSE + crowding), 0.0))


@func
def push_apart(
    g: ti.i32,
    i: ti.i32,
    w: ti.i32,
    strength: ti.f32,
    worlds: WorldArrays,
    grid: GridBlocks,
    nodes: NodeArrays,
    flow: FlowArrays,
    bodies: RigidArrays,
    shapes: ShapeArrays,
    coupling: CouplingArrays,
):
    """Apply the crowding at node ``i`` of grid block ``g`` in a substep to ground and rigid bodies that take room
    there: the derivative of its energy by their place; and to the node, the opposite. strength: impulse (kg cells/s)
    on the cell² of a surface that leaves the room that there is."""
    n = g * BLOCK_NODES + i
    place = ti.cast(grid.cells[g] * 4 + ivec3(i // 16, i // 4 % 4, i % 4), ti.f32)
    change = vec3(0.0)
    plane = w * WORLD_ROW
    if worlds.numbers[plane + HAS_PLANE] > 0.5:
        normal = triple(worlds.numbers, plane + PLANE_NORMAL)
        distance = normal.dot(place) - worlds.numbers[plane + PLANE_OFFSET]
        change += (strength * slope_beyond(distance) / (1.0 - share_beyond(distance))) * normal
    first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
    for o in range(worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
        row = (g * coupling.most_bodies + o) * PUSH
        if flow.pushes[row + PUSHED] > 0.5:
            distance, normal, _ = body_distance(first + o, place, FARTHEST, bodies, shapes)
            if distance < FARTHEST:
                given = (strength * slope_beyond(distance) / (1.0 - share_beyond(distance))) * normal
                change += given
                if bodies.kinds[(first + o) * KINDS + KIND] == DYNAMIC:
                    turn = given.cross(place - single3(bodies.state, (first + o) * STATE + X))
                    for c in ti.static(range(3)):
                        flow.pushes[row + c] -= given[c]
                        flow.pushes[row + 3 + c] += turn[c]
    u = nodes.velocity[n]
    nodes.velocity[n] = u + vec4(change[0], change[1], change[2], 0.0) / nodes.mass[n]


@func
def add_pushes(worlds: WorldArrays, grid: GridBlocks, flow: FlowArrays, bodies: RigidArrays, coupling: CouplingArrays):
    """Add what crowding does to rigid bodies to ``bodies.impulses``, block after block."""
    ti.loop_config(serialize=True)
    for g in range(grid.count):
        f = grid.field[g]
        w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
        if worlds.field_numbers[f * FIELD_ROW + FULL_MASS] > 0.0 and worlds.control[w * CONTROL_ROW + PHASE] == FULL:
            first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
            for o in range(worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
                row = (g * coupling.most_bodies + o) * PUSH
                if flow.pushes[row + PUSHED] > 0.5:
                    for n in range(6):
                        bodies.impulses[6 * (first + o) + n] += flow.pushes[row + n]


@func
def push_fields(worlds: WorldArrays, grid: GridBlocks, overlap: OverlapBlocks, nodes: NodeArrays, flow: FlowArrays):
    """The same to bodies that deform: impulses on their nodes, along the gradient of their share."""
    for ss in range(overlap.lead_count * SPREAD):
        if ss % SPREAD == 0:
            lead = overlap.leads[ss // SPREAD]
            w = worlds.field_integers[grid.field[lead] * FIELD_INTEGERS + WORLD]
            if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                dt = ti.cast(worlds.control[w * CONTROL_ROW + STEP], ti.f32)
                a = lead
                while a >= 0:
                    row = grid.field[a] * FIELD_ROW
                    full = worlds.field_numbers[row + FULL_MASS]
                    strength = dt * STIFFNESS * full * worlds.field_numbers[row + SOUND_SPEED_SQUARED]
                    b = lead
                    while b >= 0:
                        if full > 0.0 and b != a:
                            for i in range(BLOCK_NODES):
                                crowding, n = flow.crowding[a * BLOCK_NODES + i], b * BLOCK_NODES + i
                                share = nodes.sums[overlap.slot[b] * BLOCK_NODES + i]
                                if crowding < NOTHING and nodes.mass[n] > 0.0 and share[3] > LEAST_SHARE:
                                    push = strength * crowding * vec4(share[0], share[1], share[2], 0.0)
                                    nodes.velocity[n] = nodes.velocity[n] + push / nodes.mass[n]
                                    m = a * BLOCK_NODES + i
                                    nodes.velocity[m] = nodes.velocity[m] - push / nodes.mass[m]
                        b = overlap.mate[b]
                    a = overlap.mate[a]


@ti.func
def load_crowding(
    lanes: ti.template(), lane: ti.i32, k: ti.i32, spot: ti.i32, neighbours: Integers, window: Scalars, nodes: Scalars
):
    """Copy the crowding of the nodes around particle block ``k`` to ``window`` from ``spot`` on, as ``fetch_window``
    does."""
    n = lane
    while n < WINDOW_NODES:
        window[spot + n] = nodes[grid_node(k, n, neighbours)]
        n += ti.static(lanes.threads)


@ti.func
def part_crowd(
    known: ti.i32,
    first: ti.i32,
    fx: vec3,
    strength: ti.f32,
    window: Scalars,
    scattered: ti.template(),
):
    """Mean crowding at ``fx`` from the window's node ``known``, and the impulse on the particle there; the nodes take
    the opposite, along the line to the particle, so both momenta stay. Nodes that are no measure count as the mean of
    the others. strength: impulse at a slope of 1 per cell."""
    w = weights(fx)
    total, part = 0.0, 0.0
    for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
        crowding = window[known + (i * 64 + j * 8 + m)]
        if crowding < NOTHING:
            weight = w[i][0] * w[j][1] * w[m][2]
            part += weight
            total += weight * crowding
    mean = total / ti.max(part, 0.1)
    given = vec3(0.0)
    for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
        crowding = window[known + (i * 64 + j * 8 + m)]
        if crowding >= NOTHING:
            crowding = mean
        push = (4.0 * strength * w[i][0] * w[j][1] * w[m][2] * felt(crowding)) * (vec3(i, j, m) - fx)
        given -= push
        n = first + (i * ti.static(layer(scattered)) + j * 8 + m)
        add_to(scattered, n, vec4(push[0], push[1], push[2], 0.0))
    return mean, given


@ti.func
def relaxed(memory: ti.f32, crowding: ti.f32):
    """ln J after a substep of a particle at which the mean crowding is ``crowding``."""
    now = memory - RELAXED * crowding
    if memory > 0.0:
        now = ti.min(ti.max(memory - FREE * crowding, 0.0), MOST)
    return now
