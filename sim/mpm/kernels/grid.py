# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Grid update of a substep: gather the windows, momentum to velocity, gravity and body forces.

A field is one body, so a force on a body is a force on its nodes, at no cost per particle.
"""

import taichi as ti

from .kernel_arrays import FlowArrays, GridBlocks, NodeArrays, WorldArrays
from .kernel_bundles import func
from .lanes import NODE_THREADS, SERIAL
from .layout import (
    ACCELERATION,
    ACCELERATION_RATE,
    BLOCK_NODES,
    CONTROL_ROW,
    DRAG,
    ELAPSED,
    FIELD_INTEGERS,
    FIELD_ROW,
    FULL,
    GRAVITY,
    GRAVITY_FACTOR,
    GRAVITY_RATE,
    LIFT,
    MEAN_PLACE,
    MEAN_ROW,
    MEAN_SPIN,
    MEAN_VELOCITY,
    PHASE,
    PLANE_ADHESION,
    PLANE_GAP,
    PLANE_NORMAL,
    PLANE_REACH,
    SPREAD,
    STEP,
    SUBSTEPS,
    TETHER_ANCHOR,
    TETHER_LENGTH,
    TETHER_STIFFNESS,
    TETHER_STRING,
    WANTS_MEANS,
    WIND,
    WORLD,
    WORLD_ROW,
    ivec3,
    triple,
    vec3,
    vec4,
)
from .time_stepping import FARTHEST_STEP, not_finite
from .windows import gathered, sum_windows, turns

SUMS = 16
"""Numbers that a grid block adds to its field's means: mass, mass x place (3), momentum (3), angular momentum (3) and
the six second moments xx, yy, zz, xy, yz, zx, places counted from the field's last centre of mass."""


@func
def lift_acceleration(f: ti.i32, dt: ti.f32, worlds: WorldArrays):
    """Mean lift acceleration over ``dt``: the velocity through the air turns about the spin without gaining speed."""
    row, mean = f * FIELD_ROW, f * MEAN_ROW
    through = triple(worlds.means, mean + MEAN_VELOCITY) - triple(worlds.field_numbers, row + WIND)
    half = (0.5 * dt * worlds.field_numbers[row + LIFT]) * triple(worlds.means, mean + MEAN_SPIN)
    return (2.0 / (dt * (1.0 + half.norm_sqr()))) * half.cross(through + half.cross(through))


@func
def steady_acceleration(f: ti.i32, w: ti.i32, dt: ti.f32, worlds: WorldArrays):
    """Acceleration (cells/s²) of field ``f``, the same all over it, in the substep of ``dt`` s that begins."""
    row, world, mean = f * FIELD_ROW, w * WORLD_ROW, f * MEAN_ROW
    time = ti.cast(worlds.control[w * CONTROL_ROW + ELAPSED], ti.f32) + 0.5 * dt
    gravity = triple(worlds.numbers, world + GRAVITY) + time * triple(worlds.numbers, world + GRAVITY_RATE)
    a = worlds.field_numbers[row + GRAVITY_FACTOR] * gravity
    a += triple(worlds.field_numbers, row + ACCELERATION) + time * triple(worlds.field_numbers, row + ACCELERATION_RATE)
    if worlds.field_numbers[row + LIFT] != 0.0:
        a += lift_acceleration(f, dt, worlds)
    if worlds.field_numbers[row + TETHER_STIFFNESS] > 0.0:
        arm = triple(worlds.field_numbers, row + TETHER_ANCHOR) - triple(worlds.means, mean + MEAN_PLACE)
        distance = arm.norm() + 1e-12
        stretch = distance - worlds.field_numbers[row + TETHER_LENGTH]
        if worlds.field_numbers[row + TETHER_STRING] > 0.5:
            stretch = ti.max(stretch, 0.0)
        a += (worlds.field_numbers[row + TETHER_STIFFNESS] * stretch / distance) * arm
    if worlds.field_numbers[row + PLANE_ADHESION] > 0.0:
        known = ti.cast(worlds.control[w * CONTROL_ROW + SUBSTEPS], ti.i32) & 1
        if worlds.field_numbers[row + PLANE_GAP + known] < worlds.field_numbers[row + PLANE_REACH]:
            a -= worlds.field_numbers[row + PLANE_ADHESION] * triple(worlds.numbers, world + PLANE_NORMAL)
    return a


