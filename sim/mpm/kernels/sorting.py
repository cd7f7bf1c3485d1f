# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Sorting of particles into blocks: block of each particle, lists of blocks, their neighbours, the permutation.

A block's key packs its field and its three coordinates in 64 bits. Two hash tables map keys to slots in the list of
particle blocks and of grid blocks (blocks that particles can reach), so time and memory follow the occupied blocks and
a body may go anywhere. On the CPU everything that decides an order is serial, hence deterministic; ``parallel_sorting``
makes the same lists with all threads of a graphics card.
"""

import taichi as ti

from .kernel_arrays import BlockTable, GridBlocks, ParticleBlocks, ParticleState, WorldArrays
from .kernel_bundles import func, kernel
from .layout import (
    CONTROL_ROW,
    FARTHEST_BLOCK,
    FIELD_INTEGERS,
    FIXED_BITS,
    FIXED_LOW,
    FIXED_ONE,
    STATUS,
    WANTS_SORT,
    WORLD,
    Cells,
    Integers,
    Keys,
    Matrices,
    Scalars,
    Vectors3,
    Vectors4,
    ivec3,
)

BIAS = 1 << 15
"""Added to block coordinates to make them positive in a key."""


@ti.func
def block_key(field: ti.i32, b: ivec3):
    """Key of block ``b`` of ``field``."""
    key = ti.cast(field, ti.i64)
    for n in ti.static(range(3)):
        key = (key << 16) | ti.cast(b[n] + BIAS, ti.i64)
    return key


@ti.func
def key_field(key: ti.i64):
    """Field of a key."""
    return ti.cast(key >> 48, ti.i32)


@ti.func
def key_block(key: ti.i64):
    """Block coordinates of a key."""
    return ivec3(
        ti.cast((key >> 32) & 0xFFFF, ti.i32) - BIAS,
        ti.cast((key >> 16) & 0xFFFF, ti.i32) - BIAS,
        ti.cast(key & 0xFFFF, ti.i32) - BIAS,
    )


@func
def home(key: ti.i64, table: BlockTable):
    """Index at which the search for ``key`` begins."""
    b = key_block(key)
    h = (b[0] * 73856093) ^ (b[1] * 19349663) ^ (b[2] * 83492791) ^ (key_field(key) * 25165843)
    return (h ^ (h >> 15)) & table.mask


@func
def place_in_table(key: ti.i64, table: BlockTable):
    """Index of ``key`` in the table, or of the free entry where it would go (linear probing)."""
    h = home(key, table)
    while table.keys[h] != key and table.keys[h] != -1:
        h = (h + 1) & table.mask
    return h


@func
def slot_of(key: ti.i64, table: BlockTable):
    """Slot of the block ``key``, -1 where there is none."""
    h = place_in_table(key, table)
    slot = -1
    if table.keys[h] == key:
        slot = table.slots[h]
    return slot


@ti.func
def neighbour_offset(d: ti.i32):
    """Offset of neighbour ``d`` of 27, each component -1, 0 or 1."""
    return ivec3(d // 9 - 1, d // 3 % 3 - 1, d % 3 - 1)


@func
def slot_beside(field: ti.i32, cell: ivec3, d: ti.i32, table: BlockTable):
    """Slot of the block of ``field`` that is neighbour ``d`` of 27 of the one at ``cell``, -1 where there is none."""
    return slot_of(block_key(field, cell + neighbour_offset(d)), table)


@ti.func
def node_beside(g: ti.i32, i: ti.i32, d: ti.i32, around: Integers):
    """Neighbour ``d`` of 27 of node ``i`` of a block: the block that it lies in, and its number there.

    around: 27 blocks around each block, -1 where there is none; g: which block is looked from.
    """
    node = ivec3(i // 16, i // 4 % 4, i % 4) + neighbour_offset(d)
    side = (node + 4) // 4
    block = around[g * 27 + side[0] * 9 + side[1] * 3 + side[2]]
    return block, (node[0] & 3) * 16 + (node[1] & 3) * 4 + (node[2] & 3)


@func
def rebase_particle(p: ti.i32, k: ti.i32, moves: ti.i32, x: Cells, keys: Keys, blocks: ParticleBlocks):
    """Find the new block of particle ``p`` of block ``k`` and express its position in that block's window; where it
    does not move, ``keys`` gets the block that it has."""
    old = blocks.cells[k]
    new = old
    if moves:
        xi = x[p]
        for c in ti.static(range(3)):
            base = old[c] * 4 - 1 + ((xi[c] - FIXED_LOW) >> FIXED_BITS)
            new[c] = ti.min(ti.max(base >> 2, -FARTHEST_BLOCK), FARTHEST_BLOCK)
        x[p] = xi + (old - new) * (4 * FIXED_ONE)
    keys[p] = block_key(blocks.field[k], new)


@func
def wants_sort(k: ti.i32, worlds: WorldArrays, blocks: ParticleBlocks):
    """Whether the world of particle block ``k`` waits for a sort."""
    w = worlds.field_integers[blocks.field[k] * FIELD_INTEGERS + WORLD]
    return worlds.control[w * CONTROL_ROW + STATUS] == WANTS_SORT


@kernel
def rebase(x: Cells, keys: Keys, worlds: WorldArrays, blocks: ParticleBlocks):
    """Find each particle's new block and express its position in that block's window. Exact: integers are shifted.

    Particles of worlds that want no sort stay in their blocks: moving them would change the order of sums.
    """
    for k in range(blocks.count):
        moves = wants_sort(k, worlds, blocks)
        for p in range(blocks.starts[k], blocks.starts[k + 1]):
            rebase_particle(p, k, moves, x, keys, blocks)


@kernel
def list_particle_blocks(
    count: ti.i32, capacity: ti.i32, keys: Keys, table: BlockTable, blocks: ParticleBlocks
) -> ti.i32:
    """List the occupied blocks in the order of the particles and count their particles into ``starts[k + 1]``.

    Returns the number of blocks; past ``capacity`` only that it is larger. The table must be empty.
    """
    found = 0
    past = ti.cast(-1, ti.i64)
    slot = -1
    ti.loop_config(serialize=True)
    for p in range(count):
        key = keys[p]
        if key != past and found <= capacity:
            past = key
            h = place_in_table(key, table)
            if table.keys[h] == key:
                slot = table.slots[h]
            else:
                slot = found
                found += 1
                if slot < capacity:
                    table.keys[h] = key
                    table.slots[h] = slot
                    blocks.cells[slot] = key_block(key)
                    blocks.field[slot] = key_field(key)
                    blocks.starts[slot + 1] = 0
        if slot < capacity:
            blocks.starts[slot + 1] += 1
    return found


@kernel
def list_grid_blocks(
    field_count: ti.i32,
    capacity: ti.i32,
    cursors: Integers,
    table: BlockTable,
    blocks: ParticleBlocks,
    grid: GridBlocks,
) -> ti.i32:
    """List the blocks around the particle blocks, those of a field one after the other from ``grid.starts`` on.

    Also turns the counts in ``blocks.starts`` into offsets. Returns the number of blocks; past ``capacity`` only that
    it is larger. The table must be empty.
    """
    found = 0
    blocks.starts[0] = 0
    ti.loop_config(serialize=True)
    for f in range(field_count + 1):
        grid.starts[f] = 0
    ti.loop_config(serialize=True)
    for k in range(blocks.count):
        cursors[k] = blocks.starts[k]
        blocks.starts[k + 1] += blocks.starts[k]
        for d in range(27):
            b = blocks.cells[k] + neighbour_offset(d)
            key = block_key(blocks.field[k], b)
            if found <= capacity:
                h = place_in_table(key, table)
                if table.keys[h] != key:
                    if found < capacity:
                        table.keys[h] = key
                        table.slots[h] = found
                        grid.cells[found] = b
                        grid.field[found] = blocks.field[k]
                        grid.starts[blocks.field[k] + 1] += 1
                    found += 1
    ti.loop_config(serialize=True)
    for f in range(field_count):
        grid.starts[f + 1] += grid.starts[f]
    return found


@kernel
def link_blocks(blocks: ParticleBlocks, grid: GridBlocks, p_table: BlockTable, g_table: BlockTable):
    """Neighbour lists: 27 grid blocks around each particle block, 27 particle blocks around each grid block."""
    for t in range(blocks.count * 27):
        k = t // 27
        blocks.neighbours[t] = slot_beside(blocks.field[k], blocks.cells[k], t % 27, g_table)
    for t in range(grid.count * 27):
        g = t // 27
        grid.neighbours[t] = slot_beside(grid.field[g], grid.cells[g], t % 27, p_table)


@kernel
def link_grid_blocks(grid: GridBlocks, table: BlockTable, around: Integers):
    """The 27 grid blocks around each grid block, for fluids."""
    for t in range(grid.count * 27):
        g = t // 27
        around[t] = slot_beside(grid.field[g], grid.cells[g], t % 27, table)


@kernel
def place(count: ti.i32, keys: Keys, cursors: Integers, targets: Integers, table: BlockTable):
    """New index of every particle; particles of a block keep their order."""
    past = ti.cast(-1, ti.i64)
    slot = 0
    ti.loop_config(serialize=True)
    for p in range(count):
        if keys[p] != past:
            past = keys[p]
            slot = slot_of(past, table)
        targets[p] = cursors[slot]
        cursors[slot] += 1


@kernel
def permute(count: ti.i32, targets: Integers, old: ParticleState, new: ParticleState):
    """Move every particle's data to its new index."""
    for p in range(count):
        t = targets[p]
        for n in ti.static(range(len(old))):
            new[n][t] = old[n][p]


