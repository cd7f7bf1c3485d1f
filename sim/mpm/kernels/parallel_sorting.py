# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""``sorting`` for a graphics card: the same lists, made by all threads at once, in an order that is not repeatable.

Keys go into the hash tables by ordered linear probing (Amble and Knuth 1974; Shun and Blelloch 2014 for many threads
at once): an entry holds the largest key that has come by, and the thread that displaces a smaller one carries that on.
An atomic maximum is all that it needs, and ``sorting.slot_of`` finds keys as in any table with linear probing, since
none is ever removed.
"""

import functools

import taichi as ti

from .kernel_arrays import BlockTable, GridBlocks, ParticleBlocks, WorldArrays
from .kernel_bundles import BundledKernel, func, kernel
from .lanes import Lanes, counters, meet
from .layout import FIXED_BITS, FIXED_LOW, Cells, Integers, Keys, ivec3
from .sorting import block_key, home, key_block, key_field, neighbour_offset, rebase_particle, slot_of, wants_sort


@func
def insert(key: ti.i64, table: BlockTable):
    """Put ``key`` into the table, once. A table that is full drops keys: its list is then longer than any capacity."""
    carried = key
    h = home(key, table)
    tries = 0
    while carried >= 0 and tries <= table.mask:
        old = ti.atomic_max(table.keys[h], carried)
        # The smaller of the two goes on; an empty entry (-1) or the same key ends it.
        carried = ti.select(old == carried, ti.cast(-1, ti.i64), ti.min(old, carried))
        h = (h + 1) & table.mask
        tries += 1


@func
def list_fields(field_count: ti.i32, starts: Integers, table: BlockTable):
    """Set ``starts[f]`` to the number of the table's blocks of the fields before ``f``, and ``starts[F]`` to all."""
    for f in range(field_count + 1):
        starts[f] = 0
    for h in range(table.mask + 1):
        if table.keys[h] >= 0:
            starts[key_field(table.keys[h]) + 1] += 1
    ti.loop_config(serialize=True)
    for f in range(field_count):
        starts[f + 1] += starts[f]


@func
def list_blocks(
    field_count: ti.i32, capacity: ti.i32, starts: Integers, cells: Cells, field: Integers, table: BlockTable
):
    """List the table's blocks, those of a field one after the other from ``starts[f]`` on, as far as ``capacity``
    goes."""
    list_fields(field_count, starts, table)
    for h in range(table.mask + 1):
        key = table.keys[h]
        if key >= 0:
            f = key_field(key)
            slot = ti.atomic_add(starts[f], 1)
            table.slots[h] = slot
            if slot < capacity:
                cells[slot] = key_block(key)
                field[slot] = f
    # Every start has moved to the next field's.
    ti.loop_config(serialize=True)
    for i in range(field_count):
        starts[field_count - i] = starts[field_count - i - 1]
    starts[0] = 0


@functools.cache
def rebase_of(lanes: Lanes) -> BundledKernel:
    """``sorting.rebase`` with many threads a block."""

    @kernel
    def rebase_in_parallel(x: Cells, keys: Keys, worlds: WorldArrays, blocks: ParticleBlocks):
        """Find each particle's new block and express its position in that block's window."""
        for t in range(blocks.count * ti.static(lanes.threads)):
            k = t // ti.static(lanes.threads)
            moves = wants_sort(k, worlds, blocks)
            p = blocks.starts[k] + t % ti.static(lanes.threads)
            while p < blocks.starts[k + 1]:
                rebase_particle(p, k, moves, x, keys, blocks)
                p += ti.static(lanes.threads)

    return rebase_in_parallel


@kernel
def list_particle_blocks_in_parallel(
    count: ti.i32,
    capacity: ti.i32,
    field_count: ti.i32,
    keys: Keys,
    starts: Integers,
    table: BlockTable,
    blocks: ParticleBlocks,
) -> ti.i32:
    """``sorting.list_particle_blocks``; starts: (F + 1,) written over."""
    for p in range(count):
        new = p == 0
        if p > 0:
            new = keys[p] != keys[p - 1]
        if new:
            insert(keys[p], table)
    list_blocks(field_count, capacity, starts, blocks.cells, blocks.field, table)
    found = starts[field_count]
    for k in range(ti.min(found, capacity)):
        blocks.starts[k + 1] = 0
    for p in range(count):
        if found <= capacity:
            blocks.starts[slot_of(keys[p], table) + 1] += 1
    return found


@functools.cache
def turn_counts_into_offsets_of(lanes: Lanes) -> BundledKernel:
    """Kernel that replaces the counts of particles in ``blocks.starts`` by offsets."""

    @kernel
    def turn_counts_into_offsets(blocks: ParticleBlocks):
        """A lane's part of the list starts with what the lanes before it hold."""
        if ti.static(lanes.shared):
            ti.loop_config(block_dim=ti.static(lanes.threads))
        for lane in range(ti.static(lanes.threads)):
            before = ti.static(counters(lanes))
            part = (blocks.count + ti.static(lanes.threads - 1)) // ti.static(lanes.threads)
            first, end = ti.min(lane * part, blocks.count), ti.min((lane + 1) * part, blocks.count)
            total = 0
            for k in range(first, end):
                total += blocks.starts[k + 1]
            if ti.static(lanes.shared):
                before[0][lane] = total
            meet(lanes)
            total = 0
            if ti.static(lanes.shared):
                for other in range(lane):
                    total += before[0][other]
            for k in range(first, end):
                total += blocks.starts[k + 1]
                blocks.starts[k + 1] = total
            if lane == 0:
                blocks.starts[0] = 0

    return turn_counts_into_offsets


@kernel
def list_grid_blocks_in_parallel(
    field_count: ti.i32, capacity: ti.i32, table: BlockTable, blocks: ParticleBlocks, grid: GridBlocks
) -> ti.i32:
    """``sorting.list_grid_blocks``, once counts are offsets."""
    for t in range(blocks.count * 27):
        k = t // 27
        insert(block_key(blocks.field[k], blocks.cells[k] + neighbour_offset(t % 27)), table)
    list_blocks(field_count, capacity, grid.starts, grid.cells, grid.field, table)
    return grid.starts[field_count]


@func
def cell_of(xi: ivec3):
    """Number of the cell, of the 64 of its block, in which a particle lies that is at ``xi`` in the block's window."""
    cell = 0
    for n in ti.static(range(3)):
        cell = cell * 4 + ti.min(ti.max(((xi[n] - FIXED_LOW) >> FIXED_BITS) - 1, 0), 3)
    return cell


@kernel
def place_in_turn(
    count: ti.i32,
    x: Cells,
    keys: Keys,
    counts: Integers,
    targets: Integers,
    table: BlockTable,
    blocks: ParticleBlocks,
):
    """As ``sorting.place``, those of a block so that the cells take turns: one particle of each, then a second one of
    each that has two, and so on. Lanes that run in step then hardly ever add to the same node.

    x: positions in the blocks that ``keys`` name; counts: (P, 64) written over.
    """
    for c in range(blocks.count * 64):
        counts[c] = 0
    for p in range(count):
        targets[p] = ti.atomic_add(counts[slot_of(keys[p], table) * 64 + cell_of(x[p])], 1)
    for p in range(count):
        slot, own, turn = slot_of(keys[p], table), cell_of(x[p]), targets[p]
        before = blocks.starts[slot]
        for c in range(64):
            others = counts[slot * 64 + c]
            before += ti.min(others, turn)
            if c < own and others > turn:
                before += 1
        targets[p] = before
