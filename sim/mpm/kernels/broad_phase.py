# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
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
from .kernel_bundles import func, kernel
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
from .sorting import block_key, slot_beside, slot_of

HALF_SIDE = 3.0
"""Half the side in cells of the cube that a block's particles stay in before the next sort (window 0.5 to 6.5)."""

HALF_DIAGONAL = 5.2
"""Half that cube's diagonal."""

NEAR = 2.75
"""Cells around that cube in which an obstacle counts as near: drift of particles and bodies, a radius and a margin."""


@func
def is_block_near(k: ti.i32, worlds: WorldArrays, blocks: ParticleBlocks, bodies: RigidArrays, shapes: ShapeArrays):
    """Whether particle block ``k`` is near the plane, a body or a collider, or holds anchors."""
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
    return is_near


@func
def is_near_around(g: ti.i32, grid: GridBlocks, near: NearBlocks):
    """Whether a particle block around grid block ``g`` is listed in ``near``."""
    is_near = False
    for d in range(27):
        k = grid.neighbours[g * 27 + d]
        if k >= 0:
            is_near = is_near or near.slot[ti.max(k, 0)] >= 0
    return is_near


@kernel
def list_near_blocks_in_parallel(
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    grid: GridBlocks,
    near: NearBlocks,
    bodies: RigidArrays,
    shapes: ShapeArrays,
) -> ti.types.vector(2, ti.i32):
    """``list_near_blocks`` by all threads, in any order."""
    particle_count, grid_count = 0, 0
    for k in range(blocks.count):
        near.slot[k] = -1
        if is_block_near(k, worlds, blocks, bodies, shapes):
            slot = ti.atomic_add(particle_count, 1)
            near.slot[k] = slot
            near.particle_blocks[slot] = k
    for g in range(grid.count):
        if is_near_around(g, grid, near):
            near.grid_blocks[ti.atomic_add(grid_count, 1)] = g
    return ti.Vector([particle_count, grid_count])


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
        near.slot[k] = -1
        if is_block_near(k, worlds, blocks, bodies, shapes):
            near.slot[k] = found[0]
            near.particle_blocks[found[0]] = k
            found[0] += 1
    ti.loop_config(serialize=True)
    for g in range(grid.count):
        if is_near_around(g, grid, near):
            near.grid_blocks[found[1]] = g
            found[1] += 1
    return found


@func
def find_mates(worlds: WorldArrays, grid: GridBlocks, table: BlockTable, overlap: OverlapBlocks):
    """For each grid block the block of the next field in its place, and -2 in ``slot`` where it is not the first."""
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


@func
def overlaps_around(k: ti.i32, blocks: ParticleBlocks, overlap: OverlapBlocks):
    """Whether a grid block around particle block ``k`` is listed in ``overlap``."""
    found = False
    for d in range(27):
        g = blocks.neighbours[k * 27 + d]
        if g >= 0:
            found = found or overlap.slot[ti.max(g, 0)] >= 0
    return found


@kernel
def list_overlap_blocks_in_parallel(
    worlds: WorldArrays, blocks: ParticleBlocks, grid: GridBlocks, table: BlockTable, overlap: OverlapBlocks
) -> ti.types.vector(3, ti.i32):
    """``list_overlap_blocks`` by all threads, in any order."""
    find_mates(worlds, grid, table, overlap)
    grid_count, lead_count, particle_count = 0, 0, 0
    for g in range(grid.count):
        if overlap.slot[g] == -2 or overlap.mate[g] >= 0:
            if overlap.slot[g] != -2:
                overlap.leads[ti.atomic_add(lead_count, 1)] = g
            slot = ti.atomic_add(grid_count, 1)
            overlap.slot[g] = slot
            overlap.grid_blocks[slot] = g
    for k in range(blocks.count):
        overlap.chosen[k] = 0
        if overlaps_around(k, blocks, overlap):
            overlap.chosen[k] = 1
            overlap.particle_blocks[ti.atomic_add(particle_count, 1)] = k
    return ti.Vector([grid_count, lead_count, particle_count])


@kernel
def list_overlap_blocks(
    worlds: WorldArrays, blocks: ParticleBlocks, grid: GridBlocks, table: BlockTable, overlap: OverlapBlocks
) -> ti.types.vector(3, ti.i32):
    """List the grid blocks in places where several fields have one, and the particle blocks around these.

    table: of the grid blocks. Returns the numbers of ``overlap``'s grid blocks, leads and particle blocks.
    """
    find_mates(worlds, grid, table, overlap)
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
        if found[0] > 0 and overlaps_around(k, blocks, overlap):
            overlap.chosen[k] = 1
            overlap.particle_blocks[found[2]] = k
            found[2] += 1
    return found


@kernel
def link_overlap_blocks(grid: GridBlocks, table: BlockTable, overlap: OverlapBlocks):
    """Find the blocks of the same field around the listed grid blocks, and the first field in the place of each.

    table: of the grid blocks.
    """
    for s in range(overlap.grid_count):
        g = overlap.grid_blocks[s]
        for d in range(27):
            overlap.around[s * 27 + d] = slot_beside(grid.field[g], grid.cells[g], d, table)
    for n in range(overlap.lead_count):
        b = overlap.leads[n]
        while b >= 0:
            overlap.lead_fields[overlap.slot[b]] = grid.field[overlap.leads[n]]
            b = overlap.mate[b]
