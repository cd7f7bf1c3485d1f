# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Number of threads that share a block of particles or nodes: one on the CPU, a group of them, *lanes*, on a graphics
card.

On the CPU a thread takes a whole block and its private window of nodes without atomics. A graphics card wants some
hundred thousand threads and has a fast memory shared by a group: there the lanes of a group take the particles of one
block in turn, the window lies in shared memory, and sums are atomic or by a tree. Kernels are written once; ``Lanes``
is known when they are compiled, so the CPU's code stays what it would be without.

A ``Lanes`` of one lane without shared memory (``ALONE``) runs the card's algorithms on the CPU, for tests.
"""

import os
from typing import Any, NamedTuple

import taichi as ti

from .layout import SPREAD, WINDOW, vec4


class Lanes(NamedTuple):
    """Threads that share a block."""

    threads: int
    """Threads a block; a power of two."""

    shared: bool
    """Whether windows lie in the shared memory of a group of threads, where ``threads`` > 1."""

    parallel: bool
    """Whether lists are made by all threads at once, in an order that is not repeatable."""

    groups: int = 0
    """Groups of ``threads`` that are launched to take blocks in turn, where windows are shared. A number that the
    compiler knows needs no launch of its own to find, and no groups that find nothing to do."""

    whole: bool = False
    """Whether windows are summed in whole numbers, see ``whole_transfer``: shared memory adds those by itself, and
    floats by compare-and-swap in a loop."""

    @property
    def span(self) -> int:
        """Loop iterations a block."""
        return self.threads if self.shared else SPREAD

    @property
    def warps(self) -> int:
        """Groups of WARP lanes, which run in step and can read from one another."""
        return self.threads // WARP


WARP = 32
HALVES = (16, 8, 4, 2, 1)
"""Half of a warp, a quarter, … one."""

WHOLE_WARP = 0xFFFFFFFF
"""Bits of all lanes of a warp."""

SERIAL = Lanes(threads=1, shared=False, parallel=False)
ALONE = Lanes(threads=1, shared=False, parallel=True)
CUDA = Lanes(threads=128, shared=True, parallel=True, groups=4096, whole=True)
"""128 threads a block get 255 registers each, enough for the pass over the particles; of 512 they get 64, and spill 1.2
KB each. Measured on an H200; groups beyond those that run at once cost little."""


def lanes_of(arch: str) -> Lanes:
    """The lanes of an architecture in use, as ``runtime.ensure_started`` names it; Vulkan lacks 64-bit atomics."""
    return CUDA if arch == "cuda" else SERIAL


WINDOWS_A_THREAD = 32
"""Windows to read nodes from, of each thread of a CPU: pieces of work to share out evenly, four at a time."""


def windows_of(arch: str, threads: int) -> int:
    """How many windows to read from there are at most: a CPU's threads, 0 for all that it has, take blocks in turn;
    elsewhere every block has its own."""
    return WINDOWS_A_THREAD * (threads or os.cpu_count() or 1) if arch == "cpu" else 2**31


PADDED = WINDOW * WINDOW + 4
"""Numbers from one layer of a window in shared memory to the next. With the four of padding, the cells of half a block
lie in the 32 banks of that memory, one in each; without, in every second four of banks, two in each."""

PADDED_NODES = WINDOW * PADDED


NODE_THREADS = 1 << 17
"""Threads of a card that take nodes in turn; known to the compiler, as ``Lanes.groups`` is."""


class Pads(NamedTuple):
    """Memory that the lanes of a block share: SharedArrays on a card, otherwise the block's part of global arrays."""

    window: Any
    """Nodes to read with ``node_of``: (4 PADDED_NODES,) f32 in shared memory, component by component (Taichi has no
    atomic sums of vectors there), otherwise vec4."""

    scattered: Any
    """Nodes to add to with ``add_to``; in shared memory f32 or, as whole numbers in units of the block's own, i32."""

    past_window: Any
    past_scattered: Any
    """The same two for ``FlowArrays``."""

    maxima: Any
    """(4 warps,) f32, for ``lane_maxima`` and ``lane_sum``; None without shared memory."""


def pads_of(lanes: Lanes, nodes: Any, flow: Any = None, whole: bool = False) -> Pads:
    """New pads of a block; ``flow`` where flowing matter occurs; ``whole``: to add whole numbers to. Call it in
    ``ti.static``, once a group of threads."""
    if not lanes.shared:
        past_window, past_scattered = (None, None) if flow is None else (flow.window, flow.scattered)
        return Pads(nodes.window, nodes.scattered, past_window, past_scattered, None)
    shared = ti.simt.block.SharedArray
    kinds = (ti.f32, ti.i32 if whole else ti.f32, *(() if flow is None else (ti.f32, ti.f32)))
    windows = [shared((4 * PADDED_NODES,), kind) for kind in kinds]
    windows += [None] * (4 - len(windows))
    return reduction_pads(lanes)._replace(**dict(zip(Pads._fields, windows, strict=False)))


def reduction_pads(lanes: Lanes) -> Pads:
    """New pads for ``lane_maxima`` and ``lane_sum`` alone."""
    shared = ti.simt.block.SharedArray
    return Pads(None, None, None, None, shared((4 * lanes.warps,), ti.f32) if lanes.shared else None)


def counters(lanes: Lanes) -> Any:
    """A tuple of one new array of whole numbers, one a lane, for sums over the lanes before; empty without lanes."""
    return (ti.simt.block.SharedArray((lanes.threads,), ti.i32),) if lanes.shared else ()


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
            for half in ti.static(HALVES):
                result[n] = ti.max(result[n], ti.simt.warp.shfl_down_f32(ti.u32(WHOLE_WARP), result[n], half))
        if lane % WARP == 0:
            for n in ti.static(range(4)):
                pads.maxima[n * lanes.warps + lane // WARP] = result[n]
        ti.simt.block.sync()
        for n in ti.static(range(4)):
            result[n] = pads.maxima[n * lanes.warps]
            for other in ti.static(range(1, lanes.warps)):
                result[n] = ti.max(result[n], pads.maxima[n * lanes.warps + other])
        ti.simt.block.sync()
    return result


@ti.func
def lane_sum(lanes: ti.template(), lane: ti.i32, value: ti.f32, pads: ti.template()):
    """Sum over all lanes, for all of them."""
    result = value
    if ti.static(lanes.shared):
        for half in ti.static(HALVES):
            result += ti.simt.warp.shfl_down_f32(ti.u32(WHOLE_WARP), result, half)
        if lane % WARP == 0:
            pads.maxima[lane // WARP] = result
        ti.simt.block.sync()
        result = 0.0
        for other in ti.static(range(lanes.warps)):
            result += pads.maxima[other]
        ti.simt.block.sync()
    return result