@func
def drive(q: vec4, push: vec3, dt: ti.f32, drag: ti.f32, wind: vec3):
    """Velocity of a node of momentum and mass ``q`` after the forces of a substep; 0 as its fourth number."""
    inverse = 1.0 / q[3]
    u = vec3(q[0], q[1], q[2]) * inverse
    slower = vec3(0.0)
    if drag > 0.0:
        # Exact for drag alone, so that none can turn a body back; with half of the other forces
        # before and half after, the terminal velocity is right to the second order too.
        through = u + 0.5 * push - wind
        slower = through * (1.0 - 1.0 / (1.0 + dt * drag * through.norm()))
    u += push - slower
    return vec4(u[0], u[1], u[2], 0.0)


@func
def advance_node(
    flowing: ti.template(), n: ti.i32, worlds: WorldArrays, grid: GridBlocks, nodes: NodeArrays, flow: FlowArrays
):
    """``advance_nodes`` for node ``n``."""
    g = n // BLOCK_NODES
    f = grid.field[g]
    w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
    c = w * CONTROL_ROW
    if worlds.control[c + PHASE] == FULL:
        dt = ti.cast(worlds.control[c + STEP], ti.f32)
        push = dt * steady_acceleration(f, w, dt, worlds)
        wind = triple(worlds.field_numbers, f * FIELD_ROW + WIND)
        q = gathered(g, n % BLOCK_NODES, grid.neighbours, None, nodes.scattered)
        nodes.mass[n] = q[3]
        if q[3] > 0.0:
            if ti.static(flowing):
                flow.velocity[n] = gathered(g, n % BLOCK_NODES, grid.neighbours, None, flow.scattered) / q[3]
            q = drive(q, push, dt, worlds.field_numbers[f * FIELD_ROW + DRAG], wind)
        elif ti.static(flowing):
            flow.velocity[n] = vec4(0.0)
        nodes.velocity[n] = q


@func
def advance_nodes_in_parallel(
    flowing: ti.template(),
    means: ti.template(),
    lanes: ti.template(),
    worlds: WorldArrays,
    grid: GridBlocks,
    nodes: NodeArrays,
    flow: FlowArrays,
):
    """As ``advance_nodes``, a thread a node; ``means``: whether some fields' means are wanted."""
    if ti.static(lanes.shared):
        for start in range(NODE_THREADS):
            n = start
            while n < grid.count * BLOCK_NODES:
                advance_node(flowing, n, worlds, grid, nodes, flow)
                n += NODE_THREADS
    else:
        for n in range(grid.count * BLOCK_NODES):
            advance_node(flowing, n, worlds, grid, nodes, flow)
    if ti.static(means):
        for g in range(grid.count):
            f = grid.field[g]
            w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
            wanted = worlds.field_integers[f * FIELD_INTEGERS + WANTS_MEANS] == 1
            if wanted and worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                add_sums(g, triple(worlds.means, f * MEAN_ROW + MEAN_PLACE), grid, nodes)


