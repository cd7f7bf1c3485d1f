# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Windows of nodes that blocks of particles read and write: filling, clearing and summing them.

A block of particles owns a window of nodes to write (see ``layout``) and borrows one to read. Where many lanes share a
block both lie in shared memory, component by component, with padding between layers (``layer``, ``first_of``,
``in_window``); the one to write holds whole numbers, except for fluids. ``node_of``, ``set_node`` and ``add_to`` hide
that.
"""

from typing import Any

import taichi as ti

from .lanes import PADDED, PADDED_NODES
from .layout import BLOCK_NODES, FIXED_ONE, WINDOW, WINDOW_NODES, Integers, Vectors4, ivec3, vec4

MOST_SUM = 2.0**30
"""Largest whole number to which the particles of a block may add up at a node."""

LEAST_LARGEST = 1e-20
"""What is smaller (kg cells/s, kg) counts as nothing where windows are summed in whole numbers."""


def is_shared(window: Any) -> bool:
    """Whether ``window`` lies in shared memory."""
    return isinstance(window, ti.simt.block.SharedArray)


def is_whole(window: Any) -> bool:
    """Whether ``window`` lies in shared memory and holds whole numbers."""
    return is_shared(window) and window.dtype == ti.i32


def layer(window: Any) -> int:
    """Nodes from one layer of a window to the next."""
    return PADDED if is_shared(window) else WINDOW * WINDOW


@ti.func
def first_of(base: ti.template(), window: ti.template()):
    """Index in ``window`` of its node at ``base``, three whole numbers from 0 to 5."""
    node = ivec3(base[0], base[1], base[2])
    if ti.static(is_shared(window)):
        # Beyond shared memory lies an error of the whole card; elsewhere another block's window.
        node = ti.min(ti.max(node, 0), WINDOW - 3)
    return node[0] * ti.static(layer(window)) + node[1] * 8 + node[2]


@ti.func
def in_cells(x: ivec3):
    """Place (cells) from a window's first node of what lies at ``x`` in fixed point."""
    return ti.cast(x, ti.f32) * (1.0 / FIXED_ONE)


def is_given(argument: Any) -> bool:
    """Whether ``argument`` is not None; Taichi's own code cannot ask."""
    return argument is not None


@ti.func
def in_window(n: ti.i32, window: ti.template()):
    """Place in ``window`` of its node ``n``."""
    place = n
    if ti.static(is_shared(window)):
        place += (n >> 6) * ti.static(PADDED - WINDOW * WINDOW)
    return place


@ti.func
def node_of(window: ti.template(), n: ti.i32):
    """The four numbers of a node of a window."""
    node = vec4(0.0)
    if ti.static(is_shared(window)):
        for c in ti.static(range(4)):
            node[c] = ti.cast(window[c * PADDED_NODES + n], ti.f32)
    else:
        node = window[n]
    return node


@ti.func
def set_node(window: ti.template(), n: ti.i32, node: vec4):
    """Set the four numbers of a node of a window."""
    if ti.static(is_shared(window)):
        for c in ti.static(range(4)):
            if ti.static(is_whole(window)):
                window[c * PADDED_NODES + n] = ti.floor(node[c] + 0.5, ti.i32)
            else:
                window[c * PADDED_NODES + n] = node[c]
    else:
        window[n] = node


@ti.func
def add_whole(window: ti.template(), n: ti.i32, share: vec4):
    """Add ``share``, rounded, to a node of a window of whole numbers; what rounding has left of it."""
    left = share
    for c in ti.static(range(4)):
        nearest = ti.floor(share[c] + 0.5, ti.i32)
        left[c] -= ti.cast(nearest, ti.f32)
        ti.atomic_add(window[c * PADDED_NODES + n], nearest)
    return left


@ti.func
def add_to(window: ti.template(), n: ti.i32, share: vec4):
    """Add to a node of a window: in shared memory atomically, elsewhere one thread owns the window."""
    if ti.static(is_whole(window)):
        add_whole(window, n, share)
    elif ti.static(is_shared(window)):
        for c in ti.static(range(4)):
            ti.atomic_add(window[c * PADDED_NODES + n], share[c])
    else:
        window[n] = window[n] + share


