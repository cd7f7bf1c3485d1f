# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""All contacts of a world solved together: what Gauss-Seidel sweeps alone do not reach in stacks.

A tower bends like a beam, and a sweep passes a change on by one neighbour: n bodies need sweeps in proportion to n^4.
Here the unknowns are the six velocities of every body. They are where this is least, with v0 the velocities without
contact impulses and e what the velocity at a contact lacks of its target (normal), of 0 (along the surface, rolling):

    1/2 (v - v0) M (v - v0) + sum of  s/2 e^2           along the normal where contacts press, and where they hold
                                      r |e| - r^2/(2s)  where s |e| > r: they slide or roll, r = mu times the load

Its gradient is the balance of momentum with impulses s e and r, s = STIFFNESS / K, K being the velocity that an impulse
of 1 makes at the contact alone: contacts give by so little that repeated ones do no harm, and share the load. Newton's
method with backtracking, as in MuJoCo (Todorov 2014); then r follows, a few times. Along the surface a parabola that
touches the function and lies above it takes the place of its second derivatives (weight s min(1, r / s |e|)): these
vanish where a contact slides, and steps along them went too far. One Cholesky factorisation a step within the
rows' first entries, so that a stack costs in proportion to its height. The sweeps that follow judge the result.
"""

import taichi as ti

from ..kernels.kernel_arrays import RigidArrays, RigidContacts
from ..kernels.kernel_bundles import func
from .rigid_layout import (
    ARM_A,
    ARM_B,
    BOTH_WAYS,
    CONTACT,
    DRIFT,
    DYNAMIC,
    FRICTION,
    IMPULSE,
    INERTIA,
    INVERSE_MASS,
    KIND,
    KINDS,
    KN,
    KR,
    KT,
    LEVER,
    LIMIT,
    MASS,
    NORMAL,
    NUMBERS,
    PAIRS,
    REPORT,
    ROLL,
    ROW,
    RUB,
    SLOTS,
    SPANS,
    STATE,
    TARGET,
    J,
    R,
    V,
    W,
)
from .rigid_math import dvec3, load3, load33, store3

STIFFNESS = 1e5
"""Weight of a wrong velocity at a contact against a change of the bodies' motion: contacts give by a hundred
thousandth of the velocity that their impulse makes."""

ROUNDS = 3
"""Times that the limits of friction follow the loads."""

NEWTON_STEPS = 8
"""Most steps of Newton's method for the same limits; each has a factorisation."""

BACK = 10
"""Times that a step which gains nothing is halved."""

CLOSE = 0.1
"""Share of the change that counts as converged in sweeps below which a step ends Newton's method."""


@func
def kick(i, row_v, row_w, impulse, moment, bodies: RigidArrays):
    """Add an impulse and an angular impulse to the velocities at ``row_v`` and ``row_w`` of body ``i``."""
    for c in ti.static(range(3)):
        bodies.state[i * STATE + row_v + c] += bodies.numbers[i * NUMBERS + INVERSE_MASS] * impulse[c]
    turn = load33(bodies.state, i * STATE + J) @ moment
    for c in ti.static(range(3)):
        bodies.state[i * STATE + row_w + c] += turn[c]


@func
def unknown(w, i, bodies: RigidArrays):
    """First of the six unknowns of body ``i`` of world ``w``; -1 for what does not move freely, and for the plane."""
    found = -1
    if i >= 0:
        if bodies.kinds[i * KINDS + KIND] == DYNAMIC:
            found = 6 * (i - bodies.spans[w * SPANS])
    return found


@func
def add_equation(ia, ib, n, scratch, direction, ra, rb, turning, weight, impulse, contacts: RigidContacts):
    """Add ``weight`` times the square of a velocity to the matrix and its ``impulse`` to the right side: that along
    ``direction`` of body a at arm ``ra`` less that of b at ``rb``, or for ``turning`` 1 of turning about it."""
    row = scratch + n * n + 3 * n
    for d in range(2):
        arm = ti.select(d == 0, ra, rb)
        sign = ti.select(d == 0, 1, -1)
        store3(contacts.systems, row + 6 * d, sign * (1 - turning) * direction)
        store3(contacts.systems, row + 6 * d + 3, sign * ti.select(turning == 1, direction, arm.cross(direction)))
    for d in range(2):
        i = ti.select(d == 0, ia, ib)
        if i >= 0:
            for r in range(6):
                entry = contacts.systems[row + 6 * d + r]
                contacts.systems[scratch + n * n + i + r] += entry * impulse
                entry *= weight
                for e in range(2):
                    j = ti.select(e == 0, ia, ib)
                    if j >= 0 and j <= i:
                        for c in range(6):
                            if j + c <= i + r:
                                contacts.systems[scratch + (i + r) * n + j + c] += (
                                    entry * contacts.systems[row + 6 * e + c]
                                )


