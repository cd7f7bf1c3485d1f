# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""The nodes' half of a substep: gather the windows, momentum to velocity, gravity and the forces of ``forces``.

Fields are single bodies, so a force on a body is a force on its nodes; it costs nothing a particle.
"""

import taichi as ti

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
    Cells,
    Doubles,
    Integers,
    Scalars,
    Vectors4,
    ivec3,
    triple,
    vec3,
    vec4,
)
from .materials import FLOWING
from .stepping import FARTHEST_STEP, not_finite
from .transfer import sum_windows

SUMS = 16
"""Numbers that a grid block adds to its field's means: mass, mass x place (3), momentum (3), angular momentum (3) and
the six second moments xx, yy, zz, xy, yz, zx, places counted from the field's last centre of mass."""


@ti.func
def lift_acceleration(f: ti.i32, dt: ti.f32, fields: Scalars, means: Scalars):
    """Mean over ``dt`` of the lift: the velocity through the air turns about the spin, and no speed is gained."""
    row, mean = f * FIELD_ROW, f * MEAN_ROW
    through = triple(means, mean + MEAN_VELOCITY) - triple(fields, row + WIND)
    half = (0.5 * dt * fields[row + LIFT]) * triple(means, mean + MEAN_SPIN)
    return (2.0 / (dt * (1.0 + half.norm_sqr()))) * half.cross(through + half.cross(through))


@ti.func
def steady_acceleration(
    f: ti.i32, w: ti.i32, dt: ti.f32, worlds: Scalars, fields: Scalars, means: Scalars, control: Doubles
):
    """Acceleration (cells/s²) of field ``f``, the same all over it, in the substep of ``dt`` s that begins."""
    row, world, mean = f * FIELD_ROW, w * WORLD_ROW, f * MEAN_ROW
    time = ti.cast(control[w * CONTROL_ROW + ELAPSED], ti.f32) + 0.5 * dt
    gravity = triple(worlds, world + GRAVITY) + time * triple(worlds, world + GRAVITY_RATE)
    a = fields[row + GRAVITY_FACTOR] * gravity
    a += triple(fields, row + ACCELERATION) + time * triple(fields, row + ACCELERATION_RATE)
    if fields[row + LIFT] != 0.0:
        a += lift_acceleration(f, dt, fields, means)
    if fields[row + TETHER_STIFFNESS] > 0.0:
        arm = triple(fields, row + TETHER_ANCHOR) - triple(means, mean + MEAN_PLACE)
        distance = arm.norm() + 1e-12
        stretch = distance - fields[row + TETHER_LENGTH]
        if fields[row + TETHER_STRING] > 0.5:
            stretch = ti.max(stretch, 0.0)
        a += (fields[row + TETHER_STIFFNESS] * stretch / distance) * arm
    if fields[row + PLANE_ADHESION] > 0.0:
        known = ti.cast(control[w * CONTROL_ROW + SUBSTEPS], ti.i32) & 1
        if fields[row + PLANE_GAP + known] < fields[row + PLANE_REACH]:
            a -= fields[row + PLANE_ADHESION] * triple(worlds, world + PLANE_NORMAL)
    return a


