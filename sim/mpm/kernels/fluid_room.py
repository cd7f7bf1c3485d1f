# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Room for fluids at nodes: the share of their surroundings that ground and bodies leave, and how full that is.

``crowding`` has the equations. A surface counts as a plane face, whose share of a node's surroundings, smoothed by the
B-spline, follows from its distance; at the edges of bodies, where that is wrong, ``is_beside_edge`` says so.
"""

import taichi as ti

from .body_faces import left_by_others
from .collider_distance import PUSH, body_distance
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
    FAR,
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
    SPREAD,
    WORLD,
    WORLD_INTEGERS,
    WORLD_ROW,
    ivec3,
    triple,
    vec3,
)

LEAST_FILL = 1e-3
"""Least share of a node that counts as full."""

LEAST_ROOM = 0.05
"""Share of a node's surroundings below which it is no measure: so little mass is there that its share is chance."""

NOTHING = 1e3
"""Crowding of nodes that are no measure."""

BENT = 0.03
"""Cells by which a surface recedes ASIDE cells along its tangents, where it is no face any more: its room is then off
by a twentieth."""

ASIDE = 0.7
"""Cells; four places so far around a node have the spread of the B-spline."""

PUSHED = 6
"""Place in a row of ``FlowArrays.pushes`` that says whether the body takes room in the block."""

FARTHEST = 1.5
"""Cells from a surface within which it takes room from a node."""

HALF_DIAGONAL = 2.6
"""Cells from the middle of a block's nodes to its farthest one."""


@ti.func
def share_beyond(d: ti.f32):
    """Share of a node's surroundings, smoothed by the B-spline, behind a plane face ``d`` cells away; d < 0 inside."""
    a = ti.abs(d)
    share = 0.0
    if a <= 0.5:
        share = 0.5 - 0.75 * a + a * a * a / 3.0
    elif a < FARTHEST:
        share = (FARTHEST - a) ** 3 / 6.0
    return ti.select(d >= 0.0, share, 1.0 - share)


@ti.func
def slope_beyond(d: ti.f32):
    """Rate at which ``share_beyond`` falls with the distance, 1/cell, 0 or more."""
    a = ti.abs(d)
    slope = 0.0
    if a <= 0.5:
        slope = 0.75 - a * a
    elif a < FARTHEST:
        slope = 0.5 * (FARTHEST - a) ** 2
    return slope


