# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Rigid bodies and colliders over one substep: forces, contact (``rigid_contact``, ``rigid_solver``), motion.

The angular momentum is the state and the angular velocity follows from it, so that free flight keeps it exactly; the
orientation follows the angular velocity at the middle of the substep. ``rigid_layout`` names the columns of the arrays.
"""

import taichi as ti

from ..kernels.kernel_arrays import RigidArrays, RigidContacts, ShapeArrays, StepLimits, WorldArrays
from ..kernels.kernel_bundles import BundledKernel, func, kernel
from ..kernels.layout import CONTROL_ROW, FULL, IDLE, PHASE, STEP
from ..kernels.time_stepping import forget_reports, settle
from .rigid_contact import find_contacts, gather_points
from .rigid_direct import solve_together
from .rigid_layout import (
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
    SPANS,
    SPIN_UP,
    STATE,
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
from .rigid_math import dvec3, dvec4, load3, load33, matrix_of, store3, store33, turned
from .rigid_solver import ALONE, SETTLED, SWEEPS, finish, prepare, sweep, warm

SWEPT, WORST = 2, 4
"""Columns of ``report``: sweeps done, and the largest change of velocity in the last of them."""

ITERATIONS = 512
"""Loop iterations spent on one world: Taichi's CPU backend gives a thread at least so many at a time."""


@func
def predict(w, dt, bodies: RigidArrays):
    """Predict velocities of all bodies of world ``w`` after ``dt``, from their accelerations in the last substep."""
    for i in range(bodies.spans[w * SPANS], bodies.spans[w * SPANS + 1]):
        for c in ti.static(range(3)):
            bodies.state[i * STATE + V_NEXT + c] = (
                bodies.state[i * STATE + V + c] + dt * bodies.state[i * STATE + ACCELERATION + c]
            )
            bodies.state[i * STATE + W_NEXT + c] = (
                bodies.state[i * STATE + W + c] + dt * bodies.state[i * STATE + SPIN_UP + c]
            )


@func
def act(w, i, dt, bodies: RigidArrays):
    """Apply forces over ``dt`` and the particles' impulses to body ``i``; the impulses are set to 0."""
    r, n = i * STATE, i * NUMBERS
    inverse = bodies.numbers[n + INVERSE_MASS]
    velocity, spin = load3(bodies.state, r + V), load3(bodies.state, r + W)
    store3(bodies.state, r + V_BEFORE, velocity)
    store3(bodies.state, r + W_BEFORE, spin)
    store3(bodies.state, r + PUSH_V, dvec3(0.0))
    store3(bodies.state, r + PUSH_W, dvec3(0.0))
    bodies.state[r + TOUCHED] = 0
    if bodies.kinds[i * KINDS + KIND] == DYNAMIC:
        wind = load3(bodies.numbers, n + WIND)
        relative = velocity - wind
        # Lift turns the velocity about the spin, drag shortens it: both exactly, hence stable at any strength.
        angle = bodies.numbers[n + LIFT] * dt * spin.norm()
        if angle != 0.0:
            axis = spin / spin.norm()
            along = axis.dot(relative) * axis
            relative = along + ti.cos(angle) * (relative - along) + ti.sin(angle) * axis.cross(relative)
        velocity = wind + relative / (1 + bodies.numbers[n + DRAG] * dt * relative.norm())
        gravity = load3(bodies.world_numbers, w * WORLD + GRAVITY)
        pull = bodies.numbers[n + GRAVITY_FACTOR] * gravity + load3(bodies.numbers, n + UNIFORM)
        tether = load3(bodies.numbers, n + TETHER_ANCHOR) - load3(bodies.state, r + X)
        reach = tether.norm()
        stretch = reach - bodies.numbers[n + TETHER_LENGTH]
        if reach > 0.0 and (stretch > 0.0 or bodies.numbers[n + TETHER_STRING] < 0.5):
            pull += bodies.numbers[n + TETHER_STIFFNESS] * stretch / reach * tether
        given, turn = load3(bodies.impulses, 6 * i), load3(bodies.impulses, 6 * i + 3)
        velocity += dt * pull + inverse * given
        momentum = load3(bodies.state, r + L) + turn
        store3(bodies.state, r + V, velocity)
        store3(bodies.state, r + L, momentum)
        store3(bodies.state, r + W, load33(bodies.state, r + J) @ momentum)
        bodies.state[r + TOUCHED] = ti.select(given.norm() + turn.norm() > 0.0, 1, 0)
    for c in range(6):
        bodies.impulses[6 * i + c] = 0


