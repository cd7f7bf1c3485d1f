# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Worlds that hold nothing but solids: all their substeps in one launch, where a launch costs more than many substeps.

The substeps are the same, to the last bit, as those that ``substep`` takes one by one.
"""

import taichi as ti

from .layout import CONTROL_ROW, FULL, IDLE, PHASE, STEP, Doubles, Integers, Scalars
from .rigid import predict, push_and_search, solve_and_move
from .stepping import forget_reports, settle

ITERATIONS = 512
"""Loop iterations spent on one world: Taichi's CPU backend gives a thread at least so many at a time."""


@ti.kernel
def advance_solids(
    world_count: ti.i32,
    cfl_elastic: ti.f64,
    cfl_velocity: ti.f64,
    world_integers: Integers,
    control: Doubles,
    world_spans: Integers,
    world_numbers: Doubles,
    world_report: Doubles,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    impulses: Doubles,
    clusters: Scalars,
    cluster_starts: Integers,
    points: Scalars,
    shape_numbers: Scalars,
    shape_dims: Integers,
    distances: Scalars,
    pairs: Integers,
    pair_numbers: Doubles,
    counts: Integers,
    contacts: Doubles,
    memory: Doubles,
    reaches: Doubles,
    scores: Doubles,
    chosen: Integers,
):
    """Take every world that is not idle to the end of its segment of time."""
    for ww in range(world_count * ITERATIONS):
        if ww % ITERATIONS == 0:
            w = ww // ITERATIONS
            while control[w * CONTROL_ROW + PHASE] != IDLE:
                if control[w * CONTROL_ROW + PHASE] == FULL:
                    step = control[w * CONTROL_ROW + STEP]
                    predict(w, step, world_spans, solids)
                    push_and_search(
                        w,
                        step,
                        world_spans,
                        world_numbers,
                        solid_kinds,
                        solid_numbers,
                        solids,
                        impulses,
                        clusters,
                        cluster_starts,
                        points,
                        shape_numbers,
                        shape_dims,
                        distances,
                        pairs,
                        pair_numbers,
                        counts,
                        contacts,
                        memory,
                        reaches,
                        scores,
                        chosen,
                    )
                    solve_and_move(
                        w,
                        step,
                        world_spans,
                        world_numbers,
                        world_report,
                        solid_kinds,
                        solid_numbers,
                        solids,
                        pairs,
                        pair_numbers,
                        counts,
                        contacts,
                        memory,
                    )
                forget_reports(w, world_integers, solid_kinds, solid_numbers, solids, control)
                settle(w, cfl_elastic, cfl_velocity, world_integers, control)
