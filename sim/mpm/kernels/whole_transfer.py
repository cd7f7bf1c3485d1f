# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""The pass over the particles of a substep, and its form for a card's shared memory, which adds whole numbers.

A block counts momentum and mass at nodes in units such that all its particles together cannot exceed MOST_SUM at any: a
particle's largest share is found before it is added (``interpolation.largest_share``). Where more particles than lanes
are in a block, and later ones have larger shares, what has been added is counted anew in larger units. This is a
function of its own because the CPU's bytes depend on the order of ``advance_block``'s statements.
"""

import taichi as ti

from .constitutive_response import deform, law_of, respond
from .constitutive_response import flows as material_flows
from .interpolation import LARGEST_WEIGHT, columns, interpolate, interpolate_curved, largest_share, spread, spread_kept
from .kernel_arrays import FlowArrays, NearBlocks, NodeArrays, ParticleArrays, ParticleBlocks, WorldArrays
from .kernel_bundles import func
from .lanes import lane_maxima, lane_sum, meet, pads_of
from .layout import (
    CONTROL_ROW,
    FAR,
    FIELD_INTEGERS,
    FIELD_ROW,
    FIXED_HIGH,
    FIXED_LOW,
    FIXED_ONE,
    FULL,
    GOAL_STIFFNESS,
    HAS_ANCHORS,
    HAS_PLANE,
    IDLE,
    NEXT_STEP,
    PHASE,
    PLANE_ADHESION,
    PLANE_GAP,
    PLANE_NORMAL,
    PLANE_OFFSET,
    SCALARS_PER_BLOCK,
    SCATTER,
    STEP,
    STORE,
    SUBSTEPS,
    SUNK_LIMIT,
    WINDOW_NODES,
    WORLD,
    WORLD_ROW,
    mat3,
    triple,
    vec3,
    vec4,
)
from .particle_transfer import KEPT, advance_block, goal_step, scatter_past
from .windows import (
    LEAST_LARGEST,
    MOST_SUM,
    clear_window,
    fetch_window,
    first_of,
    in_cells,
    scale_window,
    store_window,
    turns,
)


@func
def add_particle(
    laws: ti.template(),
    flows: ti.i32,
    first: ti.i32,
    fx: vec3,
    mass: ti.f32,
    weight: ti.f32,
    units: vec4,
    vp: vec3,
    Q: mat3,
    E01: vec4,
    E02: vec4,
    E12: vec4,
    D0: vec4,
    D1: vec4,
    D2: vec4,
    own_v: vec3,
    Cp: mat3,
    pads: ti.template(),
):
    """A particle to the nodes of its block's windows, of whole numbers counted in 1 / ``units``; weight: its mass
    times the first of these."""
    q = mass * vp - Q @ fx
    b4 = vec4(q[0], q[1], q[2], mass)
    c0, c1, c2 = columns(Q)
    b4, c0, c1, c2 = b4 * units, c0 * units, c1 * units, c2 * units
    if ti.static(not laws.flowing):
        spread_kept(first, fx, weight, b4, c0, c1, c2, E01, E02, E12, D0, D1, D2, pads.scattered)
    elif ti.static(laws.only_flowing):
        spread(first, fx, b4, c0, c1, c2, pads.scattered)
    else:
        if flows:
            spread(first, fx, b4, c0, c1, c2, pads.scattered)
        else:
            spread_kept(first, fx, weight, b4, c0, c1, c2, E01, E02, E12, D0, D1, D2, pads.scattered)
    if ti.static(laws.flowing):
        if flows:
            V = vec4(own_v[0], own_v[1], own_v[2], 0.0)
            K0, K1, K2 = columns(Cp)
            scatter_past(first, fx, vec4(mass), V, K0, K1, K2, pads.past_scattered)


@func
def advance_block_in_whole_numbers(
    laws: ti.template(),
    lanes: ti.template(),
    pads: ti.template(),
    lane: ti.i32,
    k: ti.i32,
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    near: NearBlocks,
    particles: ParticleArrays,
    flow: FlowArrays,
    nodes: NodeArrays,
):
    """``particle_transfer.advance_block`` on a card, without fluids: what is changed there belongs here, too.

    All lanes go through the loop over the particles as often, because they find the largest share together.
    """
    f = blocks.field[k]
    world = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
    c = world * CONTROL_ROW
    phase = worlds.control[c + PHASE]
    gather = phase == FULL
    scatter = phase != IDLE and worlds.control[c + SCATTER] == 1.0
    store = worlds.control[c + STORE] == 1.0
    dt_gather = ti.cast(worlds.control[c + STEP], ti.f32)
    dt_scatter = ti.cast(worlds.control[c + NEXT_STEP], ti.f32)
    flows = False
    law = 0
    if ti.static(laws.flowing):
        law = law_of(blocks.starts[k], worlds, particles)
        flows = material_flows(law)
    if gather:
        fetch_window(lanes, lane, k, 0, blocks.neighbours, nodes.velocity, pads.window)
        if ti.static(laws.flowing):
            if flows:
                fetch_window(lanes, lane, k, 0, blocks.neighbours, flow.velocity, pads.past_window)
    if scatter:
        clear_window(lanes, lane, 0, pads.scattered)
        if ti.static(laws.flowing):
            if flows:
                clear_window(lanes, lane, 0, pads.past_scattered)
    meet(lanes)
    touching = near.slot[k] >= 0
    on_plane = touching and worlds.numbers[world * WORLD_ROW + HAS_PLANE] > 0.5
    normal = triple(worlds.numbers, world * WORLD_ROW + PLANE_NORMAL)
    first_node = ti.cast(blocks.cells[k] * 4 - 1, ti.f32)
    level = normal.dot(first_node) - worlds.numbers[world * WORLD_ROW + PLANE_OFFSET]
    goal = 0.0
    if worlds.field_integers[f * FIELD_INTEGERS + HAS_ANCHORS] == 1:
        goal = worlds.field_numbers[f * FIELD_ROW + GOAL_STIFFNESS]
    adheres = worlds.field_numbers[f * FIELD_ROW + PLANE_ADHESION] > 0.0
    gap = FAR
    speed2 = 0.0
    stiffness = 0.0
    sum2 = 0.0
    lowest = FIXED_HIGH
    highest = FIXED_LOW
    # As a float, FIXED_HIGH itself lies in the cell beyond.
    farthest = FIXED_HIGH - 128
    first_p, last_p = blocks.starts[k], blocks.starts[k + 1]
    if phase == IDLE:
        last_p = first_p
    # Most that a particle adds to a node, of momentum on an axis and of mass; whole numbers in 1 of these.
    largest = vec4(LEAST_LARGEST)
    units = vec4(1.0)
    turn = first_p
    while turn < last_p:
        p = turn + lane
        vp, own_v, fx = vec3(0.0), vec3(0.0), vec3(0.0)
        Cp, Q = mat3(0.0), mat3(0.0)
        mass = 0.0
        E01, E02, E12 = vec4(0.0), vec4(0.0), vec4(0.0)
        D0, D1, D2 = vec4(0.0), vec4(0.0), vec4(0.0)
        first = 0
        if p < last_p:
            xi = particles.x[p]
            fixed = particles.constants[p]
            mass = fixed[0]
            Fp = particles.F[p]
            if gather:
                gp = in_cells(xi)
                base = ti.cast(gp - 0.5, ti.i32)
                fx = gp - ti.cast(base, ti.f32)
                first = first_of(base, pads.window)
                A, B0, B1, B2 = vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0)
                if ti.static(not laws.flowing):
                    A, B0, B1, B2, E01, E02, E12, D0, D1, D2 = interpolate_curved(first, fx, pads.window)
                elif ti.static(laws.only_flowing):
                    A, B0, B1, B2 = interpolate(first, fx, pads.window)
                else:
                    if flows:
                        A, B0, B1, B2 = interpolate(first, fx, pads.window)
                    else:
                        A, B0, B1, B2, E01, E02, E12, D0, D1, D2 = interpolate_curved(first, fx, pads.window)
                for r in ti.static(range(3)):
                    vp[r] = A[r]
                    Cp[r, 0] = 4.0 * B0[r]
                    Cp[r, 1] = 4.0 * B1[r]
                    Cp[r, 2] = 4.0 * B2[r]
                if ti.static(laws.only_elastic):
                    Fp += dt_gather * Cp @ Fp
                else:
                    Fp = deform(laws, p, dt_gather, Cp, worlds, particles)
                particles.F[p] = Fp
                step = vp * dt_gather
                if ti.static(laws.flowing):
                    if flows:
                        speed2 = ti.max(speed2, vp.dot(vp))
                        # Part of the particle's velocity that the grid, before the forces, does not carry.
                        past, past0, past1, past2 = interpolate(first, fx, pads.past_window)
                        vp += KEPT * (particles.v[p] - vec3(past[0], past[1], past[2]))
                        # Only the spin of C: angular momentum needs it, and no stress feels it.
                        kept = particles.C[p]
                        a01 = 0.5 * KEPT * ((kept[0, 1] - 4.0 * past1[0]) - (kept[1, 0] - 4.0 * past0[1]))
                        a02 = 0.5 * KEPT * ((kept[0, 2] - 4.0 * past2[0]) - (kept[2, 0] - 4.0 * past0[2]))
                        a12 = 0.5 * KEPT * ((kept[1, 2] - 4.0 * past2[1]) - (kept[2, 1] - 4.0 * past1[2]))
                        Cp += mat3([[0.0, a01, a02], [-a01, 0.0, a12], [-a02, -a12, 0.0]])
                        particles.v[p] = vp
                        particles.C[p] = Cp
                if touching:
                    if on_plane:
                        phi = level + normal.dot(gp) - fixed[3]
                        floor = ti.min(phi, -worlds.field_numbers[f * FIELD_ROW + SUNK_LIMIT])
                        moved = phi + normal.dot(step)
                        if moved < floor:
                            step += (floor - moved) * normal
                    old = particles.reaction[p]
                    particles.reaction[p] = vec4(old[0], old[1], old[2], A[3])
                # Never outside the window, whatever the velocity: this is what keeps memory safe.
                xi = ti.min(ti.max(xi + ti.floor(step * FIXED_ONE + 0.5, ti.i32), FIXED_LOW), farthest)
                particles.x[p] = xi
                lowest = ti.min(lowest, xi.min())
                highest = ti.max(highest, xi.max())
                here2 = vp.dot(vp)
                sum2 += here2
                speed2 = ti.max(speed2, here2)
                if store:
                    particles.v[p] = vp
                    particles.C[p] = Cp
            else:
                vp = particles.v[p]
                Cp = particles.C[p]
            if adheres:
                here = in_cells(xi)
                gap = ti.min(gap, level + normal.dot(here) - fixed[3])
            if scatter:
                own_v = vp  # before any force
                if goal > 0.0:
                    vp += goal_step(f, c, p, dt_scatter, first_node, xi, vp, goal, worlds, particles)
                tau = mat3(0.0)
                modulus = 0.0
                if ti.static(laws.only_elastic):
                    tau, modulus, _ = laws.solid[0].stress(Fp, Cp, 0.0, fixed[1], fixed[2], fixed)
                else:
                    tau, modulus = respond(laws, p, Fp, Cp, fixed, worlds, particles)
                stiffness = ti.max(stiffness, modulus / mass)
                Q = (-4.0 * dt_scatter) * tau + mass * Cp
                gp = in_cells(xi)
                base = ti.cast(gp - 0.5, ti.i32)
                fx = gp - ti.cast(base, ti.f32)
                first = first_of(base, pads.scattered)
                if touching:
                    # Start the contact solve from the forces of the last substep.
                    a = particles.reaction[p]
                    vp += dt_scatter * vec3(a[0], a[1], a[2])
        if scatter:
            found = vec4(0.0)
            if p < last_p:
                share = largest_share(mass, vp, Q, E01, E02, E12, D0, D1, D2)
                found = vec4(share, share, share, LARGEST_WEIGHT * mass)
            found = lane_maxima(lanes, lane, found, pads)
            if (found > largest).any():
                raised = ti.max(found, largest)
                if turn > first_p:
                    # The lanes before counted in smaller units.
                    scale_window(lanes, lane, largest / raised, pads.scattered)
                    meet(lanes)
                largest = raised
            units = MOST_SUM / (ti.cast(last_p - first_p, ti.f32) * largest)
            if p < last_p:
                weight = mass * units[0]
                add_particle(
                    laws,
                    flows,
                    first,
                    fx,
                    mass,
                    weight,
                    units,
                    vp,
                    Q,
                    E01,
                    E02,
                    E12,
                    D0,
                    D1,
                    D2,
                    own_v,
                    Cp,
                    pads,
                )
        turn += ti.static(lanes.threads)
    meet(lanes)
    if scatter:
        store_window(lanes, lane, k, pads.scattered, nodes.scattered, 1.0 / units)
        if ti.static(laws.flowing):
            if flows:
                store_window(lanes, lane, k, pads.past_scattered, flow.scattered)
    margin = ti.cast(ti.min(lowest - FIXED_LOW, FIXED_HIGH - highest), ti.f32) * (1.0 / FIXED_ONE)
    if ti.static(lanes.shared):
        sum2 = lane_sum(lanes, lane, sum2, pads)
        most = lane_maxima(lanes, lane, vec4(speed2, stiffness, -gap, -margin), pads)
        speed2, stiffness, gap, margin = most[0], most[1], -most[2], -most[3]
    if adheres and phase != IDLE and lane == 0:
        # The next whole substep reads this; the number that the present one has read waits for the one after.
        now = ti.cast(worlds.control[c + SUBSTEPS], ti.i32) & 1
        following = ti.select(gather, 1 - now, now)
        worlds.field_numbers[f * FIELD_ROW + PLANE_GAP + 1 - following] = FAR
        ti.atomic_min(worlds.field_numbers[f * FIELD_ROW + PLANE_GAP + following], gap)
    r = k * SCALARS_PER_BLOCK
    if lane == 0:
        if gather:
            blocks.report[r] = speed2
            blocks.report[r + 2] = margin
            blocks.report[r + 4] = sum2
        if scatter:
            blocks.report[r + 1] = stiffness


@func
def advance_particles(
    laws: ti.template(),
    lanes: ti.template(),
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    near: NearBlocks,
    particles: ParticleArrays,
    nodes: NodeArrays,
    flow: FlowArrays,
):
    """Grid to particles over ``STEP``, then particles to grid with the stress impulse of ``NEXT_STEP``.

    laws: the models that occur, a ``LawSet``; of ``only_elastic`` ones neither ``material`` nor ``memory`` is read.
    lanes: threads that share a block, a ``Lanes``.
    The world's phase leaves the first half out (after a sort), its SCATTER the second (before one); STORE writes ``v``
    and ``C``, which are otherwise recomputed before they are read.

    Granular and fluid materials store ``v`` and ``C`` every substep, to keep what the grid cannot carry. They still
    move with the grid's velocity, so contacts hold as for all materials. Solids carry second derivatives of the
    velocity instead, in registers: they are dropped at a sort, and take no memory.
    """
    if ti.static(lanes.shared):
        ti.loop_config(block_dim=ti.static(lanes.threads))
        for kk in range(ti.static(lanes.groups * lanes.threads)):
            lane = kk % ti.static(lanes.threads)
            # Fluids add to their windows before it is known how much.
            whole = ti.static(lanes.whole and len(laws.volumetric) == 0)
            pads = ti.static(pads_of(lanes, nodes, flow if laws.flowing else None, whole))
            k = kk // ti.static(lanes.threads)
            while k < blocks.count:
                if ti.static(whole):
                    advance_block_in_whole_numbers(
                        laws, lanes, pads, lane, k, worlds, blocks, near, particles, flow, nodes
                    )
                else:
                    advance_block(laws, lanes, pads, lane, k, 0, worlds, blocks, near, particles, flow, nodes)
                k += ti.static(lanes.groups)
    else:
        for kk in range(turns(lanes, blocks.count, nodes.window) * ti.static(lanes.span)):
            lane = kk % ti.static(lanes.span)
            if lane < ti.static(lanes.threads):
                turn, all_turns = kk // ti.static(lanes.span), turns(lanes, blocks.count, nodes.window)
                pads = ti.static(pads_of(lanes, nodes, flow if laws.flowing else None))
                for k in range(turn * blocks.count // all_turns, (turn + 1) * blocks.count // all_turns):
                    spot = turn * WINDOW_NODES
                    advance_block(laws, lanes, pads, lane, k, spot, worlds, blocks, near, particles, flow, nodes)