@func
def leave_room(worlds: WorldArrays, grid: GridBlocks, overlap: OverlapBlocks, nodes: NodeArrays, flow: FlowArrays):
    """Room at nodes where bodies that deform meet, to ``flow.crowding``: what the other bodies' shares leave."""
    for ss in range(overlap.lead_count * SPREAD):
        if ss % SPREAD == 0:
            lead = overlap.leads[ss // SPREAD]
            w = worlds.field_integers[grid.field[lead] * FIELD_INTEGERS + WORLD]
            if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                a = lead
                while a >= 0:
                    for i in range(BLOCK_NODES):
                        room = left_by_others(1.0, a, lead, i, overlap, nodes)
                        flow.crowding[a * BLOCK_NODES + i] = ti.max(room, 0.0)
                    a = overlap.mate[a]


@func
def measure_fill(
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
    """Room at all nodes of fluids, to ``flow.crowding``, and ln of the part of it that is full, to ``flow.fill``.
    meeting: whether ``leave_room`` was called."""
    for gg in range(grid.count * SPREAD):
        if gg % SPREAD == 0:
            g = gg // SPREAD
            f = grid.field[g]
            w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
            full = worlds.field_numbers[f * FIELD_ROW + FULL_MASS]
            if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                for o in range(coupling.most_bodies):
                    flow.pushes[(g * coupling.most_bodies + o) * PUSH + PUSHED] = 0.0
                if full > 0.0:
                    first = g * BLOCK_NODES
                    shared = False
                    if ti.static(meeting):
                        shared = overlap.slot[g] >= 0
                    if not shared:
                        for i in range(BLOCK_NODES):
                            flow.crowding[first + i] = 1.0
                    take_room(g, w, worlds, grid, nodes, flow, bodies, shapes, coupling)
                    for i in range(BLOCK_NODES):
                        fill, room = NOTHING, flow.crowding[first + i]
                        if room > LEAST_ROOM:
                            fill = ti.log(ti.max(nodes.mass[first + i] / (full * room), LEAST_FILL))
                        flow.fill[first + i] = fill


@func
def take_room(
    g: ti.i32,
    w: ti.i32,
    worlds: WorldArrays,
    grid: GridBlocks,
    nodes: NodeArrays,
    flow: FlowArrays,
    bodies: RigidArrays,
    shapes: ShapeArrays,
    coupling: CouplingArrays,
):
    """Multiply the room at the nodes of grid block ``g`` by what ground, rigid bodies and colliders each leave."""
    corner = ti.cast(grid.cells[g] * 4, ti.f32)
    plane = w * WORLD_ROW
    if worlds.numbers[plane + HAS_PLANE] > 0.5:
        normal = triple(worlds.numbers, plane + PLANE_NORMAL)
        level = normal.dot(corner) - worlds.numbers[plane + PLANE_OFFSET]
        if level + 1.5 * normal.sum() < HALF_DIAGONAL + FARTHEST:
            for i in range(BLOCK_NODES):
                at = ti.cast(ivec3(i // 16, i // 4 % 4, i % 4), ti.f32)
                flow.crowding[g * BLOCK_NODES + i] *= 1.0 - share_beyond(level + normal.dot(at))
    first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
    for o in range(worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
        middle, _, _ = body_distance(first + o, corner + vec3(1.5), HALF_DIAGONAL + FARTHEST, bodies, shapes)
        if middle < HALF_DIAGONAL + FARTHEST:
            row = (g * coupling.most_bodies + o) * PUSH
            for n in range(PUSHED):
                flow.pushes[row + n] = 0.0
            flow.pushes[row + PUSHED] = 1.0
            for i in range(BLOCK_NODES):
                n = g * BLOCK_NODES + i
                at = ti.cast(ivec3(i // 16, i // 4 % 4, i % 4), ti.f32)
                distance, _, _ = body_distance(first + o, corner + at, FARTHEST, bodies, shapes)
                flow.crowding[n] *= 1.0 - share_beyond(distance)


@func
def is_beside_edge(
    g: ti.i32,
    i: ti.i32,
    w: ti.i32,
    worlds: WorldArrays,
    grid: GridBlocks,
    flow: FlowArrays,
    bodies: RigidArrays,
    shapes: ShapeArrays,
    coupling: CouplingArrays,
):
    """Whether the surface of a rigid body or collider beside node ``i`` of grid block ``g`` bends away, and nothing
    else begins there, as at an edge."""
    place = ti.cast(grid.cells[g] * 4 + ivec3(i // 16, i // 4 % 4, i % 4), ti.f32)
    first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
    bent = False
    for o in range(worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
        if not bent and flow.pushes[(g * coupling.most_bodies + o) * PUSH + PUSHED] > 0.5:
            distance, normal, _ = body_distance(first + o, place, FARTHEST, bodies, shapes)
            if distance < FARTHEST:
                across = vec3(0.0, normal[2], -normal[1])
                if ti.abs(normal[0]) > 0.7:
                    across = vec3(-normal[2], 0.0, normal[0])
                across = across.normalized()
                along = normal.cross(across)
                for n in range(4):
                    tangent = ti.select(n < 2, across, along) * ti.select(n % 2 == 0, ASIDE, -ASIDE)
                    beside = nearest_surface(place + tangent, w, worlds, bodies, shapes)
                    bent = bent or beside > distance + BENT
    return bent


@func
def nearest_surface(place: vec3, w: ti.i32, worlds: WorldArrays, bodies: RigidArrays, shapes: ShapeArrays):
    """Distance (cells) of ``place`` from the ground, or the nearest rigid body or collider of world ``w``."""
    nearest = FAR
    plane = w * WORLD_ROW
    if worlds.numbers[plane + HAS_PLANE] > 0.5:
        nearest = triple(worlds.numbers, plane + PLANE_NORMAL).dot(place) - worlds.numbers[plane + PLANE_OFFSET]
    first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
    for o in range(worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
        distance, _, _ = body_distance(first + o, place, 2.0 * FARTHEST, bodies, shapes)
        nearest = ti.min(nearest, distance)
    return nearest
