# SPDX-License-Identifier: MIT
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""One substep of all worlds as one kernel: a launch costs about 0.1 ms of Python, as much as the work on a thousand
particles."""

import taichi as ti

from .contact import apply_contact, solve_contact
from .layout import Cells, Doubles, Integers, Matrices, Scalars, Vectors3, Vectors4
from .nodes import advance_nodes, gather_means
from .separation import gather_shares, scatter_shares, separate
from .stepping import review
from .transfer import advance_particles


@ti.kernel
def substep(
    laws: ti.template(),
    world_count: ti.i32,
    mean_fields: ti.i32,
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    near_p_count: ti.i32,
    near_g_count: ti.i32,
    meet_g_count: ti.i32,
    lead_count: ti.i32,
    meet_p_count: ti.i32,
    cfl_elastic: ti.f64,
    cfl_velocity: ti.f64,
    p_cells: Cells,
    p_field: Integers,
    starts: Integers,
    p_neighbours: Integers,
    near: Integers,
    near_p: Integers,
    meets_p: Integers,
    meet_p: Integers,
    touched: Integers,
    g_cells: Cells,
    g_field: Integers,
    g_starts: Integers,
    g_neighbours: Integers,
    near_g: Integers,
    mate: Integers,
    meet: Integers,
    meet_g: Integers,
    leads: Integers,
    world_integers: Integers,
    worlds: Scalars,
    field_integers: Integers,
    fields: Scalars,
    means: Scalars,
    touches: Scalars,
    pairs: Scalars,
    control: Doubles,
    x: Cells,
    v: Vectors3,
    C: Matrices,
    F: Matrices,
    constants: Vectors4,
    reaction: Vectors4,
    material: Integers,
    table: Scalars,
    memory: Scalars,
    volumes: Scalars,
    anchors: Vectors4,
    window: Vectors4,
    scattered: Vectors4,
    nodes: Vectors4,
    sums: Vectors4,
    masses: Scalars,
    block_sums: Scalars,
    report: Scalars,
) -> ti.i32:
    """Nodes over STEP, contact, grid to particles over STEP, particles to grid with the stress of NEXT_STEP.

    Every world is in the phase that ``control`` says and takes its own step. Counts of 0 leave their part out.
    laws: the set of constitutive laws that occur; one kernel is compiled for each set.
    Returns the number of worlds that want another substep.
    """
    advance_nodes(
        g_blocks,
        g_cells,
        g_field,
        g_neighbours,
        field_integers,
        fields,
        worlds,
        means,
        control,
        scattered,
        nodes,
        masses,
        block_sums,
    )
    gather_means(mean_fields, g_starts, field_integers, control, block_sums, means)
    scatter_shares(
        laws,
        meet_p_count,
        meet_p,
        p_field,
        starts,
        field_integers,
        control,
        x,
        F,
        volumes,
        material,
        table,
        memory,
        scattered,
    )
    gather_shares(meet_g_count, meet_g, g_field, g_neighbours, field_integers, control, meets_p, scattered, sums)
    separate(
        lead_count,
        leads,
        mate,
        meet,
        g_field,
        field_integers,
        world_integers,
        worlds,
        pairs,
        control,
        sums,
        masses,
        nodes,
    )
    solve_contact(
        near_p_count,
        near_p,
        p_cells,
        p_field,
        starts,
        p_neighbours,
        field_integers,
        fields,
        world_integers,
        worlds,
        touches,
        control,
        x,
        constants,
        anchors,
        reaction,
        window,
        nodes,
        scattered,
        touched,
    )
    apply_contact(
        near_g_count,
        near_g,
        g_field,
        g_neighbours,
        field_integers,
        control,
        touched,
        scattered,
        nodes,
        masses,
        sums,
    )
    advance_particles(
        laws,
        p_blocks,
        p_cells,
        p_field,
        starts,
        p_neighbours,
        near,
        field_integers,
        fields,
        worlds,
        control,
        x,
        v,
        C,
        F,
        constants,
        material,
        table,
        memory,
        anchors,
        reaction,
        window,
        nodes,
        scattered,
        report,
    )
    return review(world_count, p_blocks, cfl_elastic, cfl_velocity, p_field, field_integers, report, control)
