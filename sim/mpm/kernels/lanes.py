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

from .layout import SPREAD, WINDOW_NODES, vec4


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


WINDOWS_A_THREAD = 32
"""Windows to read nodes from, of each thread of a CPU: pieces of work to share out evenly, four at a time."""


def windows_of(arch: str, threads: int) -> int:
    """How many windows to read from there are at most: a CPU's threads, 0 for all that it has, take blocks in turn;
    elsewhere every block has its own."""
    return WINDOWS_A_THREAD * (threads or os.cpu_count() or 1) if arch == "cpu" else 2**31


class Pads(NamedTuple):
    """Memory that the lanes of a block share: SharedArrays on a card, otherwise the block's part of global arrays."""

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
