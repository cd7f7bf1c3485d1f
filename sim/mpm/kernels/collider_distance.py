# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Distance of particles to rigid bodies and colliders (``rigid_layout``), and their impulses on rigid bodies.

Distance lattices are sampled on the device: lattice s has its first node and spacing at ``shapes.lattices[4 s ..]``,
its nodes along x, y, z and its start in ``shapes.distances`` at ``shapes.dims[4 s ..]``.
"""

import taichi as ti

from ..rigid.rigid_layout import (
    BLEND,
    BLEND_RATE,
    DYNAMIC,
    INVERSE_MASS,
    KIND,
    KINDS,
    LAYERS,
    MOTION,
    NUMBERS,
    RADIUS,
    SHAPE,
    STATE,
    V_NEXT,
    W_NEXT,
    WAITING,
    J,
    R,
    X,
)
from .kernel_arrays import CouplingArrays, NearBlocks, ParticleBlocks, RigidArrays, ShapeArrays, WorldArrays
from .kernel_bundles import func
from .layout import (
    CONTROL_ROW,
    FIELD_INTEGERS,
    FIRST_RIGID_BODY,
    FULL,
    PHASE,
    RIGID_BODIES,
    WORLD,
    WORLD_INTEGERS,
    Doubles,
    ivec3,
    vec3,
)

PUSH = 8
"""Numbers that a block of particles adds to a body: impulse (3), about its centre (3), mass at the body, spare."""

REACH_FACTOR = 1.5
"""Steps of the fastest particle within which a particle takes part in the contact."""


@func
def outside_box(shape, point, shapes: ShapeArrays):
    """Vector from the nearest point of the lattice's box to ``point``; zero inside."""
    away = point
    for c in ti.static(range(3)):
        low = shapes.lattices[4 * shape + c]
        high = low + shapes.lattices[4 * shape + 3] * ti.cast(shapes.dims[4 * shape + c] - 1, ti.f32)
        away[c] = point[c] - ti.min(ti.max(point[c], low), high)
    return away


@func
def lattice_cell(shape, point, shapes: ShapeArrays):
    """The way from the lattice of ``shape`` to ``point``, the lattice's points along each axis, the cell that holds the
    point or is nearest to it, and the place in that cell, 0 to 1."""
    away = outside_box(shape, point, shapes)
    inverse = 1.0 / shapes.lattices[4 * shape + 3]
    low = point
    for c in ti.static(range(3)):
        low[c] = shapes.lattices[4 * shape + c]
    g = (point - away - low) * inverse
    n = ivec3(shapes.dims[4 * shape], shapes.dims[4 * shape + 1], shapes.dims[4 * shape + 2])
    i = ti.max(ti.min(ti.cast(g, ti.i32), n - 2), 0)
    return away, n, i, g - i


@func
def sample_distance(shape, point, shapes: ShapeArrays):
    """(gradient xyz, distance) of ``shape`` at ``point``, trilinear; the distance is negative inside.

    Outside the lattice: the distance at the nearest point of its box plus the way there, which is no less than the true
    one, and the sum of both gradients, of length 1.
    """
    away, n, i, f = lattice_cell(shape, point, shapes)
    inverse = 1.0 / shapes.lattices[4 * shape + 3]
    first = shapes.dims[4 * shape + 3] + (i[0] * n[1] + i[1]) * n[2] + i[2]
    row, plane = n[2], n[1] * n[2]
    d000, d001 = shapes.distances[first], shapes.distances[first + 1]
    d010, d011 = shapes.distances[first + row], shapes.distances[first + row + 1]
    d100, d101 = shapes.distances[first + plane], shapes.distances[first + plane + 1]
    d110, d111 = shapes.distances[first + plane + row], shapes.distances[first + plane + row + 1]
    e00, e01 = d000 + f[2] * (d001 - d000), d010 + f[2] * (d011 - d010)
    e10, e11 = d100 + f[2] * (d101 - d100), d110 + f[2] * (d111 - d110)
    h0, h1 = e00 + f[1] * (e01 - e00), e10 + f[1] * (e11 - e10)
    gz0 = (d001 - d000) + f[1] * ((d011 - d010) - (d001 - d000))
    gz1 = (d101 - d100) + f[1] * ((d111 - d110) - (d101 - d100))
    gradient = inverse * ti.Vector(
        [h1 - h0, (e01 - e00) + f[0] * ((e11 - e10) - (e01 - e00)), gz0 + f[0] * (gz1 - gz0)]
    )
    phi = h0 + f[0] * (h1 - h0)
    far = away.norm()
    if far > 0.0:
        phi += far
        gradient += away / far
        gradient /= ti.max(gradient.norm(), 1e-12)
    return ti.Vector([gradient[0], gradient[1], gradient[2], phi])