@func
def advance_nodes(flowing: ti.template(), worlds: WorldArrays, grid: GridBlocks, nodes: NodeArrays, flow: FlowArrays):
    """Nodes of all grid blocks: sum of the windows, velocity = momentum / mass, forces.

    The fourth number of ``nodes.velocity`` is set to 0 for the contact; the mass is in ``nodes.mass``.
    """
    for gg in range(turns(SERIAL, grid.count, nodes.window) * SPREAD):
        if gg % SPREAD == 0:
            turn, all_turns = gg // SPREAD, turns(SERIAL, grid.count, nodes.window)
            for g in range(turn * grid.count // all_turns, (turn + 1) * grid.count // all_turns):
                advance_grid_block(flowing, g, worlds, grid, nodes, flow)


@func
def advance_grid_block(
    flowing: ti.template(), g: ti.i32, worlds: WorldArrays, grid: GridBlocks, nodes: NodeArrays, flow: FlowArrays
):
    """``advance_nodes`` for grid block ``g``."""
    f = grid.field[g]
    w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
    c = w * CONTROL_ROW
    if worlds.control[c + PHASE] == FULL:
        dt = ti.cast(worlds.control[c + STEP], ti.f32)
        push = dt * steady_acceleration(f, w, dt, worlds)
        drag = worlds.field_numbers[f * FIELD_ROW + DRAG]
        wind = triple(worlds.field_numbers, f * FIELD_ROW + WIND)
        sum_windows(g, grid.neighbours, nodes.scattered, nodes.velocity)
        for i in range(BLOCK_NODES):
            q = nodes.velocity[g * BLOCK_NODES + i]
            nodes.mass[g * BLOCK_NODES + i] = q[3]
            if q[3] > 0.0:
                nodes.velocity[g * BLOCK_NODES + i] = drive(q, push, dt, drag, wind)
        if ti.static(flowing):
            sum_windows(g, grid.neighbours, flow.scattered, flow.velocity)
            for i in range(BLOCK_NODES):
                mass = nodes.mass[g * BLOCK_NODES + i]
                if mass > 0.0:
                    flow.velocity[g * BLOCK_NODES + i] = flow.velocity[g * BLOCK_NODES + i] / mass
        if worlds.field_integers[f * FIELD_INTEGERS + WANTS_MEANS] == 1:
            add_sums(g, triple(worlds.means, f * MEAN_ROW + MEAN_PLACE), grid, nodes)


@func
def add_sums(g: ti.i32, centre: vec3, grid: GridBlocks, nodes: NodeArrays):
    """Write the sums of grid block ``g`` for its field's means; the grid has the particles' moments exactly (APIC)."""
    for n in range(SUMS):
        nodes.block_sums[g * SUMS + n] = 0.0
    first = grid.cells[g] * 4
    for i in range(BLOCK_NODES):
        m = nodes.mass[g * BLOCK_NODES + i]
        if m > 0.0:
            u = nodes.velocity[g * BLOCK_NODES + i]
            r = ti.cast(first + ivec3(i // 16, i // 4 % 4, i % 4), ti.f32) - centre
            velocity = vec3(u[0], u[1], u[2])
            spin = r.cross(velocity)
            nodes.block_sums[g * SUMS] += m
            for n in ti.static(range(3)):
                nodes.block_sums[g * SUMS + 1 + n] += m * r[n]
                nodes.block_sums[g * SUMS + 4 + n] += m * velocity[n]
                nodes.block_sums[g * SUMS + 7 + n] += m * spin[n]
                nodes.block_sums[g * SUMS + 10 + n] += m * r[n] * r[n]
                nodes.block_sums[g * SUMS + 13 + n] += m * r[n] * r[(n + 1) % 3]


@func
def gather_means(worlds: WorldArrays, grid: GridBlocks, nodes: NodeArrays):
    """Means of the fields that want them, from their grid blocks ``g_starts[f]`` up to ``g_starts[f + 1]``.

    The place is that at which the next substep finds the body: a force found one substep late would feed it energy.
    Means of a substep that diverged are dropped, so that they cannot spoil the next attempt.
    """
    ti.loop_config(serialize=True)
    for f in range(worlds.mean_fields):
        w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
        if (
            worlds.field_integers[f * FIELD_INTEGERS + WANTS_MEANS] == 1
            and worlds.control[w * CONTROL_ROW + PHASE] == FULL
        ):
            total = ti.Vector([0.0 for _ in range(SUMS)], ti.f64)
            for g in range(grid.starts[f], grid.starts[f + 1]):
                for n in ti.static(range(SUMS)):
                    total[n] += nodes.block_sums[g * SUMS + n]
            mass = total[0]
            if mass > 0.0:
                mean = f * MEAN_ROW
                shift = ti.Vector([total[1], total[2], total[3]]) / mass
                velocity = ti.Vector([total[4], total[5], total[6]]) / mass
                spin = ti.Vector([total[7], total[8], total[9]]) - mass * shift.cross(velocity)
                xx = total[10] - mass * shift[0] * shift[0]
                yy = total[11] - mass * shift[1] * shift[1]
                zz = total[12] - mass * shift[2] * shift[2]
                xy = total[13] - mass * shift[0] * shift[1]
                yz = total[14] - mass * shift[1] * shift[2]
                zx = total[15] - mass * shift[2] * shift[0]
                inertia = ti.Matrix([[yy + zz, -xy, -zx], [-xy, zz + xx, -yz], [-zx, -yz, xx + yy]])
                omega = inertia.inverse() @ spin
                step = worlds.control[w * CONTROL_ROW + STEP]
                check = ti.cast(velocity.norm_sqr() + omega.norm_sqr() + shift.norm_sqr(), ti.f32)
                if not not_finite(check) and velocity.norm() * step < FARTHEST_STEP:
                    for n in ti.static(range(3)):
                        worlds.means[mean + MEAN_PLACE + n] += ti.cast(shift[n] + step * velocity[n], ti.f32)
                        worlds.means[mean + MEAN_VELOCITY + n] = ti.cast(velocity[n], ti.f32)
                        worlds.means[mean + MEAN_SPIN + n] = ti.cast(omega[n], ti.f32)