@ti.func
def advance_nodes(
    laws: ti.template(),
    blocks: ti.i32,
    g_cells: Cells,
    g_field: Integers,
    neighbours: Integers,
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
    """Nodes of all grid blocks: sum of the windows, velocity = momentum / mass, forces.

    nodes: velocity in cells/s; the fourth number is left at 0 for the contact, which finds the mass in
    ``masses`` (kg). block_sums: see ``SUMS``, of fields whose means are wanted.
    """
    for gg in range(blocks * SPREAD):
        if gg % SPREAD == 0:
            g = gg // SPREAD
            f = g_field[g]
            w = field_integers[f * FIELD_INTEGERS + WORLD]
            c = w * CONTROL_ROW
            if control[c + PHASE] == FULL:
                dt = ti.cast(control[c + STEP], ti.f32)
                push = dt * steady_acceleration(f, w, dt, worlds, fields, means, control)
                wants_means = field_integers[f * FIELD_INTEGERS + WANTS_MEANS] == 1
                drag = fields[f * FIELD_ROW + DRAG]
                wind = triple(fields, f * FIELD_ROW + WIND)
                sum_windows(g, neighbours, scattered, nodes)
                for i in range(BLOCK_NODES):
                    q = nodes[g * BLOCK_NODES + i]
                    masses[g * BLOCK_NODES + i] = q[3]
                    if q[3] > 0.0:
                        inverse = 1.0 / q[3]
                        u = vec3(q[0], q[1], q[2]) * inverse
                        slower = vec3(0.0)
                        if drag > 0.0:
                            # Exact for drag alone, so that none can turn a body back; with half of the other forces
                            # before and half after, the terminal velocity is right to the second order too.
                            through = u + 0.5 * push - wind
                            slower = through * (1.0 - 1.0 / (1.0 + dt * drag * through.norm()))
                        u += push - slower
                        nodes[g * BLOCK_NODES + i] = vec4(u[0], u[1], u[2], 0.0)
                if ti.static(laws & FLOWING):
                    sum_windows(g, neighbours, past_scattered, past_nodes)
                    for i in range(BLOCK_NODES):
                        mass = masses[g * BLOCK_NODES + i]
                        if mass > 0.0:
                            past_nodes[g * BLOCK_NODES + i] = past_nodes[g * BLOCK_NODES + i] / mass
                if wants_means:
                    add_sums(g, g_cells, triple(means, f * MEAN_ROW + MEAN_PLACE), nodes, masses, block_sums)


@ti.func
def add_sums(g: ti.i32, g_cells: Cells, centre: vec3, nodes: Vectors4, masses: Scalars, block_sums: Scalars):
    """What grid block ``g`` adds to the means of its field; the grid holds the particles' moments exactly (APIC)."""
    for n in range(SUMS):
        block_sums[g * SUMS + n] = 0.0
    first = g_cells[g] * 4
    for i in range(BLOCK_NODES):
        m = masses[g * BLOCK_NODES + i]
        if m > 0.0:
            u = nodes[g * BLOCK_NODES + i]
            r = ti.cast(first + ivec3(i // 16, i // 4 % 4, i % 4), ti.f32) - centre
            velocity = vec3(u[0], u[1], u[2])
            spin = r.cross(velocity)
            block_sums[g * SUMS] += m
            for n in ti.static(range(3)):
                block_sums[g * SUMS + 1 + n] += m * r[n]
                block_sums[g * SUMS + 4 + n] += m * velocity[n]
                block_sums[g * SUMS + 7 + n] += m * spin[n]
                block_sums[g * SUMS + 10 + n] += m * r[n] * r[n]
                block_sums[g * SUMS + 13 + n] += m * r[n] * r[(n + 1) % 3]


@ti.func
def gather_means(
    field_count: ti.i32,
    g_starts: Integers,
    field_integers: Integers,
    control: Doubles,
    block_sums: Scalars,
    means: Scalars,
):
    """Means of the fields that want them, from their grid blocks ``g_starts[f]`` up to ``g_starts[f + 1]``.

    The place is that at which the next substep finds the body: a force found one substep late would feed it energy.
    Means of a substep that went wrong are not kept, lest they spoil the next attempt.
    """
    ti.loop_config(serialize=True)
    for f in range(field_count):
        w = field_integers[f * FIELD_INTEGERS + WORLD]
        if field_integers[f * FIELD_INTEGERS + WANTS_MEANS] == 1 and control[w * CONTROL_ROW + PHASE] == FULL:
            total = ti.Vector([0.0 for _ in range(SUMS)], ti.f64)
            for g in range(g_starts[f], g_starts[f + 1]):
                for n in ti.static(range(SUMS)):
                    total[n] += block_sums[g * SUMS + n]
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
                step = control[w * CONTROL_ROW + STEP]
                check = ti.cast(velocity.norm_sqr() + omega.norm_sqr() + shift.norm_sqr(), ti.f32)
                if not not_finite(check) and velocity.norm() * step < FARTHEST_STEP:
                    for n in ti.static(range(3)):
                        means[mean + MEAN_PLACE + n] += ti.cast(shift[n] + step * velocity[n], ti.f32)
                        means[mean + MEAN_VELOCITY + n] = ti.cast(velocity[n], ti.f32)
                        means[mean + MEAN_SPIN + n] = ti.cast(omega[n], ti.f32)