@func
def sample_motion(first, shape, point, shapes: ShapeArrays):
    """Velocity of the surface of ``shape``, which deforms, at ``point``, trilinear; those of its lattice begin at
    ``first``."""
    _, n, i, f = lattice_cell(shape, point, shapes)
    velocity = point * 0
    for corner in range(8):
        at = ivec3(corner >> 2, corner >> 1 & 1, corner & 1)
        weight = 1.0
        for c in ti.static(range(3)):
            weight *= ti.cast(ti.select(at[c] == 1, f[c], 1 - f[c]), ti.f32)
        place = i + at
        row = first + 3 * ((place[0] * n[1] + place[1]) * n[2] + place[2])
        for c in ti.static(range(3)):
            velocity[c] += weight * shapes.motions[row + c]
    return velocity


@func
def surface_slide(i, local, normal, bodies: RigidArrays, shapes: ShapeArrays):
    """Velocity (cells/s) along itself of the surface of ``i``, where that is a collider that deforms, at ``local``, its
    frame; ``normal``: there. Such a collider neither turns nor moves as a whole, so its axes are the world's."""
    slide = normal * 0
    if bodies.kinds[i * KINDS + LAYERS] == 2:
        shape, first = bodies.kinds[i * KINDS + SHAPE], bodies.kinds[i * KINDS + MOTION]
        nodes = shapes.dims[4 * shape] * shapes.dims[4 * shape + 1] * shapes.dims[4 * shape + 2]
        slide = sample_motion(first, shape, local, shapes)
        later = sample_motion(first + 3 * nodes, shape + 1, local, shapes)
        slide += ti.cast(bodies.state[i * STATE + BLEND], ti.f32) * (later - slide)
        slide -= slide.dot(normal) * normal
    return slide


@ti.func
def single3(array: Doubles, first: ti.i32):
    """Three numbers from ``first`` on, in single precision."""
    return vec3(ti.cast(array[first], ti.f32), ti.cast(array[first + 1], ti.f32), ti.cast(array[first + 2], ti.f32))


@func
def body_distance(i: ti.i32, place: vec3, farthest: ti.f32, bodies: RigidArrays, shapes: ShapeArrays):
    """Return the distance (cells) of ``place`` from the rigid body or collider ``i``, the normal there (world axes) and
    the rate at which a deforming surface approaches (cells/s). 1e9 beyond ``farthest`` or before its start."""
    phi, normal, swelling = 1e9, vec3(0.0, 0.0, 1.0), 0.0
    arm = place - single3(bodies.state, i * STATE + X)
    if bodies.kinds[i * KINDS + KIND] != WAITING and arm.norm() < (
        ti.cast(bodies.numbers[i * NUMBERS + RADIUS], ti.f32) + farthest
    ):
        local = vec3(0.0)
        for n in ti.static(range(3)):
            for m in ti.static(range(3)):
                local[n] += ti.cast(bodies.state[i * STATE + R + 3 * m + n], ti.f32) * arm[m]
        shape = bodies.kinds[i * KINDS + SHAPE]
        found = sample_distance(shape, local, shapes)
        if bodies.kinds[i * KINDS + LAYERS] == 2:
            later = sample_distance(shape + 1, local, shapes)
            swelling = (found[3] - later[3]) * ti.cast(bodies.numbers[i * NUMBERS + BLEND_RATE], ti.f32)
            found += ti.cast(bodies.state[i * STATE + BLEND], ti.f32) * (later - found)
        phi = found[3]
        gradient = vec3(found[0], found[1], found[2])
        gradient /= ti.max(gradient.norm(), 1e-9)
        for n in ti.static(range(3)):
            normal[n] = 0.0
            for m in ti.static(range(3)):
                normal[n] += ti.cast(bodies.state[i * STATE + R + 3 * n + m], ti.f32) * gradient[m]
    return phi, normal, swelling


