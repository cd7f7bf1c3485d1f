# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Coulomb contact of particles with the ground plane, rigid bodies and colliders, and pins; resolved at the particles.

Zeroing the velocity of nodes below a surface stops a body up to a cell too early, because a particle feels nodes 1.5
cells away. Here the unknowns are one contact impulse m_p a_p per particle near a surface, spread to the nodes with the
particle's own weights (so momentum is exact), and the conditions hold at the particles, whose distance to the surface
is known far below a cell; ``contact_law`` has them.

Of the surfaces around a particle the nearest is treated so; the next one only pushes, anew in each substep. A pin is
a surface that holds the particle from all sides.

One projected Jacobi sweep a substep, started from the impulses of the last substep, which the particles have already
added to the grid. The sweep divides by the row sums of the contact matrix W M^-1 W^T (the share of contacting mass at
the particle), which makes it exact for even contact and stable for any, by Gershgorin's theorem.
"""

import taichi as ti

from ..rigid.rigid_layout import STATE, X
from .adhesion import MOST_REACH, largest_pull
from .collider_distance import (
    PUSH,
    REACH_FACTOR,
    add_push,
    body_compliance,
    body_distance,
    body_velocity,
    single3,
    surface_slide,
)
from .contact_law import RECOVERY, parting_speed, press
from .interpolation import weights
from .kernel_arrays import (
    AdhesionArrays,
    CouplingArrays,
    GridBlocks,
    NearBlocks,
    NodeArrays,
    ParticleArrays,
    ParticleBlocks,
    RigidArrays,
    ShapeArrays,
    WorldArrays,
)
from .kernel_bundles import func
from .lanes import NODE_THREADS, lane_maxima, meet, pads_of
from .layout import (
    ADHESION_REACH,
    ADHESION_ROW,
    BLOCK_NODES,
    CONTROL_ROW,
    ELAPSED,
    FIELD_INTEGERS,
    FIRST_RIGID_BODY,
    FIRST_TOUCH,
    FULL,
    HAS_ANCHORS,
    HAS_PLANE,
    PHASE,
    PLANE_NORMAL,
    PLANE_OFFSET,
    RECOVERY_SPEED,
    RIGID_BODIES,
    RIGID_SPEED,
    SPEED,
    SPREAD,
    STEP,
    TOUCH_ROW,
    WINDOW_NODES,
    WORLD,
    WORLD_INTEGERS,
    WORLD_ROW,
    triple,
    vec3,
    vec4,
)
from .particle_transfer import PIN, anchor_place
from .windows import (
    add_to,
    clear_window,
    fetch_window,
    first_of,
    gathered,
    in_cells,
    layer,
    load_window,
    node_of,
    store_window,
    sum_chosen_windows,
    turns,
)

LEAST_REACH = 0.02
"""Cells from a surface within which a particle at rest takes part in the contact."""

MOST_SLACK = 0.5
"""Cells of travel at most before a block's particles are tested again."""

AHEAD = 3.0
"""Reaches from a rigid body within which a particle's mass counts as touching it: known one substep ahead, so that the
first impact on a light body is not solved as if nothing else touched it."""