@func
def slip_of(a, b, c, bodies: RigidArrays, contacts: RigidContacts):
    """Velocity of a less that of b at the contact at ``c``, and the difference of their rates of turning."""
    ra, rb = load3(contacts.rows, c + ARM_A), load3(contacts.rows, c + ARM_B)
    spin = load3(bodies.state, a * STATE + W)
    u = load3(bodies.state, a * STATE + V) + spin.cross(ra) - load3(contacts.rows, c + DRIFT)
    if b >= 0:
        other = load3(bodies.state, b * STATE + W)
        u -= load3(bodies.state, b * STATE + V) + other.cross(rb)
        spin -= other
    return u, spin


@func
def tangent(n):
    """A unit vector across ``n``."""
    first = n.cross(ti.select(ti.abs(n[0]) < 0.6, dvec3(1.0, 0.0, 0.0), dvec3(0.0, 1.0, 0.0)))
    return first / first.norm()


@func
def loads_of(a, b, c, bodies: RigidArrays, contacts: RigidContacts):
    """Impulses of the contact at ``c`` at the present velocities, without limits: along the normal, along the
    surface (3), against rolling (3)."""
    n = load3(contacts.rows, c + NORMAL)
    u, spin = slip_of(a, b, c, bodies, contacts)
    press = STIFFNESS * (contacts.rows[c + TARGET] - u.dot(n)) / contacts.rows[c + KN]
    if contacts.rows[c + BOTH_WAYS] < 0.5:
        press = ti.max(press, 0)
    rub = -STIFFNESS / contacts.rows[c + KT] * (u - u.dot(n) * n)
    roll = -STIFFNESS / ti.max(contacts.rows[c + KR], 1e-30) * (spin - spin.dot(n) * n)
    return press, rub, roll


@func
def set_limits(w, bodies: RigidArrays, contacts: RigidContacts):
    """Limits of friction and of rolling resistance from the impulses that the contacts of world ``w`` have."""
    for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
        lever = contacts.pair_numbers[contacts.pairs[p * PAIRS + 3] * CONTACT + LEVER]
        for s in range(contacts.counts[p]):
            c = (p * SLOTS + s) * ROW
            press = ti.max(contacts.rows[c + IMPULSE], 0)
            sticky = contacts.rows[c + FRICTION] > 1e20
            contacts.rows[c + LIMIT] = ti.select(sticky, 1e30, contacts.rows[c + FRICTION] * press)
            contacts.rows[c + LIMIT + 1] = lever * press


@func
def set_impulses(w, bodies: RigidArrays, contacts: RigidContacts):
    """Impulses at the present velocities, within the limits, into the contacts of world ``w``."""
    for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
        a, b = contacts.pairs[p * PAIRS], contacts.pairs[p * PAIRS + 1]
        for s in range(contacts.counts[p]):
            c = (p * SLOTS + s) * ROW
            press, rub, roll = loads_of(a, b, c, bodies, contacts)
            contacts.rows[c + IMPULSE] = press
            store3(contacts.rows, c + RUB, ti.min(1, contacts.rows[c + LIMIT] / ti.max(rub.norm(), 1e-30)) * rub)
            store3(contacts.rows, c + ROLL, ti.min(1, contacts.rows[c + LIMIT + 1] / ti.max(roll.norm(), 1e-30)) * roll)


