# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""One substep of all worlds, as the kernels that ``engine`` launches one after the other:

    advance_grid      nodes over STEP: velocities, forces
    part_bodies       contact between bodies that deform, where several are near each other
    resolve_contact   contact with the plane and with solids, pins; what solids feel of it
    (rigid)           motion of the solids: ``rigid.search_worlds``, ``rigid.move_worlds``
    advance_matter    grid to particles over STEP, particles to grid with the stress of NEXT_STEP, the next plan

Every world is in the phase that ``control`` says and takes its own step. The compiler takes more than twice as long for
a kernel of twice the length, so there are several.
"""

import functools

import taichi as ti

from .contact import apply_contact, solve_contact
from .launch import Kernel
from .layout import CONTROL_ROW, FULL, PHASE, STEP, Cells, Doubles, Integers, Matrices, Scalars, Vectors3, Vectors4
from .nodes import advance_nodes, gather_means
from .obstacles import gather_pushes
from .rigid import predict
from .separation import gather_shares, scatter_shares, separate
from .stepping import review
from .transfer import advance_particles


@functools.cache
def advance_grid_of(flowing: int) -> Kernel:
    """The kernel of nodes for worlds with the laws ``flowing`` of matter that flows (0: none)."""

    @ti.kernel
    def advance_grid(
        mean_fields: ti.i32,
        g_blocks: ti.i32,
        g_cells: Cells,
        g_field: Integers,
        g_starts: Integers,
        g_neighbours: Integers,
        field_integers: Integers,
        fields: Scalars,
        worlds: Scalars,
        means: Scalars,
        control: Doubles,
        scattered: Vectors4,
        nodes: Vectors4,
        past_scattered: Vectors4,
        past_nodes: Vectors4,
        masses: Scalars,
        block_sums: Scalars,
    ):
        """Nodes over STEP; ``mean_fields`` is 0 where no body's means are wanted."""
        advance_nodes(
            flowing,
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
            past_scattered,
            past_nodes,
            masses,
            block_sums,
        )
        gather_means(mean_fields, g_starts, field_integers, control, block_sums, means)

    return advance_grid


@functools.cache
def part_bodies_of(laws: int) -> Kernel:
    """The kernel of contact between bodies for the set ``laws`` of constitutive laws."""

    @ti.kernel
    def part_bodies(
        meet_g_count: ti.i32,
        lead_count: ti.i32,
        meet_p_count: ti.i32,
        p_field: Integers,
        starts: Integers,
        meets_p: Integers,
        meet_p: Integers,
        g_field: Integers,
        g_neighbours: Integers,
        mate: Integers,
        meet: Integers,
        meet_g: Integers,
        leads: Integers,
        world_integers: Integers,
        worlds: Scalars,
        field_integers: Integers,
        pairs: Scalars,
        control: Doubles,
        x: Cells,
        F: Matrices,
        material: Integers,
        table: Scalars,
        memory: Scalars,
        volumes: Scalars,
        scattered: Vectors4,
        nodes: Vectors4,
        sums: Vectors4,
        masses: Scalars,
    ):
        """Impulses between the nodes of different bodies in the same place."""
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

    return part_bodies


@ti.kernel
def plan_solids(world_count: ti.i32, world_spans: Integers, control: Doubles, steps: Doubles, solids: Doubles):
    """Steps of the worlds for the solids' kernels, 0 of idle worlds, and the velocity expected of each solid."""
    ti.loop_config(serialize=True)
    for w in range(world_count):
        steps[w] = 0.0
        if control[w * CONTROL_ROW + PHASE] == FULL:
            steps[w] = control[w * CONTROL_ROW + STEP]
            predict(w, steps[w], world_spans, solids)


@ti.kernel
def resolve_contact(
    world_count: ti.i32,
    solid_count: ti.i32,
    near_p_count: ti.i32,
    near_g_count: ti.i32,
    most_solids: ti.i32,
    p_cells: Cells,
    p_field: Integers,
    starts: Integers,
    p_neighbours: Integers,
    near_p: Integers,
    touched: Integers,
    slack: Scalars,
    g_field: Integers,
    g_neighbours: Integers,
    near_g: Integers,
    world_integers: Integers,
    worlds: Scalars,
    field_integers: Integers,
    fields: Scalars,
    touches: Scalars,
    control: Doubles,
    x: Cells,
    constants: Vectors4,
    reaction: Vectors4,
    anchors: Vectors4,
    window: Vectors4,
    scattered: Vectors4,
    nodes: Vectors4,
    sums: Vectors4,
    masses: Scalars,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    impulses: Doubles,
    shape_numbers: Scalars,
    shape_dims: Integers,
    distances: Scalars,
    touching: Scalars,
    pushes: Scalars,
):
    """Impulses between particles and planes, solids and pins."""
    solve_contact(
        near_p_count,
        most_solids,
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
        slack,
        solid_kinds,
        solid_numbers,
        solids,
        shape_numbers,
        shape_dims,
        distances,
        touching,
        pushes,
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
    if solid_count > 0:
        gather_pushes(
            world_count,
            near_p_count,
            most_solids,
            near_p,
            p_field,
            field_integers,
            world_integers,
            control,
            pushes,
            impulses,
            touching,
        )


@functools.cache
def advance_matter_of(laws: int) -> Kernel:
    """The kernel of particles for the set ``laws`` of constitutive laws; one is compiled for each set."""

    @ti.kernel
    def advance_matter(
        world_count: ti.i32,
        p_blocks: ti.i32,
        cfl_elastic: ti.f64,
        cfl_velocity: ti.f64,
        p_cells: Cells,
        p_field: Integers,
        starts: Integers,
        p_neighbours: Integers,
        near: Integers,
        world_integers: Integers,
        worlds: Scalars,
        field_integers: Integers,
        fields: Scalars,
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
        anchors: Vectors4,
        window: Vectors4,
        scattered: Vectors4,
        nodes: Vectors4,
        slopes: Vectors3,
        past_window: Vectors4,
        past_scattered: Vectors4,
        past_nodes: Vectors4,
        report: Scalars,
        running: Integers,
        solid_kinds: Integers,
        solid_numbers: Doubles,
        solids: Doubles,
    ):
        """Particles over STEP, then onto the grid; plans what comes next. running[0]: how many worlds go on."""
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
            slopes,
            past_window,
            past_nodes,
            past_scattered,
            report,
        )
        running[0] = review(
            world_count,
            p_blocks,
            cfl_elastic,
            cfl_velocity,
            p_field,
            field_integers,
            report,
            control,
            world_integers,
            solid_kinds,
            solid_numbers,
            solids,
        )

    return advance_matter
