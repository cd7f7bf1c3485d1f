# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""What a particle sees of a solid (a rigid body or a collider, see ``solid_layout``), and what the solid feels."""

import taichi as ti

from .layout import (
    CONTROL_ROW,
    FIELD_INTEGERS,
    FIRST_SOLID,
    FULL,
    PHASE,
    SOLIDS,
    WORLD,
    WORLD_INTEGERS,
    Doubles,
    Integers,
    Scalars,
    vec3,
)
from .shapes import sample_distance
from .solid_layout import (
    BLEND,
    BLEND_RATE,
    DYNAMIC,
    INVERSE_MASS,
    KIND,
    KINDS,
    LAYERS,
    NUMBERS,
    RADIUS,
    SHAPE,
    SOLID,
    V_NEXT,
    W_NEXT,
    WAITING,
    J,
    R,
    X,
)

PUSH = 8
"""Numbers that a block of particles adds to a solid: impulse (3), about its centre (3), mass at the solid, spare."""


@ti.func
def single3(array: Doubles, first: ti.i32):
    """Three numbers from ``first`` on, in single precision."""
    return vec3(ti.cast(array[first], ti.f32), ti.cast(array[first + 1], ti.f32), ti.cast(array[first + 2], ti.f32))


@ti.func
def solid_distance(
    i: ti.i32,
    place: vec3,
    farthest: ti.f32,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    shape_numbers: Scalars,
    shape_dims: Integers,
    distances: Scalars,
):
    """Distance (cells) of ``place`` from solid ``i``, its normal there (world axes) and the rate at which the surface
    comes nearer of itself (cells/s). 1e9 where it is more than ``farthest``, or the solid is not there yet."""
    phi, normal, swelling = 1e9, vec3(0.0, 0.0, 1.0), 0.0
    arm = place - single3(solids, i * SOLID + X)
    if solid_kinds[i * KINDS + KIND] != WAITING and arm.norm() < (
        ti.cast(solid_numbers[i * NUMBERS + RADIUS], ti.f32) + farthest
    ):
        local = vec3(0.0)
        for n in ti.static(range(3)):
            for m in ti.static(range(3)):
                local[n] += ti.cast(solids[i * SOLID + R + 3 * m + n], ti.f32) * arm[m]
        shape = solid_kinds[i * KINDS + SHAPE]
        found = sample_distance(shape, local, shape_numbers, shape_dims, distances)
        if solid_kinds[i * KINDS + LAYERS] == 2:
            later = sample_distance(shape + 1, local, shape_numbers, shape_dims, distances)
            swelling = (found[3] - later[3]) * ti.cast(solid_numbers[i * NUMBERS + BLEND_RATE], ti.f32)
            found += ti.cast(solids[i * SOLID + BLEND], ti.f32) * (later - found)
        phi = found[3]
        gradient = vec3(found[0], found[1], found[2])
        gradient /= ti.max(gradient.norm(), 1e-9)
        for n in ti.static(range(3)):
            normal[n] = 0.0
            for m in ti.static(range(3)):
                normal[n] += ti.cast(solids[i * SOLID + R + 3 * n + m], ti.f32) * gradient[m]
    return phi, normal, swelling


@ti.func
def solid_velocity(i: ti.i32, place: vec3, solids: Doubles):
    """Velocity (cells/s) that solid ``i`` is expected to have at ``place`` after this substep."""
    arm = place - single3(solids, i * SOLID + X)
    return single3(solids, i * SOLID + V_NEXT) + single3(solids, i * SOLID + W_NEXT).cross(arm)


@ti.func
def solid_give(i: ti.i32, place: vec3, normal: vec3, solid_kinds: Integers, solid_numbers: Doubles, solids: Doubles):
    """Velocity along ``normal`` that solid ``i`` gains at ``place`` by an impulse of 1 there, 1/kg."""
    give = 0.0
    if solid_kinds[i * KINDS + KIND] == DYNAMIC:
        lever = (place - single3(solids, i * SOLID + X)).cross(normal)
        turned = vec3(0.0)
        for n in ti.static(range(3)):
            turned[n] = single3(solids, i * SOLID + J + 3 * n).dot(lever)
        give = ti.cast(solid_numbers[i * NUMBERS + INVERSE_MASS], ti.f32) + lever.dot(turned)
    return give


@ti.func
def add_push(i: ti.i32, row: ti.i32, place: vec3, given: vec3, solids: Doubles, pushes: Scalars):
    """Note in ``pushes[row]`` that solid ``i`` was given the impulse ``given`` at ``place``."""
    turn = (place - single3(solids, i * SOLID + X)).cross(given)
    for n in ti.static(range(3)):
        pushes[row + n] += given[n]
        pushes[row + 3 + n] += turn[n]


@ti.func
def gather_pushes(
    world_count: ti.i32,
    near_blocks: ti.i32,
    most_solids: ti.i32,
    near_p: Integers,
    p_field: Integers,
    field_integers: Integers,
    world_integers: Integers,
    control: Doubles,
    pushes: Scalars,
    impulses: Doubles,
    touching: Scalars,
):
    """Sum what the blocks' particles did to each solid into ``impulses`` (see ``rigid``) and ``touching`` (kg)."""
    ti.loop_config(serialize=True)
    for w in range(world_count):
        if control[w * CONTROL_ROW + PHASE] == FULL:
            first = world_integers[w * WORLD_INTEGERS + FIRST_SOLID]
            for i in range(first, first + world_integers[w * WORLD_INTEGERS + SOLIDS]):
                touching[i] = 0.0
                for n in range(6):
                    impulses[6 * i + n] = 0.0
    ti.loop_config(serialize=True)
    for s in range(near_blocks):
        w = field_integers[p_field[near_p[s]] * FIELD_INTEGERS + WORLD]
        if control[w * CONTROL_ROW + PHASE] == FULL:
            first = world_integers[w * WORLD_INTEGERS + FIRST_SOLID]
            for o in range(world_integers[w * WORLD_INTEGERS + SOLIDS]):
                row = (s * most_solids + o) * PUSH
                for n in range(6):
                    impulses[6 * (first + o) + n] += pushes[row + n]
                touching[first + o] += pushes[row + 6]