@func
def assemble(w, n, scratch, bodies: RigidArrays, contacts: RigidContacts):
    """Matrix, right side and first entries of the rows for a step of Newton's from the present velocities."""
    first_body = bodies.spans[w * SPANS]
    for r in range(n):
        for c in range(r + 1):
            contacts.systems[scratch + r * n + c] = 0
        contacts.systems[scratch + n * n + n + r] = r - r % 6
    for k in range(n // 6):
        i, side = first_body + k, scratch + n * n + 6 * k
        turn = load33(bodies.state, i * STATE + R)
        inertia = turn @ load33(bodies.numbers, i * NUMBERS + INERTIA) @ turn.transpose()
        mass = bodies.numbers[i * NUMBERS + MASS]
        free = load3(contacts.systems, side + 2 * n)
        store3(contacts.systems, side, mass * (free - load3(bodies.state, i * STATE + V)))
        free = load3(contacts.systems, side + 2 * n + 3)
        store3(contacts.systems, side + 3, inertia @ (free - load3(bodies.state, i * STATE + W)))
        for r in range(3):
            contacts.systems[scratch + (6 * k + r) * (n + 1)] = mass
        for r in ti.static(range(3)):
            for c in ti.static(range(r + 1)):
                contacts.systems[scratch + (6 * k + 3 + r) * n + 6 * k + 3 + c] = inertia[r, c]
    for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
        a, b = contacts.pairs[p * PAIRS], contacts.pairs[p * PAIRS + 1]
        ia, ib = unknown(w, a, bodies), unknown(w, b, bodies)
        low = ti.cast(ti.select(ia < 0, ib, ti.select(ib < 0, ia, ti.min(ia, ib))), ti.f64)
        for s in range(contacts.counts[p]):
            c = (p * SLOTS + s) * ROW
            press, rub, roll = loads_of(a, b, c, bodies, contacts)
            normal = load3(contacts.rows, c + NORMAL)
            if press != 0.0:
                for d in range(2):
                    i = ti.select(d == 0, ia, ib)
                    if i >= 0:
                        for r in range(6):
                            place = scratch + n * n + n + i + r
                            contacts.systems[place] = ti.min(contacts.systems[place], low)
                # The normal, then two directions along the surface and two of rolling, the first that of the motion.
                for k in range(5):
                    load = ti.select(k < 3, rub, roll)
                    limit = contacts.rows[c + LIMIT + ti.select(k < 3, 0, 1)]
                    size = load.norm()
                    first = tangent(normal)
                    if size > limit:
                        first = load / size
                    direction = ti.select(k == 0, normal, ti.select(k % 2 == 1, first, normal.cross(first)))
                    weight = STIFFNESS / contacts.rows[c + ti.select(k == 0, KN, ti.select(k < 3, KT, KR))]
                    impulse = ti.select(k == 0, press, load.dot(direction))
                    if k > 0 and size > limit:
                        impulse = ti.select(k % 2 == 1, limit, 0)
                        weight *= limit / size
                    if k == 0 or limit > 0.0:
                        ra, rb = load3(contacts.rows, c + ARM_A), load3(contacts.rows, c + ARM_B)
                        turning = ti.select(k > 2, 1, 0)
                        add_equation(ia, ib, n, scratch, direction, ra, rb, turning, weight, impulse, contacts)


@func
def solve(n, scratch, contacts: RigidContacts):
    """Cholesky's factor in place of the matrix, and the solution in place of the right side."""
    side, starts = scratch + n * n, scratch + n * n + n
    for r in range(n):
        begin = ti.cast(contacts.systems[starts + r], ti.i32)
        for c in range(begin, r + 1):
            total = contacts.systems[scratch + r * n + c]
            for k in range(ti.max(begin, ti.cast(contacts.systems[starts + c], ti.i32)), c):
                total -= contacts.systems[scratch + r * n + k] * contacts.systems[scratch + c * n + k]
            if c == r:
                contacts.systems[scratch + r * n + r] = ti.sqrt(ti.max(total, 1e-30))
            else:
                contacts.systems[scratch + r * n + c] = total / contacts.systems[scratch + c * n + c]
        total = contacts.systems[side + r]
        for k in range(begin, r):
            total -= contacts.systems[scratch + r * n + k] * contacts.systems[side + k]
        contacts.systems[side + r] = total / contacts.systems[scratch + r * n + r]
    for back in range(n):
        r = n - 1 - back
        contacts.systems[side + r] /= contacts.systems[scratch + r * n + r]
        for k in range(ti.cast(contacts.systems[starts + r], ti.i32), r):
            contacts.systems[side + k] -= contacts.systems[scratch + r * n + k] * contacts.systems[side + r]


@func
def height(size, limit, stiffness):
    """Return what an impulse of ``size`` without limit adds to the minimised function."""
    return ti.select(size > limit, limit * (size - limit / 2), size * size / 2) / stiffness


@func
def value(w, n, scratch, bodies: RigidArrays, contacts: RigidContacts):
    """The function that is made least, at the present velocities and with the present limits."""
    total = ti.cast(0.0, ti.f64)
    for k in range(n // 6):
        i, free = bodies.spans[w * SPANS] + k, scratch + n * n + 2 * n + 6 * k
        turn = load33(bodies.state, i * STATE + R)
        change = load3(bodies.state, i * STATE + V) - load3(contacts.systems, free)
        spin = turn.transpose() @ (load3(bodies.state, i * STATE + W) - load3(contacts.systems, free + 3))
        total += bodies.numbers[i * NUMBERS + MASS] * change.norm_sqr() / 2
        total += spin.dot(load33(bodies.numbers, i * NUMBERS + INERTIA) @ spin) / 2
    for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
        a, b = contacts.pairs[p * PAIRS], contacts.pairs[p * PAIRS + 1]
        for s in range(contacts.counts[p]):
            c = (p * SLOTS + s) * ROW
            press, rub, roll = loads_of(a, b, c, bodies, contacts)
            total += press * press / 2 / STIFFNESS * contacts.rows[c + KN]
            total += height(rub.norm(), contacts.rows[c + LIMIT], STIFFNESS / contacts.rows[c + KT])
            total += height(roll.norm(), contacts.rows[c + LIMIT + 1], STIFFNESS / ti.max(contacts.rows[c + KR], 1e-30))
    return total


@func
def shift(w, n, scratch, share, bodies: RigidArrays, contacts: RigidContacts):
    """Add ``share`` of the solution to the velocities; returns the largest component of the solution."""
    most = ti.cast(0.0, ti.f64)
    for k in range(n // 6):
        i, side = bodies.spans[w * SPANS] + k, scratch + n * n + 6 * k
        if bodies.kinds[i * KINDS + KIND] == DYNAMIC:
            for c in range(3):
                bodies.state[i * STATE + V + c] += share * contacts.systems[side + c]
                bodies.state[i * STATE + W + c] += share * contacts.systems[side + 3 + c]
                most = ti.max(most, ti.abs(contacts.systems[side + c]))
                most = ti.max(most, ti.abs(contacts.systems[side + 3 + c]))
    return most


@func
def give(w, sign, bodies: RigidArrays, contacts: RigidContacts):
    """Apply the impulses of all contacts of world ``w``, or for ``sign`` -1 take them back."""
    for p in range(bodies.spans[w * SPANS + 2], bodies.spans[w * SPANS + 3]):
        for s in range(contacts.counts[p]):
            c = (p * SLOTS + s) * ROW
            impulse = contacts.rows[c + IMPULSE] * load3(contacts.rows, c + NORMAL) + load3(contacts.rows, c + RUB)
            for d in range(2):
                i = contacts.pairs[p * PAIRS + d]
                if i >= 0:
                    way = ti.select(d == 0, sign, -sign)
                    arm = load3(contacts.rows, c + ti.select(d == 0, ARM_A, ARM_B))
                    moment = arm.cross(impulse) + load3(contacts.rows, c + ROLL)
                    kick(i, V, W, way * impulse, way * moment, bodies)


@func
def solve_together(w, settled, bodies: RigidArrays, contacts: RigidContacts):
    """Find the impulses of all contacts of world ``w`` at once. settled: change of velocity (cells/s) that counts as
    none."""
    n = 6 * (bodies.spans[w * SPANS + 4] - bodies.spans[w * SPANS])
    scratch = bodies.spans[w * SPANS + 5]
    free = scratch + n * n + 2 * n
    give(w, -1, bodies, contacts)
    for k in range(n // 6):
        i = bodies.spans[w * SPANS] + k
        store3(contacts.systems, free + 6 * k, load3(bodies.state, i * STATE + V))
        store3(contacts.systems, free + 6 * k + 3, load3(bodies.state, i * STATE + W))
    give(w, 1, bodies, contacts)
    rounds = 0
    while rounds < ROUNDS:
        set_limits(w, bodies, contacts)
        steps = 0
        most = ti.cast(1e30, ti.f64)
        while steps < NEWTON_STEPS and most > CLOSE * settled:
            now = value(w, n, scratch, bodies, contacts)
            assemble(w, n, scratch, bodies, contacts)
            solve(n, scratch, contacts)
            share = ti.cast(1.0, ti.f64)
            most = shift(w, n, scratch, share, bodies, contacts)
            halved = 0
            while halved < BACK and value(w, n, scratch, bodies, contacts) > now:
                share /= 2
                shift(w, n, scratch, -share, bodies, contacts)
                halved += 1
            steps += 1
        set_impulses(w, bodies, contacts)
        bodies.report[w * REPORT + 3] += steps
        rounds = ti.select(steps == 1, ROUNDS, rounds + 1)
    # The bodies take what the impulses give, not the solution itself: so the momentum stays exact.
    for k in range(n // 6):
        i = bodies.spans[w * SPANS] + k
        store3(bodies.state, i * STATE + V, load3(contacts.systems, free + 6 * k))
        store3(bodies.state, i * STATE + W, load3(contacts.systems, free + 6 * k + 3))
    give(w, 1, bodies, contacts)
