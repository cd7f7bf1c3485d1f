# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""How many threads share a block of particles or nodes: one on the CPU, a group of them, *lanes*, on a graphics card.

On the CPU a thread takes a whole block and its private window of nodes without atomics. A graphics card wants some
hundred thousand threads and has a fast memory shared by a group: there the lanes of a group take the particles of one
block in turn, the window lies in shared memory, and sums are atomic or by a tree. Kernels are written once; ``Lanes``
is known when they are compiled, so the CPU's code stays what it would be without.

A ``Lanes`` of one lane without shared memory (``ALONE``) runs the card's algorithms on the CPU, for tests.
"""

from typing import Any, NamedTuple

import taichi as ti

from .layout import BLOCK_NODES, SPREAD, WINDOW_NODES, Integers, Vectors4, vec4


class Lanes(NamedTuple):
    """Threads that share a block."""

    threads: int
    """Threads a block; a power of two."""

    shared: bool
    """Whether windows lie in the shared memory of a group of threads, where ``threads`` > 1."""

    parallel: bool
    """Whether lists are made by all threads at once, in an order that is not repeatable."""

    @property
    def span(self) -> int:
        """Loop iterations a block."""
        return self.threads if self.shared else SPREAD

    @property
    def halvings(self) -> tuple[int, ...]:
        """Half of the lanes, a quarter, … one."""
        return tuple(self.threads >> level for level in range(1, self.threads.bit_length()))


SERIAL = Lanes(threads=1, shared=False, parallel=False)
ALONE = Lanes(threads=1, shared=False, parallel=True)
CUDA = Lanes(threads=512, shared=True, parallel=True)


def lanes_of(arch: str) -> Lanes:
    """The lanes of an architecture in use, as ``runtime.ensure_started`` names it; Vulkan lacks 64-bit atomics."""
    return CUDA if arch == "cuda" else SERIAL


class Pads(NamedTuple):
    """What the lanes of a block share: SharedArrays on a card, otherwise the block's part of global arrays."""

    window: Any
    """Nodes to read with ``node_of``: (4 WINDOW_NODES,) f32 in shared memory, component by component (Taichi has no
    atomic sums of vectors there), otherwise vec4."""

    scattered: Any
    """Nodes to add to with ``add_to``."""

    past_window: Any
    past_scattered: Any
    """The same two for ``FlowArrays``."""

    maxima: Any
    """(4 lanes,) f32, for ``lane_maxima``; None without shared memory."""

    sums: Any
    """(lanes,) f32, for ``lane_sum``; None without shared memory."""


def pads_of(lanes: Lanes, nodes: Any, flow: Any = None) -> Pads:
    """New pads of a block; ``flow`` where flowing matter occurs. Call it in ``ti.static``, once a group of threads."""
    if not lanes.shared:
        past_window, past_scattered = (None, None) if flow is None else (flow.window, flow.scattered)
        return Pads(nodes.window, nodes.scattered, past_window, past_scattered, None, None)
    shared = ti.simt.block.SharedArray
    windows = [shared((4 * WINDOW_NODES,), ti.f32) for _ in range(2 if flow is None else 4)]
    windows += [None] * (4 - len(windows))
    return reduction_pads(lanes)._replace(**dict(zip(Pads._fields, windows, strict=False)))


def reduction_pads(lanes: Lanes) -> Pads:
    """New pads for ``lane_maxima`` and ``lane_sum`` alone."""
    shared = ti.simt.block.SharedArray
    maxima = shared((4 * lanes.threads,), ti.f32) if lanes.shared else None
    return Pads(None, None, None, None, maxima, shared((lanes.threads,), ti.f32) if lanes.shared else None)


def counters(lanes: Lanes) -> Any:
    """A tuple of one new array of whole numbers, one a lane, for sums over the lanes before; empty without lanes."""
    return (ti.simt.block.SharedArray((lanes.threads,), ti.i32),) if lanes.shared else ()


def is_shared(window: Any) -> bool:
    """Whether ``window`` lies in shared memory."""
    return isinstance(window, ti.simt.block.SharedArray)


def is_given(argument: Any) -> bool:
    """Whether ``argument`` is not None; Taichi's own code cannot ask."""
    return argument is not None


@ti.func
def meet(lanes: ti.template()):
    """Wait until all lanes of the block are here and see what the others wrote."""
    if ti.static(lanes.shared):
        ti.simt.block.sync()


