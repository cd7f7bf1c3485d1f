# SPDX-License-Identifier: MIT
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Which blocks can touch something before the next sort: blocks of other bodies, the plane, solids, anchors."""

import taichi as ti

from .layout import (
    FIELD_INTEGERS,
    FIELDS,
    FIRST_FIELD,
    FIRST_SOLID,
    HAS_ANCHORS,
    HAS_PLANE,
    PLANE_NORMAL,
    PLANE_OFFSET,
    SOLIDS,
    WORLD,
    WORLD_INTEGERS,
    WORLD_ROW,
    Cells,
    Doubles,
    Integers,
    Keys,
    Scalars,
    triple,
)
from .obstacles import solid_distance
from .sorting import block_key, slot_of

HALF_SIDE = 3.0
"""Half the side in cells of the cube that a block's particles stay in before the next sort (window 0.5 to 6.5)."""

HALF_DIAGONAL = 5.2
"""Half that cube's diagonal."""

NEAR = 2.75
"""Cells around that cube in which an obstacle counts as near: drift of particles and solids, a radius and some."""


@ti.kernel
def list_near_blocks(
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    p_cells: Cells,
    p_field: Integers,
    g_neighbours: Integers,
    field_integers: Integers,
    world_integers: Integers,
    worlds: Scalars,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    shape_numbers: Scalars,
    shape_dims: Integers,
    distances: Scalars,
    near: Integers,
    near_p: Integers,
    near_g: Integers,
) -> ti.types.vector(2, ti.i32):
    """List the particle blocks near the plane, a solid or with anchors, and the grid blocks around these.

    near: per particle block its slot in ``near_p`` or -1. Returns the number of either.
    """
    found = ti.Vector([0, 0])
    ti.loop_config(serialize=True)
    for k in range(p_blocks):
        f = p_field[k]
        w = field_integers[f * FIELD_INTEGERS + WORLD]
        row = w * WORLD_ROW
        is_near = field_integers[f * FIELD_INTEGERS + HAS_ANCHORS] == 1
        centre = ti.cast(p_cells[k] * 4, ti.f32) + 2.5
        if worlds[row + HAS_PLANE] > 0.5:
            normal = triple(worlds, row + PLANE_NORMAL)
            half = HALF_SIDE * (ti.abs(normal[0]) + ti.abs(normal[1]) + ti.abs(normal[2]))
            is_near = is_near or normal.dot(centre) - worlds[row + PLANE_OFFSET] - half < NEAR
        first = world_integers[w * WORLD_INTEGERS + FIRST_SOLID]
        for i in range(first, first + world_integers[w * WORLD_INTEGERS + SOLIDS]):
            if not is_near:
                phi, _, _ = solid_distance(
                    i,
                    centre,
                    HALF_DIAGONAL + NEAR,
                    solid_kinds,
                    solid_numbers,
                    solids,
                    shape_numbers,
                    shape_dims,
                    distances,
                )
                is_near = phi < HALF_DIAGONAL + NEAR
        near[k] = -1
        if is_near:
            near[k] = found[0]
            near_p[found[0]] = k
            found[0] += 1
    ti.loop_config(serialize=True)
    for g in range(g_blocks):
        is_near = False
        for d in range(27):
            k = g_neighbours[g * 27 + d]
            if k >= 0:
                is_near = is_near or near[ti.max(k, 0)] >= 0
        if is_near:
            near_g[found[1]] = g
            found[1] += 1
    return found


@ti.kernel
def list_meeting_blocks(
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    mask: ti.i32,
    g_cells: Cells,
    g_field: Integers,
    g_keys: Keys,
    g_slots: Integers,
    p_neighbours: Integers,
    field_integers: Integers,
    world_integers: Integers,
    mate: Integers,
    meet: Integers,
    meet_g: Integers,
    leads: Integers,
    meet_p: Integers,
    meets_p: Integers,
) -> ti.types.vector(3, ti.i32):
    """List the grid blocks in places where several fields have one, and the particle blocks around these.

    mate: the block of the next field in the same place, or -1; meet: slot of the block in ``meet_g`` or -1;
    leads: the blocks of the first field in each such place; meets_p: per particle block 1 where listed in ``meet_p``.
    Returns the numbers of blocks in ``meet_g``, ``leads`` and ``meet_p``.
    """
    for g in range(g_blocks):
        f = g_field[g]
        w = field_integers[f * FIELD_INTEGERS + WORLD]
        first = world_integers[w * WORLD_INTEGERS + FIRST_FIELD]
        count = world_integers[w * WORLD_INTEGERS + FIELDS]
        mate[g] = -1
        meet[g] = -1
        for other in range(first, first + count):
            if other != f and mate[g] < 0:
                slot = slot_of(block_key(other, g_cells[g]), mask, g_keys, g_slots)
                if slot >= 0:
                    if other > f:
                        mate[g] = slot
                    else:
                        # Not the first field here; -2 says so until the list below is made.
                        meet[g] = -2
    found = ti.Vector([0, 0, 0])
    ti.loop_config(serialize=True)
    for g in range(g_blocks):
        if meet[g] == -2 or mate[g] >= 0:
            if meet[g] != -2:
                leads[found[1]] = g
                found[1] += 1
            meet[g] = found[0]
            meet_g[found[0]] = g
            found[0] += 1
    ti.loop_config(serialize=True)
    for k in range(p_blocks):
        meets_p[k] = 0
        if found[0] > 0:
            for d in range(27):
                g = p_neighbours[k * 27 + d]
                if g >= 0 and meets_p[k] == 0 and meet[ti.max(g, 0)] >= 0:
                    meets_p[k] = 1
                    meet_p[found[2]] = k
                    found[2] += 1
    return found