@func
def solve_block(
    lanes: ti.template(),
    pushed: ti.template(),
    adheres: ti.template(),
    pads: ti.template(),
    lane: ti.i32,
    s: ti.i32,
    spot: ti.i32,
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    near: NearBlocks,
    particles: ParticleArrays,
    nodes: NodeArrays,
    bodies: RigidArrays,
    shapes: ShapeArrays,
    coupling: CouplingArrays,
    adhesion: AdhesionArrays,
):
    """``solve_contact`` of near block ``s``, whose window to read begins at ``spot``."""
    k = near.particle_blocks[s]
    offset = 0 if ti.static(lanes.shared) else k * WINDOW_NODES
    f = blocks.field[k]
    w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
    c = w * CONTROL_ROW
    dt = ti.cast(worlds.control[c + STEP], ti.f32)
    fastest = ti.cast(ti.max(worlds.control[c + SPEED], worlds.control[c + RIGID_SPEED]), ti.f32)
    slack = near.slack[k]
    if worlds.control[c + PHASE] == FULL:
        slack -= 2.0 * REACH_FACTOR * fastest * dt
    meet(lanes)
    if lane == 0:
        near.touched[k] = 0
        near.slack[k] = slack
        if ti.static(pushed):
            for n in range(coupling.most_bodies * PUSH):
                coupling.pushes[s * coupling.most_bodies * PUSH + n] = 0.0
    if worlds.control[c + PHASE] == FULL and slack <= 0.0:
        # Particles farther away cannot touch in this substep.
        reach = REACH_FACTOR * fastest * dt + LEAST_REACH
        least = MOST_SLACK
        recovery = worlds.numbers[w * WORLD_ROW + RECOVERY_SPEED]
        has_plane = worlds.numbers[w * WORLD_ROW + HAS_PLANE] > 0.5
        plane = triple(worlds.numbers, w * WORLD_ROW + PLANE_NORMAL)
        first_touch = worlds.field_integers[f * FIELD_INTEGERS + FIRST_TOUCH]
        has_anchors = worlds.field_integers[f * FIELD_INTEGERS + HAS_ANCHORS] == 1
        first_body = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
        body_count = worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]
        first_node = ti.cast(blocks.cells[k] * 4 - 1, ti.f32)
        level = plane.dot(first_node) - worlds.numbers[w * WORLD_ROW + PLANE_OFFSET]
        time = ti.cast(worlds.control[c + ELAPSED], ti.f32) + dt
        touched = 0.0
        if ti.static(lanes.parallel):
            fetch_window(lanes, lane, k, spot, blocks.neighbours, nodes.velocity, pads.window)
            clear_window(lanes, lane, offset, pads.scattered)
        meet(lanes)
        p = blocks.starts[k] + lane
        while p < blocks.starts[k + 1]:
            gp = in_cells(particles.x[p])
            fixed = particles.constants[p]
            past = particles.reaction[p]
            old = dt * vec3(past[0], past[1], past[2])
            # The nearest surface and the next: distance, normal, rate of approach, obstacle.
            phi, second = 1e9, 1e9
            normal, second_normal = plane, plane
            swelling, second_swelling = 0.0, 0.0
            obstacle, second_obstacle = 0, 0
            if has_plane:
                phi = level + plane.dot(gp) - fixed[3]
            if ti.static(pushed):
                for o in range(body_count):
                    farthest = MOST_SLACK + AHEAD * reach + fixed[3]
                    around = AHEAD * reach
                    if ti.static(adheres):
                        farthest += MOST_REACH
                        around = ti.max(around, adhesion.touches[(first_touch + o + 1) * ADHESION_ROW + ADHESION_REACH])
                    found, along, rate = body_distance(first_body + o, first_node + gp, farthest, bodies, shapes)
                    found -= fixed[3]
                    if found < around:
                        coupling.pushes[(s * coupling.most_bodies + o) * PUSH + 6] += fixed[0]
                    if found < phi:
                        second, second_normal, second_swelling, second_obstacle = phi, normal, swelling, obstacle
                        phi, normal, swelling, obstacle = found, along, rate, o + 1
                    elif found < second:
                        second, second_normal, second_swelling, second_obstacle = found, along, rate, o + 1
            pinned = False
            if has_anchors:
                pinned = particles.anchors[p][3] == PIN
            least = ti.min(least, phi)
            held = False
            if ti.static(adheres):
                least = ti.min(least, phi - MOST_REACH)
                held = phi < adhesion.touches[(first_touch + obstacle) * ADHESION_ROW + ADHESION_REACH]
            if phi < reach or held or old.norm_sqr() > 0.0 or pinned:
                least = 0.0
                if ti.static(not lanes.parallel):
                    if touched == 0.0:
                        load_window(k, spot, blocks.neighbours, nodes.window, nodes.velocity)
                        clear_window(lanes, lane, offset, pads.scattered)
                touched = 1.0
                base = ti.cast(gp - 0.5, ti.i32)
                fx = gp - ti.cast(base, ti.f32)
                w3 = weights(fx)
                inside = first_of(base, pads.window)
                u = vec4(0.0)
                for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
                    n = spot + inside + (i * ti.static(layer(pads.window)) + j * 8 + m)
                    u += (w3[i][0] * w3[j][1] * w3[m][2]) * node_of(pads.window, n)
                share = 1.0
                if old.norm_sqr() > 0.0 and past[3] > 0.0:
                    share = ti.max(past[3], 0.02)
                velocity = vec3(u[0], u[1], u[2])
                new = vec3(0.0)
                beside = vec3(0.0)
                here = first_node + gp
                if pinned:
                    place, rate = anchor_place(f, time, particles.anchors[p], worlds)
                    # The correction of its place is not kept as part of the impulse: it would be integrated
                    # twice, which modes that the transfers hardly damp do not bear.
                    beside = RECOVERY * (place - rate * dt - here) / (dt * share)
                    new = old + (rate - velocity) / share
                else:
                    surface = swelling * normal
                    give = 0.0
                    if ti.static(pushed):
                        if obstacle > 0:
                            i = first_body + obstacle - 1
                            surface += body_velocity(i, here, bodies)
                            local = here - single3(bodies.state, i * STATE + X)
                            surface += surface_slide(i, local, normal, bodies, shapes)
                            give = coupling.touching[i] * body_compliance(i, here, normal, bodies)
                    pull = 0.0
                    if ti.static(adheres):
                        pull = largest_pull(first_touch + obstacle, phi, dt, adhesion.touches, adhesion.touch_sums)
                    new = press(
                        adheres,
                        old,
                        velocity - surface,
                        phi,
                        normal,
                        share + give,
                        dt,
                        recovery,
                        (first_touch + obstacle) * TOUCH_ROW,
                        pull,
                        worlds,
                    )
                    if second < reach:
                        surface = second_swelling * second_normal
                        if ti.static(pushed):
                            if second_obstacle > 0:
                                surface += body_velocity(first_body + second_obstacle - 1, here, bodies)
                        left = (velocity + share * (new - old) - surface).dot(second_normal)
                        wanted = parting_speed(second, dt, recovery)
                        beside = (ti.max(0.0, wanted - left) / (share + give)) * second_normal
                particles.reaction[p] = vec4(new[0] / dt, new[1] / dt, new[2] / dt, past[3])
                if (new + beside).norm_sqr() > 0.0 or old.norm_sqr() > 0.0:
                    change = fixed[0] * (new + beside - old)
                    mass = ti.select((new + beside).norm_sqr() > 0.0, fixed[0], 0.0)
                    q = vec4(change[0], change[1], change[2], mass)
                    for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
                        n = offset + inside + (i * ti.static(layer(pads.scattered)) + j * 8 + m)
                        add_to(pads.scattered, n, (w3[i][0] * w3[j][1] * w3[m][2]) * q)
                    if ti.static(pushed):
                        if obstacle > 0 and not pinned:
                            row = (s * coupling.most_bodies + obstacle - 1) * PUSH
                            add_push(first_body + obstacle - 1, row, here, -fixed[0] * new, bodies, coupling)
                        if second_obstacle > 0 and beside.norm_sqr() > 0.0:
                            row = (s * coupling.most_bodies + second_obstacle - 1) * PUSH
                            given = -fixed[0] * beside
                            add_push(first_body + second_obstacle - 1, row, here, given, bodies, coupling)
            p += ti.static(lanes.threads)
        meet(lanes)
        most = lane_maxima(lanes, lane, vec4(touched, -least, 0.0, 0.0), pads)
        if most[0] > 0.0:
            store_window(lanes, lane, k, pads.scattered, nodes.scattered)
        if lane == 0:
            near.touched[k] = ti.cast(most[0], ti.i32)
            near.slack[k] = -most[1] - AHEAD * reach
        meet(lanes)


