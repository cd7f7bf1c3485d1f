# SPDX-License-Identifier: MIT
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Broad phase: the blocks that can touch other bodies, the plane, rigid bodies or colliders, or that hold anchors,
before the next sort."""

import taichi as ti

from .collider_distance import body_distance
from .kernel_arrays import (
    BlockTable,
    GridBlocks,
    NearBlocks,
    OverlapBlocks,
    ParticleBlocks,
    RigidArrays,
    ShapeArrays,
    WorldArrays,
)
from .kernel_bundles import kernel
from .layout import (
    FIELD_INTEGERS,
    FIELDS,
    FIRST_FIELD,
    FIRST_RIGID_BODY,
    HAS_ANCHORS,
    HAS_PLANE,
    PLANE_NORMAL,
    PLANE_OFFSET,
    RIGID_BODIES,
    WORLD,
    WORLD_INTEGERS,
    WORLD_ROW,
    triple,
)
from .sorting import block_key, slot_of

HALF_SIDE = 3.0
"""Half the side in cells of the cube that a block's particles stay in before the next sort (window 0.5 to 6.5)."""

HALF_DIAGONAL = 5.2
"""Half that cube's diagonal."""

NEAR = 2.75
"""Cells around that cube in which an obstacle counts as near: drift of particles and bodies, a radius and a margin."""


@kernel
def list_near_blocks(
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    grid: GridBlocks,
    near: NearBlocks,
    bodies: RigidArrays,
    shapes: ShapeArrays,
) -> ti.types.vector(2, ti.i32):
    """List the particle blocks near the plane, a body or a collider, or with anchors, and the grid blocks around these.

    Returns the number of either.
    """
    found = ti.Vector([0, 0])
    ti.loop_config(serialize=True)
    for k in range(blocks.count):
        f = blocks.field[k]
        w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
        row = w * WORLD_ROW
        is_near = worlds.field_integers[f * FIELD_INTEGERS + HAS_ANCHORS] == 1
        centre = ti.cast(blocks.cells[k] * 4, ti.f32) + 2.5
        if worlds.numbers[row + HAS_PLANE] > 0.5:
            normal = triple(worlds.numbers, row + PLANE_NORMAL)
            half = HALF_SIDE * (ti.abs(normal[0]) + ti.abs(normal[1]) + ti.abs(normal[2]))
            is_near = is_near or normal.dot(centre) - worlds.numbers[row + PLANE_OFFSET] - half < NEAR
        first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
        for i in range(first, first + worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
            if not is_near:
                phi, _, _ = body_distance(i, centre, HALF_DIAGONAL + NEAR, bodies, shapes)
                is_near = phi < HALF_DIAGONAL + NEAR
        near.slot[k] = -1
        if is_near:
            near.slot[k] = found[0]
            near.particle_blocks[found[0]] = k
            found[0] += 1
    ti.loop_config(serialize=True)
    for g in range(grid.count):
        is_near = False
        for d in range(27):
            k = grid.neighbours[g * 27 + d]
            if k >= 0:
                is_near = is_near or near.slot[ti.max(k, 0)] >= 0
        if is_near:
            near.grid_blocks[found[1]] = g
            found[1] += 1
    return found


@kernel
def list_overlap_blocks(
    worlds: WorldArrays, blocks: ParticleBlocks, grid: GridBlocks, table: BlockTable, overlap: OverlapBlocks
) -> ti.types.vector(3, ti.i32):
    """List the grid blocks in places where several fields have one, and the particle blocks around these.

    table: of the grid blocks. Returns the numbers of ``overlap``'s grid blocks, leads and particle blocks.
    """
    for g in range(grid.count):
        f = grid.field[g]
        w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
        first = worlds.integers[w * WORLD_INTEGERS + FIRST_FIELD]
        count = worlds.integers[w * WORLD_INTEGERS + FIELDS]
        overlap.mate[g] = -1
        overlap.slot[g] = -1
        for other in range(first, first + count):
            if other != f and overlap.mate[g] < 0:
                slot = slot_of(block_key(other, grid.cells[g]), table)
                if slot >= 0:
                    if other > f:
                        overlap.mate[g] = slot
                    else:
                        # Not the first field here; -2 says so until the list below is made.
                        overlap.slot[g] = -2
    found = ti.Vector([0, 0, 0])
    ti.loop_config(serialize=True)
    for g in range(grid.count):
        if overlap.slot[g] == -2 or overlap.mate[g] >= 0:
            if overlap.slot[g] != -2:
                overlap.leads[found[1]] = g
                found[1] += 1
            overlap.slot[g] = found[0]
            overlap.grid_blocks[found[0]] = g
            found[0] += 1
    ti.loop_config(serialize=True)
    for k in range(blocks.count):
        overlap.chosen[k] = 0
        if found[0] > 0:
            for d in range(27):
                g = blocks.neighbours[k * 27 + d]
                if g >= 0 and overlap.chosen[k] == 0 and overlap.slot[ti.max(g, 0)] >= 0:
                    overlap.chosen[k] = 1
                    overlap.particle_blocks[found[2]] = k
                    found[2] += 1
    return found
