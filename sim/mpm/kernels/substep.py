# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""One substep of all worlds, as the kernels that ``engine`` launches in sequence:

    advance_grid      nodes over STEP: velocities, forces
    part_bodies       contact between deformable bodies that are near each other
    crowd_fluids      crowding of fluids at the nodes
    part_particles    contact between particles of deformable bodies that are in each other
    resolve_contact   contact with plane, rigid bodies, colliders and pins; impulses on rigid bodies
    (rigid)           motion of rigid bodies: ``rigid_motion.rigid_substep``
    advance_matter    grid to particles over STEP, particles to grid with the stress of NEXT_STEP, the next plan

Every world is in the phase that ``control`` says and takes its own step. The compiler takes more than twice as long for
a kernel of twice the length, so there are several.
"""

import functools

import taichi as ti

from ..rigid.rigid_motion import predict, rigid_substep
from .adhesion import sum_reached
from .collider_distance import gather_pushes, gather_pushes_in_parallel
from .constitutive_response import law_set
from .crowding import add_pushes, find_crowding, push_fields
from .deformable_contact import gather_shares, scatter_shares, separate
from .fluid_room import leave_room, measure_fill
from .grid import advance_nodes, advance_nodes_in_parallel, gather_means
from .kernel_arrays import (
    AdhesionArrays,
    BlockTable,
    CouplingArrays,
    FlowArrays,
    GridBlocks,
    NearBlocks,
    NodeArrays,
    OverlapBlocks,
    ParticleArrays,
    ParticleBlocks,
    RigidArrays,
    ShapeArrays,
    StepLimits,
    WorldArrays,
)
from .kernel_bundles import BundledKernel, Launcher, kernel, merged
from .lanes import Lanes
from .layout import CONTROL_ROW, FULL, PHASE, STEP, Integers
from .particle_contact import apply_contact, solve_contact
from .particle_pairs import list_pairs, part_pairs, sum_others
from .time_stepping import forget_reports, review, review_in_parallel, settle
from .whole_transfer import advance_particles


@functools.cache
def advance_grid_of(flowing: bool, lanes: Lanes, means: bool) -> BundledKernel:
    """Kernel of grid nodes; ``flowing``: some materials are granular or fluid; ``means``: some fields' means are
    wanted."""

    @kernel
    def advance_grid(worlds: WorldArrays, grid: GridBlocks, nodes: NodeArrays, flow: FlowArrays):
        """Nodes over STEP; ``mean_fields`` is 0 where no body's means are wanted."""
        if ti.static(lanes.parallel):
            advance_nodes_in_parallel(flowing, means, lanes, worlds, grid, nodes, flow)
        else:
            advance_nodes(flowing, worlds, grid, nodes, flow)
        if ti.static(means or not lanes.parallel):
            gather_means(worlds, grid, nodes)

    return advance_grid


@functools.cache
def part_bodies_of(laws: int, lanes: Lanes, thin: bool, adheres: bool) -> BundledKernel:
    """Kernel of contact between deformable bodies for the set ``laws`` of constitutive models; ``thin``: some are thin
    all over; ``adheres``: some adhere to others."""
    models = law_set(laws)

    @kernel
    def part_bodies(
        worlds: WorldArrays,
        blocks: ParticleBlocks,
        grid: GridBlocks,
        overlap: OverlapBlocks,
        particles: ParticleArrays,
        nodes: NodeArrays,
        flow: FlowArrays,
        adhesion: AdhesionArrays,
    ):
        """Impulses between coinciding nodes of different bodies."""
        scatter_shares(models, lanes, worlds, blocks, overlap, particles, nodes)
        gather_shares(lanes, worlds, grid, overlap, nodes)
        if ti.static(len(models.volumetric) > 0):
            leave_room(worlds, grid, overlap, nodes, flow)
        separate(thin, adheres, lanes, worlds, grid, overlap, nodes, adhesion)

    return part_bodies


@functools.cache
def crowd_fluids_of(meeting: bool) -> BundledKernel:
    """Kernel of the crowding of fluids; ``meeting``: some fields overlap."""

    @kernel
    def crowd_fluids(
        worlds: WorldArrays,
        grid: GridBlocks,
        overlap: OverlapBlocks,
        nodes: NodeArrays,
        flow: FlowArrays,
        bodies: RigidArrays,
        shapes: ShapeArrays,
        coupling: CouplingArrays,
    ):
        """Crowding at the nodes, and what it does to the bodies around, before contact."""
        measure_fill(meeting, worlds, grid, overlap, nodes, flow, bodies, shapes, coupling)
        find_crowding(meeting, worlds, grid, overlap, nodes, flow, bodies, shapes, coupling)
        if ti.static(meeting):
            push_fields(worlds, grid, overlap, nodes, flow)

    return crowd_fluids


@functools.cache
def part_particles_of(lanes: Lanes, thin: bool) -> BundledKernel:
    """Kernel of contact between particles of deformable bodies; ``thin``: some bodies are thin all over."""

    @kernel
    def part_particles(
        worlds: WorldArrays,
        blocks: ParticleBlocks,
        grid: GridBlocks,
        overlap: OverlapBlocks,
        particles: ParticleArrays,
        nodes: NodeArrays,
        table: BlockTable,
    ):
        """Impulses between particles of different bodies that are too near, from the shares that are in ``sums``."""
        sum_others(worlds, grid, overlap, nodes)
        list_pairs(thin, lanes, worlds, blocks, overlap, particles, nodes, table)
        part_pairs(lanes, worlds, blocks, overlap, particles, nodes)

    return part_particles


