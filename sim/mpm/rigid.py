# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Rigid bodies and colliders over one substep: forces, contact (``rigid_contact``, ``rigid_solve``), motion.

The angular momentum is the state and the angular velocity follows from it, so that free flight keeps it exactly; the
orientation follows the angular velocity at the middle of the substep. Arrays are described in ``solid_layout``.
"""

import taichi as ti

from .layout import Integers, Scalars
from .rigid_contact import find_contacts, gather_points
from .rigid_math import Doubles, dvec3, dvec4, load3, load33, matrix_of, store3, store33, turned
from .rigid_solve import SETTLED, SWEEPS, finish, prepare, sweep, warm
from .solid_layout import (
    ACCELERATION,
    BLEND,
    BLEND_RATE,
    DRAG,
    DYNAMIC,
    GRAVITY,
    GRAVITY_FACTOR,
    INVERSE_INERTIA,
    INVERSE_MASS,
    KIND,
    KINDS,
    KINEMATIC,
    LIFT,
    NUMBERS,
    PUSH_V,
    PUSH_W,
    REPORT,
    SOLID,
    SPANS,
    SPIN_UP,
    TETHER_ANCHOR,
    TETHER_LENGTH,
    TETHER_STIFFNESS,
    TETHER_STRING,
    TOUCHED,
    UNIFORM,
    V_BEFORE,
    V_NEXT,
    W_BEFORE,
    W_NEXT,
    WIND,
    WORLD,
    J,
    L,
    Q,
    R,
    V,
    W,
    X,
)


@ti.func
def predict(w, dt, world_spans: Integers, solids: Doubles):
    """Expect of all solids of world ``w`` that they speed up over ``dt`` as they did in the last substep."""
    for i in range(world_spans[w * SPANS], world_spans[w * SPANS + 1]):
        for c in ti.static(range(3)):
            solids[i * SOLID + V_NEXT + c] = solids[i * SOLID + V + c] + dt * solids[i * SOLID + ACCELERATION + c]
            solids[i * SOLID + W_NEXT + c] = solids[i * SOLID + W + c] + dt * solids[i * SOLID + SPIN_UP + c]


@ti.func
def act(
    w, i, dt, world_numbers: Doubles, solid_kinds: Integers, solid_numbers: Doubles, solids: Doubles, impulses: Doubles
):
    """Forces on solid ``i`` over ``dt`` and the impulses that matter gave it, which are used up."""
    r, n = i * SOLID, i * NUMBERS
    inverse = solid_numbers[n + INVERSE_MASS]
    velocity, spin = load3(solids, r + V), load3(solids, r + W)
    store3(solids, r + V_BEFORE, velocity)
    store3(solids, r + W_BEFORE, spin)
    store3(solids, r + PUSH_V, dvec3(0.0))
    store3(solids, r + PUSH_W, dvec3(0.0))
    solids[r + TOUCHED] = 0
    if solid_kinds[i * KINDS + KIND] == DYNAMIC:
        wind = load3(solid_numbers, n + WIND)
        relative = velocity - wind
        # Lift turns the velocity about the spin, drag shortens it: both exactly, hence stable at any strength.
        angle = solid_numbers[n + LIFT] * dt * spin.norm()
        if angle != 0.0:
            axis = spin / spin.norm()
            along = axis.dot(relative) * axis
            relative = along + ti.cos(angle) * (relative - along) + ti.sin(angle) * axis.cross(relative)
        velocity = wind + relative / (1 + solid_numbers[n + DRAG] * dt * relative.norm())
        gravity = load3(world_numbers, w * WORLD + GRAVITY)
        pull = solid_numbers[n + GRAVITY_FACTOR] * gravity + load3(solid_numbers, n + UNIFORM)
        tether = load3(solid_numbers, n + TETHER_ANCHOR) - load3(solids, r + X)
        reach = tether.norm()
        stretch = reach - solid_numbers[n + TETHER_LENGTH]
        if reach > 0.0 and (stretch > 0.0 or solid_numbers[n + TETHER_STRING] < 0.5):
            pull += solid_numbers[n + TETHER_STIFFNESS] * stretch / reach * tether
        given, turn = load3(impulses, 6 * i), load3(impulses, 6 * i + 3)
        velocity += dt * pull + inverse * given
        momentum = load3(solids, r + L) + turn
        store3(solids, r + V, velocity)
        store3(solids, r + L, momentum)
        store3(solids, r + W, load33(solids, r + J) @ momentum)
        solids[r + TOUCHED] = ti.select(given.norm() + turn.norm() > 0.0, 1, 0)
    for c in range(6):
        impulses[6 * i + c] = 0


@ti.func
def move(w, i, dt, world_numbers: Doubles, solid_kinds: Integers, solid_numbers: Doubles, solids: Doubles):
    """Place, orientation and what follows from them at the end of the substep."""
    r, n = i * SOLID, i * NUMBERS
    kind = solid_kinds[i * KINDS + KIND]
    velocity, spin = load3(solids, r + V), load3(solids, r + W)
    q = dvec4(solids[r + Q], solids[r + Q + 1], solids[r + Q + 2], solids[r + Q + 3])
    way = dt * velocity
    middle = spin
    momentum = load3(solids, r + L)
    before = load3(solids, r + W_BEFORE)
    inverse = load33(solid_numbers, n + INVERSE_INERTIA)
    if kind == DYNAMIC:
        way += dt * load3(solids, r + PUSH_V)
        if solids[r + TOUCHED] == 0.0:
            # The velocity at the middle of the substep is less by half of what steady forces added.
            pull = solid_numbers[n + GRAVITY_FACTOR] * load3(world_numbers, w * WORLD + GRAVITY)
            way -= dt * dt / 2 * (pull + load3(solid_numbers, n + UNIFORM))
        keeps = ti.select(solids[r + TOUCHED] > 1.5, 0, 1)
        store3(solids, r + ACCELERATION, keeps * (velocity - load3(solids, r + V_BEFORE)) / dt)
        spin = load33(solids, r + J) @ momentum
        half = matrix_of(turned(q, dt / 2 * spin))
        middle = half @ (inverse @ (half.transpose() @ momentum)) + load3(solids, r + PUSH_W)
    store3(solids, r + X, load3(solids, r + X) + way)
    q = turned(q, dt * middle)
    for c in ti.static(range(4)):
        solids[r + Q + c] = q[c]
    turn = matrix_of(q)
    store33(solids, r + R, turn)
    if kind == DYNAMIC:
        world_inverse = turn @ inverse @ turn.transpose()
        store33(solids, r + J, world_inverse)
        spin = world_inverse @ momentum
        store3(solids, r + W, spin)
        store3(solids, r + SPIN_UP, ti.select(solids[r + TOUCHED] > 1.5, 0, 1) * (spin - before) / dt)
    solids[r + BLEND] = ti.min(solids[r + BLEND] + dt * solid_numbers[n + BLEND_RATE], 1)


@ti.func
def push_and_search(
    w,
    dt,
    world_spans: Integers,
    world_numbers: Doubles,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    impulses: Doubles,
    clusters: Scalars,
    cluster_starts: Integers,
    points: Scalars,
    shape_numbers: Scalars,
    shape_dims: Integers,
    distances: Scalars,
    pairs: Integers,
    pair_numbers: Doubles,
    counts: Integers,
    contacts: Doubles,
    memory: Doubles,
    reaches: Doubles,
    scores: Doubles,
    chosen: Integers,
):
    """First half of a substep of world ``w``: what acts on its solids over ``dt`` (f64, s), and where they touch.

    impulses, six a solid: momentum and angular momentum about the centre of mass that matter gave it in this substep,
    kg cells/s and kg cells²/s. Set to 0 here.
    """
    for i in range(world_spans[w * SPANS], world_spans[w * SPANS + 1]):
        act(w, i, dt, world_numbers, solid_kinds, solid_numbers, solids, impulses)
    for p in range(world_spans[w * SPANS + 2], world_spans[w * SPANS + 3]):
        gather_points(
            w,
            p,
            dt,
            world_numbers,
            solid_kinds,
            solid_numbers,
            solids,
            clusters,
            cluster_starts,
            points,
            shape_numbers,
            shape_dims,
            distances,
            pairs,
            pair_numbers,
            reaches,
            scores,
            chosen,
        )
        find_contacts(
            w,
            p,
            world_numbers,
            solid_kinds,
            solid_numbers,
            solids,
            points,
            shape_numbers,
            shape_dims,
            distances,
            pairs,
            counts,
            contacts,
            memory,
            reaches,
            chosen,
        )


@ti.func
def solve_and_move(
    w,
    dt,
    world_spans: Integers,
    world_numbers: Doubles,
    world_report: Doubles,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    pairs: Integers,
    pair_numbers: Doubles,
    counts: Integers,
    contacts: Doubles,
    memory: Doubles,
):
    """Second half: the impulses between the solids of world ``w`` that touch, and their motion over ``dt``."""
    first_pair, end_pair = world_spans[w * SPANS + 2], world_spans[w * SPANS + 3]
    for c in range(REPORT):
        world_report[w * REPORT + c] = 0
    for p in range(first_pair, end_pair):
        prepare(w, dt, p, world_numbers, solid_numbers, solids, pairs, pair_numbers, counts, contacts)
    for p in range(first_pair, end_pair):
        warm(p, solid_numbers, solids, pairs, counts, contacts)
    settled = SETTLED * (dt * load3(world_numbers, w * WORLD + GRAVITY).norm()) + 1e-7
    worst = settled + 1
    sweeps = 0
    while sweeps < SWEEPS and worst > settled:
        worst = 0
        for p in range(first_pair, end_pair):
            worst = ti.max(worst, sweep(p, solid_numbers, solids, pairs, pair_numbers, counts, contacts))
        sweeps += 1
    world_report[w * REPORT + 2] = sweeps
    for p in range(first_pair, end_pair):
        finish(w, p, solids, pairs, counts, contacts, memory, world_report)
    for i in range(world_spans[w * SPANS], world_spans[w * SPANS + 1]):
        kind = solid_kinds[i * KINDS + KIND]
        if kind == DYNAMIC or kind == KINEMATIC:  # noqa: SIM109 (Taichi has no tuples)
            move(w, i, dt, world_numbers, solid_kinds, solid_numbers, solids)


@ti.kernel
def search_worlds(
    worlds: ti.i32,
    steps: Doubles,
    world_spans: Integers,
    world_numbers: Doubles,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    impulses: Doubles,
    clusters: Scalars,
    cluster_starts: Integers,
    points: Scalars,
    shape_numbers: Scalars,
    shape_dims: Integers,
    distances: Scalars,
    pairs: Integers,
    pair_numbers: Doubles,
    counts: Integers,
    contacts: Doubles,
    memory: Doubles,
    reaches: Doubles,
    scores: Doubles,
    chosen: Integers,
):
    """``push_and_search`` in all worlds, ``steps[w]`` seconds in world w. Kernels of their own compile much faster than
    the same code in a larger one: Taichi's passes take time in proportion to the square of a kernel's length."""
    ti.loop_config(serialize=True)
    for w in range(worlds):
        if steps[w] > 0.0:
            push_and_search(
                w,
                steps[w],
                world_spans,
                world_numbers,
                solid_kinds,
                solid_numbers,
                solids,
                impulses,
                clusters,
                cluster_starts,
                points,
                shape_numbers,
                shape_dims,
                distances,
                pairs,
                pair_numbers,
                counts,
                contacts,
                memory,
                reaches,
                scores,
                chosen,
            )


@ti.kernel
def move_worlds(
    worlds: ti.i32,
    steps: Doubles,
    world_spans: Integers,
    world_numbers: Doubles,
    world_report: Doubles,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    pairs: Integers,
    pair_numbers: Doubles,
    counts: Integers,
    contacts: Doubles,
    memory: Doubles,
):
    """``solve_and_move`` in all worlds."""
    ti.loop_config(serialize=True)
    for w in range(worlds):
        if steps[w] > 0.0:
            solve_and_move(
                w,
                steps[w],
                world_spans,
                world_numbers,
                world_report,
                solid_kinds,
                solid_numbers,
                solids,
                pairs,
                pair_numbers,
                counts,
                contacts,
                memory,
            )