@func
def body_velocity(i: ti.i32, place: vec3, bodies: RigidArrays):
    """Return the predicted velocity (cells/s) of body ``i`` at ``place`` after this substep."""
    arm = place - single3(bodies.state, i * STATE + X)
    return single3(bodies.state, i * STATE + V_NEXT) + single3(bodies.state, i * STATE + W_NEXT).cross(arm)


@func
def body_compliance(i: ti.i32, place: vec3, normal: vec3, bodies: RigidArrays):
    """Return the inverse effective mass (1/kg) of body ``i`` at ``place`` along ``normal``."""
    give = 0.0
    if bodies.kinds[i * KINDS + KIND] == DYNAMIC:
        lever = (place - single3(bodies.state, i * STATE + X)).cross(normal)
        turned = vec3(0.0)
        for n in ti.static(range(3)):
            turned[n] = single3(bodies.state, i * STATE + J + 3 * n).dot(lever)
        give = ti.cast(bodies.numbers[i * NUMBERS + INVERSE_MASS], ti.f32) + lever.dot(turned)
    return give


@func
def add_push(i: ti.i32, row: ti.i32, place: vec3, given: vec3, bodies: RigidArrays, coupling: CouplingArrays):
    """Add the impulse ``given`` at ``place`` on body ``i`` to ``coupling.pushes[row]``."""
    turn = (place - single3(bodies.state, i * STATE + X)).cross(given)
    for n in ti.static(range(3)):
        coupling.pushes[row + n] += given[n]
        coupling.pushes[row + 3 + n] += turn[n]


@func
def forget_pushes(w: ti.i32, worlds: WorldArrays, bodies: RigidArrays, coupling: CouplingArrays):
    """Set the impulses and the touching mass of the bodies of world ``w`` to 0, unless it is idle."""
    if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
        first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
        for i in range(first, first + worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
            coupling.touching[i] = 0.0
            for n in range(6):
                bodies.impulses[6 * i + n] = 0.0


@func
def gather_pushes_in_parallel(
    worlds: WorldArrays, blocks: ParticleBlocks, near: NearBlocks, bodies: RigidArrays, coupling: CouplingArrays
):
    """As ``gather_pushes``, a thread a block of particles."""
    for w in range(worlds.count):
        forget_pushes(w, worlds, bodies, coupling)
    for s in range(near.particle_count):
        w = worlds.field_integers[blocks.field[near.particle_blocks[s]] * FIELD_INTEGERS + WORLD]
        if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
            first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
            for o in range(worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
                row = (s * coupling.most_bodies + o) * PUSH
                if coupling.pushes[row + 6] > 0.0:
                    for n in range(6):
                        bodies.impulses[6 * (first + o) + n] += coupling.pushes[row + n]
                    coupling.touching[first + o] += coupling.pushes[row + 6]


@func
def gather_pushes(
    worlds: WorldArrays, blocks: ParticleBlocks, near: NearBlocks, bodies: RigidArrays, coupling: CouplingArrays
):
    """Sum the blocks' impulses on each body into ``bodies.impulses`` and the touching mass (kg) into ``touching``."""
    ti.loop_config(serialize=True)
    for w in range(worlds.count):
        forget_pushes(w, worlds, bodies, coupling)
    ti.loop_config(serialize=True)
    for s in range(near.particle_count):
        w = worlds.field_integers[blocks.field[near.particle_blocks[s]] * FIELD_INTEGERS + WORLD]
        if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
            first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
            for o in range(worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
                row = (s * coupling.most_bodies + o) * PUSH
                for n in range(6):
                    bodies.impulses[6 * (first + o) + n] += coupling.pushes[row + n]
                coupling.touching[first + o] += coupling.pushes[row + 6]
