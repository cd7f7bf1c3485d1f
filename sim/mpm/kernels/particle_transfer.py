# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Particle-grid transfers of a substep.

MLS-MPM (Hu et al. 2018), APIC (Jiang et al. 2015) with second derivatives for solids (PolyPIC, Fu et al. 2017) and kept
velocities for grains and fluids (Fei et al. 2021), quadratic B-splines; lengths in cells (see ``layout``), seconds,
kilograms. A substep is

    advance_nodes      gather the windows, momentum -> velocity, forces: ``grid``
    contact            of deformable bodies: ``deformable_contact``; with plane, bodies, colliders: ``particle_contact``
    advance_particles  grid -> particles -> grid in one pass over the particles, on the CPU without atomics:
                       ``whole_transfer``, and for a block on the CPU ``advance_block`` here
"""

import taichi as ti

from .constitutive_response import deform, is_fluid, law_of, respond
from .constitutive_response import flows as material_flows
from .crowding import STIFFNESS, load_crowding, part_crowd, relaxed
from .interpolation import columns, interpolate, interpolate_curved, spread, spread_kept
from .kernel_arrays import FlowArrays, NearBlocks, NodeArrays, ParticleArrays, ParticleBlocks, WorldArrays
from .kernel_bundles import func
from .lanes import lane_maxima, lane_sum, meet
from .layout import (
    CONTROL_ROW,
    ELAPSED,
    FAR,
    FIELD_INTEGERS,
    FIELD_ROW,
    FIXED_HIGH,
    FIXED_LOW,
    FIXED_ONE,
    FULL,
    FULL_MASS,
    GOAL_DAMPING,
    GOAL_STIFFNESS,
    HAS_ANCHORS,
    HAS_PLANE,
    IDLE,
    MOTION,
    MOTION_RATE,
    NEXT_STEP,
    PHASE,
    PLANE_ADHESION,
    PLANE_GAP,
    PLANE_NORMAL,
    PLANE_OFFSET,
    SCALARS_PER_BLOCK,
    SCATTER,
    SOUND_SPEED_SQUARED,
    STEP,
    STORE,
    SUBSTEPS,
    SUNK_LIMIT,
    WINDOW_NODES,
    WORLD,
    WORLD_ROW,
    ivec3,
    mat3,
    triple,
    vec3,
    vec4,
)
from .windows import clear_window, fetch_window, first_of, in_cells, load_window, store_window

PIN, GOAL = 1.0, 2.0
"""Types of anchors."""

KEPT = 0.9
"""Share of the velocity and spin that the grid cannot carry which a particle of granular or fluid material keeps per
substep (Fei et al. 2021). The transfers then damp a tenth of what they damp without; 1 would keep all noise."""

LEVELLED = 0.02
"""Share of the part of a fluid particle's ln J that the grid cannot carry which is removed per substep: pressures that
cancel on the nodes, so that they cause no force, vanish within some 50 substeps."""


@ti.func
def moment_at_surface(a: vec3, radius: ti.f32):
    """First moment about a particle (cells²/s²) of its contact acceleration ``a`` (cells/s²), which acts not at the
    particle but at its body's surface, ``radius`` cells away. It lies along ``a``, so it has no torque.

    A fluid's layer next to a surface bears the pressure on its whole depth. Pushed at its particles, it would be
    squeezed on the inner half alone, hence have half the pressure, along the surface as well: no rest."""
    return (-radius / ti.max(a.norm(), 1e-9)) * a.outer_product(a)


@func
def anchor_place(f: ti.i32, time: ti.f32, place: vec4, worlds: WorldArrays):
    """Where the anchor at rest at ``place`` is ``time`` s into the segment (cells), and its velocity."""
    row = f * FIELD_ROW
    motion, rate = vec3(0.0), vec3(0.0)
    for n in ti.static(range(3)):
        rate[n] = worlds.field_numbers[row + MOTION_RATE + n]
        motion[n] = worlds.field_numbers[row + MOTION + n] + time * rate[n]
    return vec3(place[0], place[1], place[2]) + motion, rate


@func
def goal_step(
    f: ti.i32,
    c: ti.i32,
    p: ti.i32,
    dt: ti.f32,
    first_node: vec3,
    xi: ivec3,
    v: vec3,
    stiffness: ti.f32,
    worlds: WorldArrays,
    particles: ParticleArrays,
):
    """Change of velocity over ``dt`` by the spring and damper between particle ``p`` and its goal."""
    change = vec3(0.0)
    if particles.anchors[p][3] == GOAL:
        time = ti.cast(worlds.control[c + ELAPSED], ti.f32)
        if worlds.control[c + PHASE] == FULL:
            time += ti.cast(worlds.control[c + STEP], ti.f32)
        target, velocity = anchor_place(f, time, particles.anchors[p], worlds)
        here = first_node + in_cells(xi)
        change = dt * (
            stiffness * (target - here) + worlds.field_numbers[f * FIELD_ROW + GOAL_DAMPING] * (velocity - v)
        )
    return change


@ti.func
def scatter_past(
    first: ti.i32, fx: vec3, mass4: vec4, V: vec4, K0: vec4, K1: vec4, K2: vec4, past_scattered: ti.template()
):
    """Momentum without any force, and mass times ln J, the fourth number of ``V`` and of its slopes ``K0`` to ``K2``,
    to the window."""
    b4 = mass4 * (V - fx[0] * K0 - fx[1] * K1 - fx[2] * K2)
    spread(first, fx, b4, mass4 * K0, mass4 * K1, mass4 * K2, past_scattered)


@func
def advance_block(
    laws: ti.template(),
    lanes: ti.template(),
    pads: ti.template(),
    lane: ti.i32,
    k: ti.i32,
    spot: ti.i32,
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    near: NearBlocks,
    particles: ParticleArrays,
    flow: FlowArrays,
    nodes: NodeArrays,
):
    """``advance_particles`` of block ``k``, whose windows to read begin at ``spot`` of their arrays.

    ``whole_transfer.advance_block_in_whole_numbers`` does the same on a card; what is changed here belongs there, too.
    """
    offset = 0 if ti.static(lanes.shared) else k * WINDOW_NODES
    crowd_spot = k * WINDOW_NODES if ti.static(lanes.shared) else spot
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
    crowds = worlds.field_numbers[f * FIELD_ROW + FULL_MASS] > 0.0
    sound2 = worlds.field_numbers[f * FIELD_ROW + SOUND_SPEED_SQUARED]
    if gather:
        if ti.static(lanes.parallel):
            fetch_window(lanes, lane, k, spot, blocks.neighbours, nodes.velocity, pads.window)
        else:
            load_window(k, spot, blocks.neighbours, nodes.window, nodes.velocity)
        if ti.static(laws.flowing):
            if flows:
                if ti.static(lanes.parallel):
                    fetch_window(lanes, lane, k, spot, blocks.neighbours, flow.velocity, pads.past_window)
                else:
                    load_window(k, spot, blocks.neighbours, flow.window, flow.velocity)
        if ti.static(len(laws.volumetric) > 0):
            if crowds:
                load_crowding(lanes, lane, k, crowd_spot, blocks.neighbours, flow.crowding_window, flow.crowding)
    if scatter:
        clear_window(lanes, lane, offset, pads.scattered)
        if ti.static(laws.flowing):
            if flows:
                clear_window(lanes, lane, offset, pads.past_scattered)
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
    first_p, last_p = blocks.starts[k], blocks.starts[k + 1]
    if phase == IDLE:
        last_p = first_p
    p = first_p + lane
    while p < last_p:
        xi = particles.x[p]
        fixed = particles.constants[p]
        vp = vec3(0.0)
        Cp = mat3(0.0)
        # Velocity and the columns of its gradient once more, four numbers each.
        V, K0, K1, K2 = vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0)
        Fp = particles.F[p]
        slope = vec3(0.0)
        packing = 0.0
        E01, E02, E12 = vec4(0.0), vec4(0.0), vec4(0.0)
        D0, D1, D2 = vec4(0.0), vec4(0.0), vec4(0.0)
        if ti.static(len(laws.volumetric) > 0):
            packing = particles.memory[p]
        if gather:
            gp = in_cells(xi)
            base = ti.cast(gp - 0.5, ti.i32)
            fx = gp - ti.cast(base, ti.f32)
            first = spot + first_of(base, pads.window)
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
            V, K0, K1, K2 = A, 4.0 * B0, 4.0 * B1, 4.0 * B2
            for r in ti.static(range(3)):
                vp[r] = A[r]
                Cp[r, 0] = K0[r]
                Cp[r, 1] = K1[r]
                Cp[r, 2] = K2[r]
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
                    V = vec4(vp[0], vp[1], vp[2], 0.0)
                    K0 += vec4(0.0, -a01, -a02, 0.0)
                    K1 += vec4(a01, 0.0, -a12, 0.0)
                    K2 += vec4(a02, a12, 0.0, 0.0)
                    if ti.static(len(laws.volumetric) > 0):
                        if crowds and scatter:
                            strength = dt_gather * STIFFNESS * sound2 * fixed[0]
                            known = crowd_spot + base[0] * 64 + base[1] * 8 + base[2]
                            crowding, given = part_crowd(
                                known, first - spot + offset, fx, strength, flow.crowding_window, pads.scattered
                            )
                            vp += given / fixed[0]
                            V = vec4(vp[0], vp[1], vp[2], 0.0)
                            particles.memory[p] = relaxed(particles.memory[p], crowding)
                    particles.v[p] = vp
                    particles.C[p] = Cp
                    if ti.static(len(laws.volumetric) > 0):
                        if is_fluid(law):
                            particles.memory[p] -= LEVELLED * (packing - past[3])
                            slope = 4.0 * vec3(past0[3], past1[3], past2[3])
                            if store:
                                particles.slopes[p] = slope
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
            xi = ti.min(ti.max(xi + ti.floor(step * FIXED_ONE + 0.5, ti.i32), FIXED_LOW), FIXED_HIGH)
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
            V = vec4(vp[0], vp[1], vp[2], 0.0)
            K0, K1, K2 = columns(Cp)
            if ti.static(len(laws.volumetric) > 0):
                slope = particles.slopes[p]
        if adheres:
            here = in_cells(xi)
            gap = ti.min(gap, level + normal.dot(here) - fixed[3])
        if scatter:
            own_V = V  # before any force
            if goal > 0.0:
                pull = goal_step(f, c, p, dt_scatter, first_node, xi, vp, goal, worlds, particles)
                V += vec4(pull[0], pull[1], pull[2], 0.0)
            mass = fixed[0]
            tau = mat3(0.0)
            modulus = 0.0
            if ti.static(laws.only_elastic):
                tau, modulus, _ = laws.solid[0].stress(Fp, Cp, 0.0, fixed[1], fixed[2], fixed)
            else:
                tau, modulus = respond(laws, p, Fp, Cp, fixed, worlds, particles)
            stiffness = ti.max(stiffness, modulus / mass)
            # Zero, which the compiler cannot know: it works on four numbers at once only if it does the same with all.
            nought = ti.min(mass, 0.0)
            mass4 = vec4(mass, mass, mass, nought)
            part = -4.0 * dt_scatter
            tau0, tau1, tau2 = columns(tau)
            c0, c1, c2 = part * tau0 + mass4 * K0, part * tau1 + mass4 * K1, part * tau2 + mass4 * K2
            gp = in_cells(xi)
            base = ti.cast(gp - 0.5, ti.i32)
            fx = gp - ti.cast(base, ti.f32)
            first = offset + first_of(base, pads.scattered)
            if touching:
                # Start the contact solve from the forces of the last substep.
                a = particles.reaction[p]
                V += dt_scatter * a
                if ti.static(len(laws.volumetric) > 0):
                    if is_fluid(law):
                        M0, M1, M2 = columns(moment_at_surface(vec3(a[0], a[1], a[2]), fixed[3]))
                        pressed = 4.0 * dt_scatter * mass
                        c0, c1, c2 = c0 + pressed * M0, c1 + pressed * M1, c2 + pressed * M2
            b4 = mass4 * V + vec4(nought, nought, nought, mass) - fx[0] * c0 - fx[1] * c1 - fx[2] * c2
            if ti.static(not laws.flowing):
                spread_kept(first, fx, mass, b4, c0, c1, c2, E01, E02, E12, D0, D1, D2, pads.scattered)
            elif ti.static(laws.only_flowing):
                spread(first, fx, b4, c0, c1, c2, pads.scattered)
            else:
                if flows:
                    spread(first, fx, b4, c0, c1, c2, pads.scattered)
                else:
                    spread_kept(first, fx, mass, b4, c0, c1, c2, E01, E02, E12, D0, D1, D2, pads.scattered)
            if ti.static(laws.flowing):
                if flows:
                    if ti.static(len(laws.volumetric) > 0):
                        if is_fluid(law):
                            own_V[3], K0[3], K1[3], K2[3] = particles.memory[p], slope[0], slope[1], slope[2]
                            mass4[3] = mass
                    scatter_past(first, fx, mass4, own_V, K0, K1, K2, pads.past_scattered)
        p += ti.static(lanes.threads)
    meet(lanes)
    if scatter:
        store_window(lanes, lane, k, pads.scattered, nodes.scattered)
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