@func
def solve_contact(
    lanes: ti.template(),
    pushed: ti.template(),
    adheres: ti.template(),
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    near: NearBlocks,
    particles: ParticleArrays,
    nodes: NodeArrays,
    bodies: RigidArrays,
    shapes: ShapeArrays,
    coupling: CouplingArrays,
    adhesion: AdhesionArrays,
):
    """One Jacobi sweep: update ``reaction`` (cells/s^2) and scatter the change of impulse and the contacting mass.

    pushed: whether there are rigid bodies or colliders.
    adheres: whether some fields adhere to rigid bodies or colliders.
    """
    if ti.static(lanes.shared):
        ti.loop_config(block_dim=ti.static(lanes.threads))
        for ss in range(ti.static(lanes.groups * lanes.threads)):
            pads = ti.static(pads_of(lanes, nodes))
            s = ss // ti.static(lanes.threads)
            while s < near.particle_count:
                solve_block(
                    lanes,
                    pushed,
                    adheres,
                    pads,
                    ss % ti.static(lanes.threads),
                    s,
                    0,
                    worlds,
                    blocks,
                    near,
                    particles,
                    nodes,
                    bodies,
                    shapes,
                    coupling,
                    adhesion,
                )
                s += ti.static(lanes.groups)
    else:
        for ss in range(turns(lanes, near.particle_count, nodes.window) * ti.static(lanes.span)):
            lane = ss % ti.static(lanes.span)
            if lane < ti.static(lanes.threads):
                turn, all_turns = ss // ti.static(lanes.span), turns(lanes, near.particle_count, nodes.window)
                pads = ti.static(pads_of(lanes, nodes))
                for s in range(turn * near.particle_count // all_turns, (turn + 1) * near.particle_count // all_turns):
                    spot = turn * WINDOW_NODES
                    solve_block(
                        lanes,
                        pushed,
                        adheres,
                        pads,
                        lane,
                        s,
                        spot,
                        worlds,
                        blocks,
                        near,
                        particles,
                        nodes,
                        bodies,
                        shapes,
                        coupling,
                        adhesion,
                    )


@func
def apply_to_node(t: ti.i32, worlds: WorldArrays, grid: GridBlocks, near: NearBlocks, nodes: NodeArrays):
    """``apply_contact`` at node ``t`` of the near blocks."""
    g = near.grid_blocks[t // BLOCK_NODES]
    n = g * BLOCK_NODES + t % BLOCK_NODES
    w = worlds.field_integers[grid.field[g] * FIELD_INTEGERS + WORLD]
    if worlds.control[w * CONTROL_ROW + PHASE] == FULL and nodes.mass[n] > 0.0:
        q = gathered(g, t % BLOCK_NODES, grid.neighbours, near.touched, nodes.scattered) / nodes.mass[n]
        u = nodes.velocity[n]
        nodes.velocity[n] = vec4(u[0] + q[0], u[1] + q[1], u[2] + q[2], q[3])


@func
def apply_contact(lanes: ti.template(), worlds: WorldArrays, grid: GridBlocks, near: NearBlocks, nodes: NodeArrays):
    """Add the change of impulse to the nodes' velocity; leave the share of contacting mass in their fourth number."""
    if ti.static(lanes.shared):
        for start in range(NODE_THREADS):
            t = start
            while t < near.grid_count * BLOCK_NODES:
                apply_to_node(t, worlds, grid, near, nodes)
                t += NODE_THREADS
    elif ti.static(lanes.parallel):
        for t in range(near.grid_count * BLOCK_NODES):
            apply_to_node(t, worlds, grid, near, nodes)
    else:
        for ss in range(turns(lanes, near.grid_count, nodes.window) * SPREAD):
            if ss % SPREAD == 0:
                turn, all_turns = ss // SPREAD, turns(lanes, near.grid_count, nodes.window)
                for s in range(turn * near.grid_count // all_turns, (turn + 1) * near.grid_count // all_turns):
                    apply_to_block(s, worlds, grid, near, nodes)


@func
def apply_to_block(s: ti.i32, worlds: WorldArrays, grid: GridBlocks, near: NearBlocks, nodes: NodeArrays):
    """``apply_contact`` at near block ``s``."""
    g = near.grid_blocks[s]
    w = worlds.field_integers[grid.field[g] * FIELD_INTEGERS + WORLD]
    if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
        any_touched = 0
        for d in range(27):
            if grid.neighbours[g * 27 + d] >= 0:
                any_touched += near.touched[grid.neighbours[g * 27 + d]]
        if any_touched > 0:
            sum_chosen_windows(g, s, grid.neighbours, near.touched, nodes.scattered, nodes.sums)
            for i in range(BLOCK_NODES):
                n = g * BLOCK_NODES + i
                if nodes.mass[n] > 0.0:
                    q = nodes.sums[s * BLOCK_NODES + i] / nodes.mass[n]
                    u = nodes.velocity[n]
                    nodes.velocity[n] = vec4(u[0] + q[0], u[1] + q[1], u[2] + q[2], q[3])
