# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""One substep as one kernel: a launch costs about 0.1 ms of Python, as much as the work on a thousand particles."""

import taichi as ti

from .contact import apply_contact, solve_contact
from .layout import SCALARS_PER_BLOCK, Cells, Integers, Matrices, Scalars, Vectors3, Vectors4, vec3
from .transfer import advance_nodes, advance_particles


@ti.func
def advance(
    laws: ti.template(),
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    ground_p_count: ti.i32,
    ground_g_count: ti.i32,
    grid: ti.i32,
    gather: ti.i32,
    scatter: ti.i32,
    store: ti.i32,
    dt: ti.f32,
    dt_next: ti.f32,
    reach: ti.f32,
    settings: Scalars,
    p_cells: Cells,
    g_cells: Cells,
    starts: Integers,
    p_neighbours: Integers,
    g_neighbours: Integers,
    near_ground: Integers,
    ground_p: Integers,
    ground_g: Integers,
    x: Cells,
    v: Vectors3,
    C: Matrices,
    F: Matrices,
    constants: Vectors4,
    material: Integers,
    table: Scalars,
    memory: Scalars,
    reaction: Vectors4,
    window: Vectors4,
    scattered: Vectors4,
    nodes: Vectors4,
    sums: Vectors4,
    masses: Scalars,
    report: Scalars,
):
    """Nodes, contact and particles: the body of both kernels."""
    gravity = vec3(settings[0], settings[1], settings[2])
    normal = vec3(settings[3], settings[4], settings[5])
    offset, friction, recovery = settings[6], settings[7], settings[8]
    advance_nodes(g_blocks, grid, dt * gravity, g_cells, g_neighbours, scattered, nodes, masses)
    solve_contact(
        ground_p_count,
        dt,
        reach,
        recovery,
        friction,
        normal,
        offset,
        ground_p,
        p_cells,
        starts,
        p_neighbours,
        x,
        constants,
        reaction,
        window,
        nodes,
        scattered,
    )
    apply_contact(ground_g_count, ground_g, g_neighbours, near_ground, scattered, nodes, masses, sums)
    advance_particles(
        laws,
        p_blocks,
        gather,
        scatter,
        store,
        dt,
        dt_next,
        normal,
        offset,
        p_cells,
        starts,
        p_neighbours,
        near_ground,
        x,
        v,
        C,
        F,
        constants,
        material,
        table,
        memory,
        reaction,
        window,
        nodes,
        scattered,
        report,
    )


@ti.func
def worst(p_blocks: ti.i32, report: Scalars):
    """The blocks' reports in one."""
    total = ti.Vector([0.0, 0.0, 1e9, 1e9, 0.0])
    ti.loop_config(serialize=True)
    for k in range(p_blocks):
        r = k * SCALARS_PER_BLOCK
        total[0] = ti.max(total[0], report[r])
        total[1] = ti.max(total[1], report[r + 1])
        total[2] = ti.min(total[2], report[r + 2])
        total[3] = ti.min(total[3], report[r + 3])
        total[4] += report[r + 4]
    return total


@ti.kernel
def substep(
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    ground_p_count: ti.i32,
    ground_g_count: ti.i32,
    grid: ti.i32,
    gather: ti.i32,
    scatter: ti.i32,
    store: ti.i32,
    dt: ti.f32,
    dt_next: ti.f32,
    reach: ti.f32,
    settings: Scalars,
    p_cells: Cells,
    g_cells: Cells,
    starts: Integers,
    p_neighbours: Integers,
    g_neighbours: Integers,
    near_ground: Integers,
    ground_p: Integers,
    ground_g: Integers,
    x: Cells,
    v: Vectors3,
    C: Matrices,
    F: Matrices,
    constants: Vectors4,
    reaction: Vectors4,
    window: Vectors4,
    scattered: Vectors4,
    nodes: Vectors4,
    sums: Vectors4,
    masses: Scalars,
    report: Scalars,
) -> ti.types.vector(5, ti.f32):
    """Nodes over ``dt``, contact, grid to particles over ``dt``, particles to grid with the stress of ``dt_next``.

    Counts of 0 leave their part out: ``g_blocks`` the nodes, ``ground_p_count`` and ``ground_g_count`` the contact.
    settings: gravity (3, cells/s²), ground normal (3), ground offset (cells), friction, recovery speed (cells/s).
    Returns max |v|² and max c² (cells²/s²), least distance to a window's limits and to the ground (cells), sum |v|².
    """
    # Only fixed-corotated solids: the arrays of the other laws are never read, and any will do in their place.
    advance(
        1,
        p_blocks,
        g_blocks,
        ground_p_count,
        ground_g_count,
        grid,
        gather,
        scatter,
        store,
        dt,
        dt_next,
        reach,
        settings,
        p_cells,
        g_cells,
        starts,
        p_neighbours,
        g_neighbours,
        near_ground,
        ground_p,
        ground_g,
        x,
        v,
        C,
        F,
        constants,
        starts,
        masses,
        masses,
        reaction,
        window,
        scattered,
        nodes,
        sums,
        masses,
        report,
    )
    return worst(p_blocks, report)


@ti.kernel
def substep_of_laws(
    laws: ti.template(),
    p_blocks: ti.i32,
    g_blocks: ti.i32,
    ground_p_count: ti.i32,
    ground_g_count: ti.i32,
    grid: ti.i32,
    gather: ti.i32,
    scatter: ti.i32,
    store: ti.i32,
    dt: ti.f32,
    dt_next: ti.f32,
    reach: ti.f32,
    settings: Scalars,
    p_cells: Cells,
    g_cells: Cells,
    starts: Integers,
    p_neighbours: Integers,
    g_neighbours: Integers,
    near_ground: Integers,
    ground_p: Integers,
    ground_g: Integers,
    x: Cells,
    v: Vectors3,
    C: Matrices,
    F: Matrices,
    constants: Vectors4,
    material: Integers,
    table: Scalars,
    memory: Scalars,
    reaction: Vectors4,
    window: Vectors4,
    scattered: Vectors4,
    nodes: Vectors4,
    sums: Vectors4,
    masses: Scalars,
    report: Scalars,
) -> ti.types.vector(5, ti.f32):
    """``substep`` for any set of constitutive laws; one kernel is compiled for each set that occurs."""
    advance(
        laws,
        p_blocks,
        g_blocks,
        ground_p_count,
        ground_g_count,
        grid,
        gather,
        scatter,
        store,
        dt,
        dt_next,
        reach,
        settings,
        p_cells,
        g_cells,
        starts,
        p_neighbours,
        g_neighbours,
        near_ground,
        ground_p,
        ground_g,
        x,
        v,
        C,
        F,
        constants,
        material,
        table,
        memory,
        reaction,
        window,
        scattered,
        nodes,
        sums,
        masses,
        report,
    )
    return worst(p_blocks, report)