@func
def move(w, i, dt, bodies: RigidArrays):
    """Update position and orientation at the end of the substep, and what follows from them."""
    r, n = i * STATE, i * NUMBERS
    kind = bodies.kinds[i * KINDS + KIND]
    velocity, spin = load3(bodies.state, r + V), load3(bodies.state, r + W)
    q = dvec4(bodies.state[r + Q], bodies.state[r + Q + 1], bodies.state[r + Q + 2], bodies.state[r + Q + 3])
    way = dt * velocity
    middle = spin
    momentum = load3(bodies.state, r + L)
    before = load3(bodies.state, r + W_BEFORE)
    inverse = load33(bodies.numbers, n + INVERSE_INERTIA)
    if kind == DYNAMIC:
        way += dt * load3(bodies.state, r + PUSH_V)
        if bodies.state[r + TOUCHED] == 0.0:
            # The velocity at the middle of the substep is less by half of what steady forces added.
            pull = bodies.numbers[n + GRAVITY_FACTOR] * load3(bodies.world_numbers, w * WORLD + GRAVITY)
            way -= dt * dt / 2 * (pull + load3(bodies.numbers, n + UNIFORM))
        keeps = ti.select(bodies.state[r + TOUCHED] > 1.5, 0, 1)
        store3(bodies.state, r + ACCELERATION, keeps * (velocity - load3(bodies.state, r + V_BEFORE)) / dt)
        spin = load33(bodies.state, r + J) @ momentum
        half = matrix_of(turned(q, dt / 2 * spin))
        middle = half @ (inverse @ (half.transpose() @ momentum)) + load3(bodies.state, r + PUSH_W)
    store3(bodies.state, r + X, load3(bodies.state, r + X) + way)
    q = turned(q, dt * middle)
    for c in ti.static(range(4)):
        bodies.state[r + Q + c] = q[c]
    turn = matrix_of(q)
    store33(bodies.state, r + R, turn)
    if kind == DYNAMIC:
        world_inverse = turn @ inverse @ turn.transpose()
        store33(bodies.state, r + J, world_inverse)
        spin = world_inverse @ momentum
        store3(bodies.state, r + W, spin)
        store3(bodies.state, r + SPIN_UP, ti.select(bodies.state[r + TOUCHED] > 1.5, 0, 1) * (spin - before) / dt)
    bodies.state[r + BLEND] = ti.min(bodies.state[r + BLEND] + dt * bodies.numbers[n + BLEND_RATE], 1)


@func
def settled_change(w, dt, bodies: RigidArrays):
    """Change of velocity (cells/s) in a sweep of world ``w`` below which its contacts count as solved."""
    return SETTLED * (dt * load3(bodies.world_numbers, w * WORLD + GRAVITY).norm()) + 1e-7


@func
def push_and_search(w, dt, bodies: RigidArrays, shapes: ShapeArrays, contacts: RigidContacts):
    """Forces on the bodies of world ``w`` over ``dt`` (f64, s), and contact search."""
    for i in range(bodies.spans[w * SPANS], bodies.spans[w * SPANS + 1]):
        act(w, i, dt, bodies)
    for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
        gather_points(w, p, dt, bodies, shapes, contacts)
        find_contacts(w, p, bodies, shapes, contacts)


@func
def prepare_contacts(w, dt, bodies: RigidArrays, contacts: RigidContacts):
    """Effective masses and targets of the contacts, and the impulses of the last substep."""
    for c in range(REPORT):
        bodies.report[w * REPORT + c] = 0
    bodies.report[w * REPORT + WORST] = settled_change(w, dt, bodies) + 1
    for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
        prepare(w, dt, p, bodies, contacts)
    for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
        warm(p, bodies, contacts)


@func
def sweep_contacts(w, dt, most, bodies: RigidArrays, contacts: RigidContacts):
    """Gauss-Seidel sweeps until the contacts are solved, at most ``most`` in all."""
    settled = settled_change(w, dt, bodies)
    worst = bodies.report[w * REPORT + WORST]
    sweeps = ti.cast(bodies.report[w * REPORT + SWEPT], ti.i32)
    while sweeps < most and worst > settled:
        worst = 0
        for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
            worst = ti.max(worst, sweep(p, bodies, contacts))
        sweeps += 1
    bodies.report[w * REPORT + WORST] = worst
    bodies.report[w * REPORT + SWEPT] = sweeps