@ti.func
def lane_maxima(lanes: ti.template(), lane: ti.i32, values: vec4, pads: ti.template()):
    """Largest of each of four numbers over all lanes, for all of them."""
    result = values
    if ti.static(lanes.shared):
        for n in ti.static(range(4)):
            pads.maxima[n * lanes.threads + lane] = values[n]
        ti.simt.block.sync()
        for half in ti.static(lanes.halvings):
            if lane < half:
                for n in ti.static(range(4)):
                    at = n * lanes.threads + lane
                    pads.maxima[at] = ti.max(pads.maxima[at], pads.maxima[at + half])
            ti.simt.block.sync()
        for n in ti.static(range(4)):
            result[n] = pads.maxima[n * lanes.threads]
        ti.simt.block.sync()
    return result


@ti.func
def lane_sum(lanes: ti.template(), lane: ti.i32, value: ti.f32, pads: ti.template()):
    """Sum over all lanes, for all of them."""
    result = value
    if ti.static(lanes.shared):
        pads.sums[lane] = value
        ti.simt.block.sync()
        for half in ti.static(lanes.halvings):
            if lane < half:
                pads.sums[lane] = pads.sums[lane] + pads.sums[lane + half]
            ti.simt.block.sync()
        result = pads.sums[0]
        ti.simt.block.sync()
    return result


@ti.func
def node_of(window: ti.template(), n: ti.i32):
    """The four numbers of a node of a window."""
    node = vec4(0.0)
    if ti.static(is_shared(window)):
        for c in ti.static(range(4)):
            node[c] = window[c * WINDOW_NODES + n]
    else:
        node = window[n]
    return node


@ti.func
def set_node(window: ti.template(), n: ti.i32, node: vec4):
    """Set the four numbers of a node of a window."""
    if ti.static(is_shared(window)):
        for c in ti.static(range(4)):
            window[c * WINDOW_NODES + n] = node[c]
    else:
        window[n] = node


@ti.func
def add_to(window: ti.template(), n: ti.i32, share: vec4):
    """Add to a node of a window: in shared memory atomically, elsewhere one thread owns the window."""
    if ti.static(is_shared(window)):
        for c in ti.static(range(4)):
            ti.atomic_add(window[c * WINDOW_NODES + n], share[c])
    else:
        window[n] = window[n] + share


@ti.func
def clear_window(lanes: ti.template(), lane: ti.i32, offset: ti.i32, window: ti.template()):
    """Set a window to zero."""
    i = lane
    while i < WINDOW_NODES:
        set_node(window, offset + i, vec4(0.0))
        i += ti.static(lanes.threads)


@ti.func
def store_window(lanes: ti.template(), lane: ti.i32, k: ti.i32, window: ti.template(), array: Vectors4):
    """Copy block ``k``'s window from shared memory to its place in ``array``; without shared memory it is there."""
    if ti.static(lanes.shared):
        i = lane
        while i < WINDOW_NODES:
            array[k * WINDOW_NODES + i] = node_of(window, i)
            i += ti.static(lanes.threads)


@ti.func
def fetch_window(
    lanes: ti.template(), lane: ti.i32, k: ti.i32, neighbours: Integers, nodes: Vectors4, window: ti.template()
):
    """Copy the nodes around particle block ``k`` into its window, node by node: ``particle_transfer.load_window`` for
    many lanes."""
    offset = 0 if ti.static(lanes.shared) else k * WINDOW_NODES
    n = lane
    while n < WINDOW_NODES:
        # Nodes 0 of the window's eight lie in the block before, 1 to 4 in the block itself, 5 to 7 in the one after.
        i, j, m = (n >> 6) + 3, (n >> 3 & 7) + 3, (n & 7) + 3
        g = neighbours[k * 27 + (i >> 2) * 9 + (j >> 2) * 3 + (m >> 2)]
        set_node(window, offset + n, nodes[g * BLOCK_NODES + (i & 3) * 16 + (j & 3) * 4 + (m & 3)])
        n += ti.static(lanes.threads)


@ti.func
def gathered(g: ti.i32, n: ti.i32, neighbours: Integers, chosen: ti.template(), window: Vectors4):
    """Sum at node ``n`` of grid block ``g`` of the eight windows that hold it, of particle blocks that have a 1 in
    ``chosen`` (None: all): ``particle_transfer.sum_windows`` for one node."""
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
