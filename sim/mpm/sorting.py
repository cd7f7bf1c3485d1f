# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Grouping the particles in blocks: which block each is in, the lists of blocks, their neighbours, the permutation.

``table_p`` and ``table_g`` map a block of the domain to its slot in the list of particle blocks and of grid blocks
(blocks that particles can reach), -1 for none. They are the only arrays of the domain's size: one integer for 64 cells.
"""

import taichi as ti

from .layout import (
    FIXED_BITS,
    FIXED_LOW,
    FIXED_ONE,
    Cells,
    Integers,
    Matrices,
    Vectors3,
    Vectors4,
    ivec3,
    vec3,
)


@ti.func
def block_index(b: ivec3, across: ti.i32) -> ti.i32:
    """Index of block ``b`` in the tables of a domain of ``across`` blocks a side."""
    return (b[0] * across + b[1]) * across + b[2]


@ti.func
def neighbour_offset(d: ti.i32):
    """Offset of neighbour ``d`` of 27, each component -1, 0 or 1."""
    return ivec3(d // 9 - 1, d // 3 % 3 - 1, d % 3 - 1)


@ti.kernel
def rebase(blocks: ti.i32, across: ti.i32, block_cells: Cells, starts: Integers, x: Cells, keys: Integers):
    """Find each particle's new block and express its position in that block's window. Exact: integers are shifted."""
    for k in range(blocks):
        old = block_cells[k]
        for p in range(starts[k], starts[k + 1]):
            xi = x[p]
            new = ivec3(0)
            for c in ti.static(range(3)):
                base = old[c] * 4 - 1 + ((xi[c] - FIXED_LOW) >> FIXED_BITS)
                new[c] = ti.min(ti.max(base >> 2, 1), across - 2)
            x[p] = xi + (old - new) * (4 * FIXED_ONE)
            keys[p] = block_index(new, across)


@ti.kernel
def forget_blocks(
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    across: ti.i32,
    p_cells: Cells,
    g_cells: Cells,
    table_p: Integers,
    table_g: Integers,
):
    """Empty the tables where the old lists had filled them."""
    for k in range(p_blocks):
        table_p[block_index(p_cells[k], across)] = -1
    for k in range(g_blocks):
        table_g[block_index(g_cells[k], across)] = -1


@ti.kernel
def list_particle_blocks(
    count: ti.i32, across: ti.i32, capacity: ti.i32, keys: Integers, table_p: Integers, p_cells: Cells, starts: Integers
) -> ti.i32:
    """List the occupied blocks in the order of the particles and count their particles into ``starts[k + 1]``.

    Returns the number of blocks; lists none past ``capacity``. Serial, hence the same on every run.
    """
    found = 0
    ti.loop_config(serialize=True)
    for p in range(count):
        key = keys[p]
        slot = table_p[key]
        if slot < 0:
            slot = found
            found += 1
            table_p[key] = slot
            if slot < capacity:
                p_cells[slot] = ivec3(key // (across * across), key // across % across, key % across)
                starts[slot + 1] = 0
        if slot < capacity:
            starts[slot + 1] += 1
    return found


@ti.kernel
def list_grid_blocks(
    p_blocks: ti.i32,
    across: ti.i32,
    capacity: ti.i32,
    p_cells: Cells,
    table_g: Integers,
    g_cells: Cells,
    starts: Integers,
    cursors: Integers,
) -> ti.i32:
    """List the blocks around the particle blocks; turn the counts in ``starts`` into offsets. Returns their number."""
    found = 0
    starts[0] = 0
    ti.loop_config(serialize=True)
    for k in range(p_blocks):
        cursors[k] = starts[k]
        starts[k + 1] += starts[k]
        for d in range(27):
            b = p_cells[k] + neighbour_offset(d)
            key = block_index(b, across)
            if table_g[key] < 0:
                if found < capacity:
                    table_g[key] = found
                    g_cells[found] = b
                found += 1
    return found


@ti.kernel
def link_blocks(
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    across: ti.i32,
    p_cells: Cells,
    g_cells: Cells,
    table_p: Integers,
    table_g: Integers,
    p_neighbours: Integers,
    g_neighbours: Integers,
):
    """Neighbour lists: 27 grid blocks around each particle block, 27 particle blocks around each grid block."""
    for k in range(p_blocks):
        for d in range(27):
            p_neighbours[k * 27 + d] = table_g[block_index(p_cells[k] + neighbour_offset(d), across)]
    for g in range(g_blocks):
        for d in range(27):
            b = g_cells[g] + neighbour_offset(d)
            slot = -1
            if b.min() >= 0 and b.max() < across:
                slot = table_p[block_index(b, across)]
            g_neighbours[g * 27 + d] = slot


@ti.kernel
def list_ground_blocks(
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    normal: vec3,
    offset: ti.f32,
    reach: ti.f32,
    p_cells: Cells,
    g_neighbours: Integers,
    near_ground: Integers,
    ground_p: Integers,
    ground_g: Integers,
) -> ti.types.vector(2, ti.i32):
    """List the blocks whose particles can come within ``reach`` cells of the plane before the next sort.

    near_ground: per particle block its slot in ``ground_p`` or -1; ground_g: the grid blocks around these.
    Returns the number of either.
    """
    found = ti.Vector([0, 0])
    ti.loop_config(serialize=True)
    for k in range(p_blocks):
        centre = ti.cast(p_cells[k] * 4, ti.f32) + 2.5
        half = 3.0 * (ti.abs(normal[0]) + ti.abs(normal[1]) + ti.abs(normal[2]))
        near_ground[k] = -1
        if normal.dot(centre) - offset - half < reach:
            near_ground[k] = found[0]
            ground_p[found[0]] = k
            found[0] += 1
    ti.loop_config(serialize=True)
    for g in range(g_blocks):
        near = 0
        for d in range(27):
            k = g_neighbours[g * 27 + d]
            if k >= 0 and near_ground[ti.max(k, 0)] >= 0:
                near = 1
        if near == 1:
            ground_g[found[1]] = g
            found[1] += 1
    return found


@ti.kernel
def place(count: ti.i32, keys: Integers, table_p: Integers, cursors: Integers, targets: Integers):
    """New index of every particle; particles of a block keep their order. Serial, hence the same on every run."""
    ti.loop_config(serialize=True)
    for p in range(count):
        slot = table_p[keys[p]]
        targets[p] = cursors[slot]
        cursors[slot] += 1


@ti.kernel
def permute(
    count: ti.i32,
    targets: Integers,
    x: Cells,
    v: Vectors3,
    C: Matrices,
    F: Matrices,
    constants: Vectors4,
    reaction: Vectors4,
    ids: Integers,
    x_new: Cells,
    v_new: Vectors3,
    C_new: Matrices,
    F_new: Matrices,
    constants_new: Vectors4,
    reaction_new: Vectors4,
    ids_new: Integers,
):
    """Move every particle's data to its new index."""
    for p in range(count):
        t = targets[p]
        x_new[t] = x[p]
        v_new[t] = v[p]
        C_new[t] = C[p]
        F_new[t] = F[p]
        constants_new[t] = constants[p]
        reaction_new[t] = reaction[p]
        ids_new[t] = ids[p]