@kernel
def plan_bodies(worlds: WorldArrays, bodies: RigidArrays):
    """Write the worlds' steps for the rigid kernels, 0 for idle worlds, and predict each rigid body's velocity."""
    ti.loop_config(serialize=True)
    for w in range(worlds.count):
        bodies.steps[w] = 0.0
        if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
            bodies.steps[w] = worlds.control[w * CONTROL_ROW + STEP]
            predict(w, bodies.steps[w], bodies)


@functools.cache
def resolve_contact_of(lanes: Lanes, pushed: bool, fluid: bool, adheres: bool) -> BundledKernel:
    """Kernel of contact with what is no deformable body; ``pushed``: there are rigid bodies or colliders; ``fluid``:
    there are fluids, whose crowding pushes rigid bodies, too; ``adheres``: some matter adheres to those."""

    @kernel
    def resolve_contact(
        worlds: WorldArrays,
        blocks: ParticleBlocks,
        grid: GridBlocks,
        near: NearBlocks,
        particles: ParticleArrays,
        nodes: NodeArrays,
        flow: FlowArrays,
        bodies: RigidArrays,
        shapes: ShapeArrays,
        coupling: CouplingArrays,
        adhesion: AdhesionArrays,
    ):
        """Contact impulses between particles and plane, rigid bodies, colliders and pins."""
        if ti.static(adheres):
            sum_reached(worlds, blocks, near, particles, bodies, shapes, adhesion)
        # The serial kernel finds by itself that there are none.
        any_bodies = ti.static(pushed or not lanes.parallel)
        solve_contact(
            lanes, any_bodies, adheres, worlds, blocks, near, particles, nodes, bodies, shapes, coupling, adhesion
        )
        apply_contact(lanes, worlds, grid, near, nodes)
        if ti.static(lanes.parallel and pushed):
            gather_pushes_in_parallel(worlds, blocks, near, bodies, coupling)
        elif ti.static(lanes.parallel):
            pass
        elif coupling.body_count > 0:
            gather_pushes(worlds, blocks, near, bodies, coupling)
        if ti.static(fluid):
            add_pushes(worlds, grid, flow, bodies, coupling)

    return resolve_contact


@functools.cache
def advance_matter_of(laws: int, lanes: Lanes, pushed: bool = True) -> BundledKernel:
    """Kernel of particles for the set ``laws`` of constitutive models; one is compiled for each set. pushed: there are
    rigid bodies or colliders."""
    models = law_set(laws)

    @kernel
    def advance_matter(
        running: Integers,
        limits: StepLimits,
        worlds: WorldArrays,
        blocks: ParticleBlocks,
        near: NearBlocks,
        particles: ParticleArrays,
        nodes: NodeArrays,
        flow: FlowArrays,
        bodies: RigidArrays,
    ):
        """Particles over STEP, then onto the grid; plans the next substep. running: [0] how many worlds continue, of
        many threads [w] whether world w does."""
        advance_particles(models, lanes, worlds, blocks, near, particles, nodes, flow)
        if ti.static(lanes.parallel):
            review_in_parallel(lanes, pushed, running, limits, worlds, blocks, bodies)
        else:
            running[0] = review(limits, worlds, blocks, bodies)

    return advance_matter


REPEATS, RIGID_REPEATS = 4, 32
"""Substeps in a launch, with and without particles; worlds that need fewer stay idle for the rest."""


@functools.lru_cache(maxsize=32)
def substep_launcher(
    generation: int,
    laws: int,
    lanes: Lanes,
    means: bool,
    overlap: bool,
    thin: bool,
    adheres: bool,
    bodies: bool,
    together: bool,
    near: bool,
) -> Launcher:
    """Launcher of a substep for worlds of these ``laws``, with the kernels that they need.

    generation: of the compute runtime; a launcher ends with it. means: some fields' means are wanted; overlap: several
    fields overlap; thin: some are thin all over; adheres: some adhere to others, to rigid bodies or to colliders;
    bodies: there are rigid bodies or colliders; together: contacts of some worlds may be solved at once; near: some
    particles are near the plane, a body or a collider, or are held.
    """
    # The serial kernels leave out by themselves what is not there; compiling them twice would cost more.
    kernels = [advance_grid_of(law_set(laws).flowing, lanes, means and lanes.parallel)]
    if overlap:
        kernels.append(part_bodies_of(laws, lanes, thin, adheres))
    fluid = bool(law_set(laws).volumetric)
    if fluid:
        kernels.append(crowd_fluids_of(overlap))
    if overlap:
        kernels.append(part_particles_of(lanes, thin))
    if bodies:
        kernels.append(plan_bodies)
    if near:
        kernels.append(resolve_contact_of(lanes, bodies and lanes.parallel, fluid, adheres and bodies))
    if bodies:
        kernels += rigid_substep(together=together)
    kernels.append(advance_matter_of(laws, lanes, bodies or not lanes.parallel))
    if lanes.parallel:
        # A launch for each kernel of the rigid bodies' is dear, too, but the compiler takes too long for one of all.
        kernels = [each.lean() for each in ([merged(kernels)] if not bodies else kernels)]
    return Launcher(kernels, repeats=REPEATS)


@kernel
def review_bodies(running: Integers, limits: StepLimits, worlds: WorldArrays, bodies: RigidArrays):
    """``review`` of worlds that hold no particles."""
    going_on = 0
    ti.loop_config(serialize=True)
    for w in range(worlds.count):
        forget_reports(True, w, worlds, bodies)
        going_on += settle(w, limits, worlds)
    running[0] = going_on


@functools.lru_cache(maxsize=32)
def rigid_launcher(generation: int) -> Launcher:
    """Launcher of substeps for worlds that hold no particles, some of which may solve all contacts at once."""
    return Launcher([plan_bodies, *rigid_substep(together=True), review_bodies], repeats=RIGID_REPEATS)