@ti.func
def clear_window(lanes: ti.template(), lane: ti.i32, offset: ti.i32, window: ti.template()):
    """Set a window to zero."""
    if ti.static(is_shared(window)):
        i = lane
        while i < WINDOW_NODES:
            set_node(window, offset + in_window(i, window), vec4(0.0))
            i += ti.static(lanes.threads)
    else:
        nought = vec4(0.0)
        for four in range(WINDOW_NODES // 4):
            put_four(window, offset + four * 4, nought, nought, nought, nought)


@ti.func
def put_four(window: Vectors4, first: ti.i32, a: vec4, b: vec4, c: vec4, d: vec4):
    """Set the four nodes of an array from ``first`` on.

    Taichi reads the array's address anew for each number that it writes, which might have changed it for all that the
    compiler knows. Where nodes have been read, it keeps their addresses: then it writes them all at once.
    """
    old_a, old_b, old_c, old_d = window[first], window[first + 1], window[first + 2], window[first + 3]
    window[first] = ti.select(first < 0, old_a, a)
    window[first + 1] = ti.select(first < 0, old_b, b)
    window[first + 2] = ti.select(first < 0, old_c, c)
    window[first + 3] = ti.select(first < 0, old_d, d)


@ti.func
def scale_window(lanes: ti.template(), lane: ti.i32, factor: vec4, window: ti.template()):
    """Multiply the nodes of a window by ``factor``, each number by its own."""
    i = lane
    while i < WINDOW_NODES:
        n = in_window(i, window)
        set_node(window, n, node_of(window, n) * factor)
        i += ti.static(lanes.threads)


@ti.func
def store_window(
    lanes: ti.template(), lane: ti.i32, k: ti.i32, window: ti.template(), array: Vectors4, unit: ti.template() = 1.0
):
    """Copy block ``k``'s window, whose numbers count ``unit``, from shared memory to its place in ``array``; without
    shared memory it is there."""
    if ti.static(lanes.shared):
        i = lane
        while i < WINDOW_NODES:
            array[k * WINDOW_NODES + i] = node_of(window, in_window(i, window)) * unit
            i += ti.static(lanes.threads)


@ti.func
def turns(lanes: ti.template(), count: ti.i32, window: Vectors4):
    """Threads, or groups of them, that take ``count`` blocks in turn: as many as have a window to read, if it lies in
    an array; in shared memory each group has its own."""
    number = count
    if ti.static(not lanes.shared):
        number = ti.min(count, window.shape[0] // WINDOW_NODES)
    return number


@ti.func
def grid_node(k: ti.i32, n: ti.i32, neighbours: Integers):
    """Index of node ``n`` of particle block ``k``'s window among the nodes of the grid blocks."""
    # Nodes 0 of the window's eight lie in the block before, 1 to 4 in the block itself, 5 to 7 in the one after.
    i, j, m = (n >> 6) + 3, (n >> 3 & 7) + 3, (n & 7) + 3
    g = neighbours[k * 27 + (i >> 2) * 9 + (j >> 2) * 3 + (m >> 2)]
    return g * BLOCK_NODES + (i & 3) * 16 + (j & 3) * 4 + (m & 3)


@ti.func
def fetch_window(
    lanes: ti.template(),
    lane: ti.i32,
    k: ti.i32,
    spot: ti.i32,
    neighbours: Integers,
    nodes: Vectors4,
    window: ti.template(),
):
    """Copy the nodes around particle block ``k`` to ``window`` from ``spot`` on, node by node: ``load_window`` for
    many lanes."""
    n = lane
    while n < WINDOW_NODES:
        set_node(window, spot + in_window(n, window), nodes[grid_node(k, n, neighbours)])
        n += ti.static(lanes.threads)


@ti.func
def gathered(g: ti.i32, n: ti.i32, neighbours: Integers, chosen: ti.template(), window: Vectors4):
    """Sum at node ``n`` of grid block ``g`` of the eight windows that hold it, of particle blocks that have a 1 in
    ``chosen`` (None: all): ``sum_windows`` for one node."""
    total = vec4(0.0)
    place = ti.Vector([n >> 4, n >> 2 & 3, n & 3])
    for corner in range(8):
        d, node = 0, 0
        for axis in ti.static(range(3)):
            # Each axis has two: the block's own window, and that of the block before it (or, for the last node, after).
            side = 0
            if (corner >> axis) & 1:
                side = ti.select(place[axis] == 3, 1, -1)
            d = d * 3 + side + 1
            node = node * 8 + place[axis] + 1 - 4 * side
        k = neighbours[g * 27 + d]
        wanted = k >= 0
        if ti.static(is_given(chosen)):
            if wanted:
                wanted = chosen[k] == 1
        if wanted:
            total += window[k * WINDOW_NODES + node]
    return total


@ti.func
def load_window(k: ti.i32, spot: ti.i32, neighbours: Integers, window: Vectors4, nodes: Vectors4):
    """Copy the nodes around particle block ``k`` to ``window`` from ``spot`` on."""
    for line in range(WINDOW * WINDOW):
        # As in ``grid_node``.
        i, j = (line >> 3) + 3, (line & 7) + 3
        d = k * 27 + (i >> 2) * 9 + (j >> 2) * 3
        place = (i & 3) * 16 + (j & 3) * 4
        before = neighbours[d] * BLOCK_NODES + place
        here = neighbours[d + 1] * BLOCK_NODES + place
        after = neighbours[d + 2] * BLOCK_NODES + place
        n = spot + line * WINDOW
        put_four(window, n, nodes[before + 3], nodes[here], nodes[here + 1], nodes[here + 2])
        put_four(window, n + 4, nodes[here + 3], nodes[after], nodes[after + 1], nodes[after + 2])


@ti.func
def other_side(place: ti.i32):
    """Of a node at ``place`` 0 to 3 along an axis of its block: which other block's window holds it, 1 or -1."""
    return ti.select(place == 3, 1, -1)


@ti.func
def has_window(k: ti.i32, chosen: ti.template()):
    """Whether ``k`` is a particle block, and has a 1 in ``chosen`` (None: any)."""
    wanted = k >= 0
    if ti.static(is_given(chosen)):
        if wanted:
            wanted = chosen[k] == 1
    return wanted


@ti.func
def sum_row(g: ti.i32, line: ti.i32, neighbours: Integers, chosen: ti.template(), window: Vectors4):
    """The four nodes ``line`` of 16 of grid block ``g``: the sums of the windows of the particle blocks around it that
    have a 1 in ``chosen`` (None: all)."""
    i, j = line >> 2, line & 3
    t0, t1, t2, t3 = vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0)
    for corner in range(4):
        # On each axis two windows hold a node: its own block's, and that of the block before it or, of the last, after.
        si = ti.select(corner < 2, 0, other_side(i))
        sj = ti.select(corner & 1 == 0, 0, other_side(j))
        d = g * 27 + si * 9 + sj * 3 + 12
        place = (i + 1 - 4 * si) * 64 + (j + 1 - 4 * sj) * 8
        k = neighbours[d + 1]
        if has_window(k, chosen):
            n = k * WINDOW_NODES + place
            t0 += window[n + 1]
            t1 += window[n + 2]
            t2 += window[n + 3]
            t3 += window[n + 4]
        k = neighbours[d]
        if has_window(k, chosen):
            n = k * WINDOW_NODES + place
            t0 += window[n + 5]
            t1 += window[n + 6]
            t2 += window[n + 7]
        k = neighbours[d + 2]
        if has_window(k, chosen):
            t3 += window[k * WINDOW_NODES + place]
    return t0, t1, t2, t3


@ti.func
def sum_windows(g: ti.i32, neighbours: Integers, window: Vectors4, nodes: Vectors4):
    """The nodes of grid block ``g``: the sum of the windows of the 27 particle blocks around it."""
    for line in range(16):
        t0, t1, t2, t3 = sum_row(g, line, neighbours, None, window)
        put_four(nodes, g * BLOCK_NODES + line * 4, t0, t1, t2, t3)


@ti.func
def sum_chosen_windows(g: ti.i32, s: ti.i32, neighbours: Integers, chosen: Integers, window: Vectors4, sums: Vectors4):
    """The same into slot ``s`` of ``sums``, of the particle blocks that have a 1 in ``chosen``."""
    for line in range(16):
        t0, t1, t2, t3 = sum_row(g, line, neighbours, chosen, window)
        put_four(sums, s * BLOCK_NODES + line * 4, t0, t1, t2, t3)
