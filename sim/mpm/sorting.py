# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Grouping the particles in blocks: which block each is in, the lists of blocks, their neighbours, the permutation.

A block's key packs its field and its three coordinates in 64 bits. Two hash tables map keys to slots in the list of
particle blocks and of grid blocks (blocks that particles can reach), so time and memory follow the occupied blocks and
a body may go anywhere. Everything that decides an order is serial, hence the same on every run.
"""

import taichi as ti

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
    Doubles,
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


@ti.func
def place_in_table(key: ti.i64, mask: ti.i32, table_keys: Keys):
    """Where ``key`` stands in the table, or the empty place where it would go (linear probing)."""
    b = key_block(key)
    h = (b[0] * 73856093) ^ (b[1] * 19349663) ^ (b[2] * 83492791) ^ (key_field(key) * 25165843)
    h = (h ^ (h >> 15)) & mask
    while table_keys[h] != key and table_keys[h] != -1:
        h = (h + 1) & mask
    return h


@ti.func
def slot_of(key: ti.i64, mask: ti.i32, table_keys: Keys, table_slots: Integers):
    """Slot of the block ``key``, -1 where there is none."""
    h = place_in_table(key, mask, table_keys)
    slot = -1
    if table_keys[h] == key:
        slot = table_slots[h]
    return slot


@ti.func
def neighbour_offset(d: ti.i32):
    """Offset of neighbour ``d`` of 27, each component -1, 0 or 1."""
    return ivec3(d // 9 - 1, d // 3 % 3 - 1, d % 3 - 1)


@ti.kernel
def rebase(
    blocks: ti.i32,
    p_cells: Cells,
    p_field: Integers,
    starts: Integers,
    field_integers: Integers,
    control: Doubles,
    x: Cells,
    keys: Keys,
):
    """Find each particle's new block and express its position in that block's window. Exact: integers are shifted.

    Particles of worlds that want no sort stay in their blocks: moving them would change the order of sums.
    """
    for k in range(blocks):
        f = p_field[k]
        old = p_cells[k]
        moves = control[field_integers[f * FIELD_INTEGERS + WORLD] * CONTROL_ROW + STATUS] == WANTS_SORT
        for p in range(starts[k], starts[k + 1]):
            new = old
            if moves:
                xi = x[p]
                for c in ti.static(range(3)):
                    base = old[c] * 4 - 1 + ((xi[c] - FIXED_LOW) >> FIXED_BITS)
                    new[c] = ti.min(ti.max(base >> 2, -FARTHEST_BLOCK), FARTHEST_BLOCK)
                x[p] = xi + (old - new) * (4 * FIXED_ONE)
            keys[p] = block_key(f, new)


@ti.kernel
def list_particle_blocks(
    count: ti.i32,
    capacity: ti.i32,
    mask: ti.i32,
    keys: Keys,
    table_keys: Keys,
    table_slots: Integers,
    p_cells: Cells,
    p_field: Integers,
    starts: Integers,
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
            h = place_in_table(key, mask, table_keys)
            if table_keys[h] == key:
                slot = table_slots[h]
            else:
                slot = found
                found += 1
                if slot < capacity:
                    table_keys[h] = key
                    table_slots[h] = slot
                    p_cells[slot] = key_block(key)
                    p_field[slot] = key_field(key)
                    starts[slot + 1] = 0
        if slot < capacity:
            starts[slot + 1] += 1
    return found


@ti.kernel
def list_grid_blocks(
    p_blocks: ti.i32,
    field_count: ti.i32,
    capacity: ti.i32,
    mask: ti.i32,
    p_cells: Cells,
    p_field: Integers,
    table_keys: Keys,
    table_slots: Integers,
    g_cells: Cells,
    g_field: Integers,
    g_starts: Integers,
    starts: Integers,
    cursors: Integers,
) -> ti.i32:
    """List the blocks around the particle blocks, those of a field one after the other from ``g_starts`` on.

    Also turns the counts in ``starts`` into offsets. Returns the number of blocks; past ``capacity`` only that it is
    larger. The table must be empty.
    """
    found = 0
    starts[0] = 0
    ti.loop_config(serialize=True)
    for f in range(field_count + 1):
        g_starts[f] = 0
    ti.loop_config(serialize=True)
    for k in range(p_blocks):
        cursors[k] = starts[k]
        starts[k + 1] += starts[k]
        for d in range(27):
            b = p_cells[k] + neighbour_offset(d)
            key = block_key(p_field[k], b)
            if found <= capacity:
                h = place_in_table(key, mask, table_keys)
                if table_keys[h] != key:
                    if found < capacity:
                        table_keys[h] = key
                        table_slots[h] = found
                        g_cells[found] = b
                        g_field[found] = p_field[k]
                        g_starts[p_field[k] + 1] += 1
                    found += 1
    ti.loop_config(serialize=True)
    for f in range(field_count):
        g_starts[f + 1] += g_starts[f]
    return found


@ti.kernel
def link_blocks(
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    p_mask: ti.i32,
    g_mask: ti.i32,
    p_cells: Cells,
    p_field: Integers,
    g_cells: Cells,
    g_field: Integers,
    p_keys: Keys,
    p_slots: Integers,
    g_keys: Keys,
    g_slots: Integers,
    p_neighbours: Integers,
    g_neighbours: Integers,
):
    """Neighbour lists: 27 grid blocks around each particle block, 27 particle blocks around each grid block."""
    for k in range(p_blocks):
        for d in range(27):
            key = block_key(p_field[k], p_cells[k] + neighbour_offset(d))
            p_neighbours[k * 27 + d] = slot_of(key, g_mask, g_keys, g_slots)
    for g in range(g_blocks):
        for d in range(27):
            key = block_key(g_field[g], g_cells[g] + neighbour_offset(d))
            g_neighbours[g * 27 + d] = slot_of(key, p_mask, p_keys, p_slots)


@ti.kernel
def place(
    count: ti.i32, mask: ti.i32, keys: Keys, p_keys: Keys, p_slots: Integers, cursors: Integers, targets: Integers
):
    """New index of every particle; particles of a block keep their order."""
    past = ti.cast(-1, ti.i64)
    slot = 0
    ti.loop_config(serialize=True)
    for p in range(count):
        if keys[p] != past:
            past = keys[p]
            slot = slot_of(past, mask, p_keys, p_slots)
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


@ti.kernel
def permute_numbers(count: ti.i32, targets: Integers, old: Scalars, new: Scalars):
    """Move one number a particle to its new index."""
    for p in range(count):
        new[targets[p]] = old[p]


@ti.kernel
def permute_integers(count: ti.i32, targets: Integers, old: Integers, new: Integers):
    """Move one whole number a particle to its new index."""
    for p in range(count):
        new[targets[p]] = old[p]


@ti.kernel
def permute_vectors(count: ti.i32, targets: Integers, old: Vectors4, new: Vectors4):
    """Move one vector a particle to its new index."""
    for p in range(count):
        new[targets[p]] = old[p]


@ti.kernel
def permute_triples(count: ti.i32, targets: Integers, old: Vectors3, new: Vectors3):
    """Move one vector of three a particle to its new index."""
    for p in range(count):
        new[targets[p]] = old[p]