@kernel
def set_moduli(
    count: ti.i32,
    first: ti.i32,
    end: ti.i32,
    shear: ti.f32,
    bulk: ti.f32,
    shares: Scalars,
    ids: Integers,
    constants: Vectors4,
):
    """Set 2 mu V0 and lambda V0 of the particles numbered ``first`` to ``end`` - 1 to their shares, V0 and a factor, of
    ``shear`` and ``bulk``; those whose share is below 0 keep theirs."""
    for p in range(count):
        if first <= ids[p] < end:
            share = shares[ids[p] - first]
            if share >= 0.0:
                constants[p][1] = share * shear
                constants[p][2] = share * bulk


@kernel
def permute_numbers(count: ti.i32, targets: Integers, old: Scalars, new: Scalars):
    """Move one number a particle to its new index."""
    for p in range(count):
        new[targets[p]] = old[p]


@kernel
def permute_held_vectors(count: ti.i32, targets: Integers, held: Vectors4, spare: Vectors4):
    """Move one vector a particle to its new index within ``held``, by way of ``spare``."""
    for p in range(count):
        spare[targets[p]] = held[p]
    for p in range(count):
        held[p] = spare[p]


@kernel
def permute_held_numbers(count: ti.i32, targets: Integers, held: Scalars, spare: Vectors4):
    """Move one number a particle to its new index within ``held``, by way of ``spare``."""
    for p in range(count):
        spare[targets[p]][0] = held[p]
    for p in range(count):
        held[p] = spare[p][0]


@kernel
def permute_held_integers(count: ti.i32, targets: Integers, held: Integers, spare: Vectors4):
    """Move one whole number a particle to its new index within ``held``, by way of ``spare``."""
    for p in range(count):
        spare[targets[p]][0] = ti.bit_cast(held[p], ti.f32)
    for p in range(count):
        held[p] = ti.bit_cast(spare[p][0], ti.i32)


@kernel
def permute_triples(count: ti.i32, targets: Integers, old: Vectors3, new: Vectors3):
    """Move one vector of three a particle to its new index."""
    for p in range(count):
        new[targets[p]] = old[p]


@kernel
def permute_matrices(count: ti.i32, targets: Integers, old: Matrices, new: Matrices):
    """Move one matrix a particle to its new index."""
    for p in range(count):
        new[targets[p]] = old[p]