@func
def finish_and_move(w, dt, bodies: RigidArrays, contacts: RigidContacts):
    """Momentum from the impulses, and motion over ``dt``."""
    for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
        finish(w, p, bodies, contacts)
    for i in range(bodies.spans[w * SPANS], bodies.spans[w * SPANS + 1]):
        kind = bodies.kinds[i * KINDS + KIND]
        if kind == DYNAMIC or kind == KINEMATIC:  # noqa: SIM109 (Taichi has no tuples)
            move(w, i, dt, bodies)


@kernel
def search_worlds(bodies: RigidArrays, shapes: ShapeArrays, contacts: RigidContacts):
    """``push_and_search`` in all worlds, ``steps[w]`` seconds in world w, as all kernels that follow. Each is short:
    Taichi's passes take time in proportion to the square of a kernel's length."""
    ti.loop_config(serialize=True)
    for w in range(bodies.world_count):
        if bodies.steps[w] > 0.0:
            push_and_search(w, bodies.steps[w], bodies, shapes, contacts)


@kernel
def prepare_worlds(bodies: RigidArrays, contacts: RigidContacts):
    """``prepare_contacts`` in all worlds."""
    ti.loop_config(serialize=True)
    for w in range(bodies.world_count):
        if bodies.steps[w] > 0.0:
            prepare_contacts(w, bodies.steps[w], bodies, contacts)


@kernel
def sweep_worlds(bodies: RigidArrays, contacts: RigidContacts):
    """``sweep_contacts`` in all worlds: at most ALONE the first time, SWEEPS in all."""
    ti.loop_config(serialize=True)
    for w in range(bodies.world_count):
        if bodies.steps[w] > 0.0:
            most = ti.select(bodies.report[w * REPORT + SWEPT] < ALONE, ALONE, SWEEPS)
            sweep_contacts(w, bodies.steps[w], most, bodies, contacts)


@kernel
def solve_worlds(bodies: RigidArrays, contacts: RigidContacts):
    """All contacts at once, of worlds with arrays for it whose contacts sweeps have not solved."""
    ti.loop_config(serialize=True)
    for w in range(bodies.world_count):
        if bodies.steps[w] > 0.0 and bodies.spans[w * SPANS + 5] >= 0:
            settled = settled_change(w, bodies.steps[w], bodies)
            if bodies.report[w * REPORT + WORST] > settled:
                solve_together(w, settled, bodies, contacts)


@kernel
def move_worlds(bodies: RigidArrays, contacts: RigidContacts):
    """``finish_and_move`` in all worlds."""
    ti.loop_config(serialize=True)
    for w in range(bodies.world_count):
        if bodies.steps[w] > 0.0:
            finish_and_move(w, bodies.steps[w], bodies, contacts)


def rigid_substep(*, together: bool) -> list[BundledKernel]:
    """The kernels of a substep of all worlds; ``together``: some may solve all contacts at once."""
    solving = [sweep_worlds, solve_worlds, sweep_worlds] if together else [sweep_worlds, sweep_worlds]
    return [search_worlds, prepare_worlds, *solving, move_worlds]


@kernel
def carry_colliders(dt: ti.f64, bodies: RigidArrays):
    """Colliders that move to the end of a step of ``dt`` s, in which no rigid body does."""
    ti.loop_config(serialize=True)
    for w in range(bodies.world_count):
        for i in range(bodies.spans[w * SPANS], bodies.spans[w * SPANS + 1]):
            if bodies.kinds[i * KINDS + KIND] == KINEMATIC:
                move(w, i, dt, bodies)


@kernel
def advance_bodies(
    limits: StepLimits, worlds: WorldArrays, bodies: RigidArrays, shapes: ShapeArrays, contacts: RigidContacts
):
    """Take every world that is not idle to the end of its segment of time; of worlds that hold no particles and solve
    no contacts together: with that in it, the kernel took a minute to compile.

    All substeps in one launch, where a launch costs more than many substeps. They are the same, to the last bit, as
    those that ``substep`` takes one by one.
    """
    for ww in range(worlds.count * ITERATIONS):
        if ww % ITERATIONS == 0:
            w = ww // ITERATIONS
            while worlds.control[w * CONTROL_ROW + PHASE] != IDLE:
                if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                    step = worlds.control[w * CONTROL_ROW + STEP]
                    predict(w, step, bodies)
                    push_and_search(w, step, bodies, shapes, contacts)
                    prepare_contacts(w, step, bodies, contacts)
                    sweep_contacts(w, step, SWEEPS, bodies, contacts)
                    finish_and_move(w, step, bodies, contacts)
                forget_reports(True, w, worlds, bodies)
                settle(w, limits, worlds)
