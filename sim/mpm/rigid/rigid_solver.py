# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Contact impulses between rigid bodies: projected Gauss-Seidel, warm-started from the last substep, and a common
solution (``rigid_direct``) where that takes long.

For each contact with gap phi, normal n from b to a, relative velocity u = u_n n + u_t (a's less b's, after it):

    u_n >= -e u_n(before)  where it comes in faster than gravity would bring it, and phi is closed within the substep
    u_n >= -phi / dt       elsewhere, phi > 0;  u_n >= 0 elsewhere
    lambda_n >= 0, complementary;  |lambda_t| <= mu lambda_n, opposed to u_t where equal;  |lambda_r| <= lever lambda_n

Penetration is corrected by separate velocities (``PUSH_V``) that move the bodies but are dropped afterwards, so that
the correction adds no energy.
"""

import taichi as ti

from ..kernels.kernel_arrays import RigidArrays, RigidContacts
from ..kernels.kernel_bundles import func
from .rigid_direct import kick, tangent
from .rigid_layout import (
    ADHESION,
    ADHESION_REACH,
    ARM_A,
    ARM_B,
    BOTH_WAYS,
    BOUNCE,
    CONTACT,
    DRIFT,
    FRICTION,
    GAP,
    GRAVITY,
    IMPULSE,
    INVERSE_MASS,
    KINETIC,
    KN,
    KR,
    KT,
    LEVER,
    MEMORY,
    MODE,
    NORMAL,
    NUMBERS,
    PAIRS,
    PLACE,
    PULL,
    PUSH,
    PUSH_IMPULSE,
    PUSH_V,
    PUSH_W,
    RECOVERY,
    REPORT,
    RESTITUTION,
    ROLL,
    ROW,
    RUB,
    SEPARATE,
    SLIP,
    SLOTS,
    STATE,
    STATIC_FRICTION,
    STICKY,
    TARGET,
    TOUCHED,
    UNIFORM,
    V_BEFORE,
    W_BEFORE,
    WORLD,
    J,
    L,
    V,
    W,
)
from .rigid_math import dvec3, load3, load33, store3

SWEEPS = 80
"""Gauss-Seidel sweeps at most; they end when nothing changes any more."""

ALONE = 8
"""Sweeps after which all contacts are solved together."""

SETTLED = 1e-3
"""Share of the speed that gravity gives in a substep below which a change counts as converged."""

QUICK = 3.0
"""Multiple of the speed that gravity gives in a substep above which a body bounces."""

ENGAGE = 0.02
"""Cells within which slip and sticky contacts engage."""

SHARE = 0.2
"""Share of the penetration that one substep corrects."""


@ti.func
def cross_product_matrix_column(arm, inverse_inertia, axis):
    """Velocity at ``arm`` along all axes from an impulse of 1 along ``axis`` there, by turning alone."""
    return (inverse_inertia @ arm.cross(axis)).cross(arm)


@func
def prepare(w, dt, p, bodies: RigidArrays, contacts: RigidContacts):
    """Effective masses, targets and friction of pair ``p``'s contacts; the velocities are those before impulses."""
    a, b = contacts.pairs[p * PAIRS], contacts.pairs[p * PAIRS + 1]
    law = contacts.pairs[p * PAIRS + 3] * CONTACT
    mode = ti.cast(contacts.pair_numbers[law + MODE], ti.i32)
    weight = load3(bodies.world_numbers, w * WORLD + GRAVITY).norm() + contacts.pair_numbers[law + ADHESION]
    weight += load3(bodies.numbers, a * NUMBERS + UNIFORM).norm()
    fall = dt * weight + 1e-6
    recovery = bodies.world_numbers[w * WORLD + RECOVERY]
    inverse = bodies.numbers[a * NUMBERS + INVERSE_MASS]
    Ja = load33(bodies.state, a * STATE + J)
    Jb = Ja * 0
    if b >= 0:
        inverse += bodies.numbers[b * NUMBERS + INVERSE_MASS]
        Jb = load33(bodies.state, b * STATE + J)
    # The adhesion, a force of so much times the reduced mass, is shared by the contacts in its reach.
    pull, within = contacts.pair_numbers[law + ADHESION], contacts.pair_numbers[law + ADHESION_REACH]
    sharing = 0
    for d in range(2):
        q = contacts.pairs[p * PAIRS + 2]
        if d == 0:
            q = p
        if q >= 0 and pull > 0.0:
            for s in range(contacts.counts[q]):
                if contacts.rows[(q * SLOTS + s) * ROW + GAP] < within:
                    sharing += 1
    for s in range(contacts.counts[p]):
        c = (p * SLOTS + s) * ROW
        ra, rb, n = load3(contacts.rows, c + ARM_A), load3(contacts.rows, c + ARM_B), load3(contacts.rows, c + NORMAL)
        t1 = tangent(n)
        t2 = n.cross(t1)
        K = inverse * dvec3(1.0)
        k12 = ti.cast(0.0, ti.f64)
        for k in range(3):
            axis = ti.select(k == 0, n, ti.select(k == 1, t1, t2))
            answer = cross_product_matrix_column(ra, Ja, axis) + cross_product_matrix_column(rb, Jb, axis)
            gain = answer.dot(axis)
            K += gain * dvec3(ti.select(k == 0, 1, 0), ti.select(k == 1, 1, 0), ti.select(k == 2, 1, 0))
            if k == 1:
                k12 = answer.dot(t2)
        contacts.rows[c + KN] = K[0]
        contacts.rows[c + KT] = (K[1] + K[2]) / 2 + ti.sqrt(((K[1] - K[2]) / 2) ** 2 + k12 * k12)
        both = Ja + Jb
        rows = ti.abs(both) @ dvec3(1.0)
        contacts.rows[c + KR] = rows.max()
        drift = load3(contacts.rows, c + DRIFT)
        u = load3(bodies.state, a * STATE + V) + load3(bodies.state, a * STATE + W).cross(ra) - drift
        before = load3(bodies.state, a * STATE + V_BEFORE) + load3(bodies.state, a * STATE + W_BEFORE).cross(ra) - drift
        if b >= 0:
            u -= load3(bodies.state, b * STATE + V) + load3(bodies.state, b * STATE + W).cross(rb)
            before -= load3(bodies.state, b * STATE + V_BEFORE) + load3(bodies.state, b * STATE + W_BEFORE).cross(rb)
        closing = u.dot(n)
        gap = contacts.rows[c + GAP]
        target = -ti.max(gap, 0) / dt
        restitution = contacts.pair_numbers[law + RESTITUTION]
        if mode == SEPARATE and restitution > 0.0 and closing < -QUICK * fall and gap + dt * closing < 0.0:
            target = -restitution * closing
            contacts.rows[c + BOUNCE] = 1
        push = ti.cast(0.0, ti.f64)
        if gap < 0.0:
            push = ti.min(-SHARE * gap / dt, recovery)
        sliding = before - before.dot(n) * n
        friction = contacts.pair_numbers[law + ti.select(sliding.norm() < fall, STATIC_FRICTION, KINETIC)]
        if mode != SEPARATE and gap < ENGAGE:
            contacts.rows[c + BOTH_WAYS] = 1
            if gap > 0.0:
                target = ti.max(-SHARE * gap / dt, -recovery)
        if mode == SLIP:
            friction = 0
        if mode == STICKY:
            friction = ti.select(gap < ENGAGE, 1e30, 0.0)
        contacts.rows[c + TARGET] = target
        contacts.rows[c + PUSH] = push
        contacts.rows[c + FRICTION] = friction
        if pull > 0.0 and gap < within:
            contacts.rows[c + PULL] = dt * pull / (inverse * sharing)


@func
def warm(p, bodies: RigidArrays, contacts: RigidContacts):
    """Warm start: apply the impulses of the last substep and the adhesion."""
    for s in range(contacts.counts[p]):
        c = (p * SLOTS + s) * ROW
        n = load3(contacts.rows, c + NORMAL)
        rub, roll = load3(contacts.rows, c + RUB), load3(contacts.rows, c + ROLL)
        rub -= rub.dot(n) * n
        roll -= roll.dot(n) * n
        if contacts.rows[c + BOTH_WAYS] < 0.5:
            contacts.rows[c + IMPULSE] = ti.max(contacts.rows[c + IMPULSE], 0)
        store3(contacts.rows, c + RUB, rub)
        store3(contacts.rows, c + ROLL, roll)
        impulse = (contacts.rows[c + IMPULSE] - contacts.rows[c + PULL]) * n + rub
        for d in range(2):
            i = contacts.pairs[p * PAIRS + d]
            if i >= 0:
                sign = ti.select(d == 0, 1, -1)
                arm = load3(contacts.rows, c + ti.select(d == 0, ARM_A, ARM_B))
                kick(i, V, W, sign * impulse, sign * (arm.cross(impulse) + roll), bodies)


@func
def sweep(p, bodies: RigidArrays, contacts: RigidContacts):
    """One Gauss-Seidel sweep over the contacts of pair ``p``; returns the largest change of velocity in it."""
    worst = ti.cast(0.0, ti.f64)
    a, b = contacts.pairs[p * PAIRS], contacts.pairs[p * PAIRS + 1]
    if contacts.counts[p] > 0:
        lever = contacts.pair_numbers[contacts.pairs[p * PAIRS + 3] * CONTACT + LEVER]
        ma = bodies.numbers[a * NUMBERS + INVERSE_MASS]
        mb = ma * 0
        Ja = load33(bodies.state, a * STATE + J)
        Jb = Ja * 0
        va, wa = load3(bodies.state, a * STATE + V), load3(bodies.state, a * STATE + W)
        pa, qa = load3(bodies.state, a * STATE + PUSH_V), load3(bodies.state, a * STATE + PUSH_W)
        vb, wb, pb, qb = dvec3(0.0), dvec3(0.0), dvec3(0.0), dvec3(0.0)
        if b >= 0:
            mb = bodies.numbers[b * NUMBERS + INVERSE_MASS]
            Jb = load33(bodies.state, b * STATE + J)
            vb, wb = load3(bodies.state, b * STATE + V), load3(bodies.state, b * STATE + W)
            pb, qb = load3(bodies.state, b * STATE + PUSH_V), load3(bodies.state, b * STATE + PUSH_W)
        for s in range(contacts.counts[p]):
            c = (p * SLOTS + s) * ROW
            ra, rb, n = (
                load3(contacts.rows, c + ARM_A),
                load3(contacts.rows, c + ARM_B),
                load3(contacts.rows, c + NORMAL),
            )
            # Along the surface and against rolling, limited by the present normal impulse.
            size = ti.max(contacts.rows[c + IMPULSE], 0)
            u = va + wa.cross(ra) - vb - wb.cross(rb) - load3(contacts.rows, c + DRIFT)
            old = load3(contacts.rows, c + RUB)
            new = old - (u - u.dot(n) * n) / contacts.rows[c + KT]
            most = contacts.rows[c + FRICTION] * size
            if contacts.rows[c + FRICTION] > 1e20:
                most = 1e30
            if new.norm() > most:
                new *= most / new.norm()
            store3(contacts.rows, c + RUB, new)
            change = new - old
            worst = ti.max(worst, change.norm() * contacts.rows[c + KT])
            turn = dvec3(0.0)
            if lever > 0.0:
                rolling = wa - wb
                held = load3(contacts.rows, c + ROLL)
                now = held - (rolling - rolling.dot(n) * n) / ti.max(contacts.rows[c + KR], 1e-300)
                if now.norm() > lever * size:
                    now *= lever * size / now.norm()
                store3(contacts.rows, c + ROLL, now)
                turn = now - held
            va += ma * change
            wa += Ja @ (ra.cross(change) + turn)
            vb -= mb * change
            wb -= Jb @ (rb.cross(change) + turn)
            # Along the normal.
            u = va + wa.cross(ra) - vb - wb.cross(rb) - load3(contacts.rows, c + DRIFT)
            before = contacts.rows[c + IMPULSE]
            after = before + (contacts.rows[c + TARGET] - u.dot(n)) / contacts.rows[c + KN]
            if contacts.rows[c + BOTH_WAYS] < 0.5:
                after = ti.max(after, 0)
            contacts.rows[c + IMPULSE] = after
            worst = ti.max(worst, ti.abs(after - before) * contacts.rows[c + KN])
            change = (after - before) * n
            va += ma * change
            wa += Ja @ ra.cross(change)
            vb -= mb * change
            wb -= Jb @ rb.cross(change)
            # Out of the depth.
            if contacts.rows[c + PUSH] > 0.0:
                u = pa + qa.cross(ra) - pb - qb.cross(rb)
                before = contacts.rows[c + PUSH_IMPULSE]
                after = ti.max(before + (contacts.rows[c + PUSH] - u.dot(n)) / contacts.rows[c + KN], 0)
                contacts.rows[c + PUSH_IMPULSE] = after
                change = (after - before) * n
                pa += ma * change
                qa += Ja @ ra.cross(change)
                pb -= mb * change
                qb -= Jb @ rb.cross(change)
        store3(bodies.state, a * STATE + V, va)
        store3(bodies.state, a * STATE + W, wa)
        store3(bodies.state, a * STATE + PUSH_V, pa)
        store3(bodies.state, a * STATE + PUSH_W, qa)
        if b >= 0:
            store3(bodies.state, b * STATE + V, vb)
            store3(bodies.state, b * STATE + W, wb)
            store3(bodies.state, b * STATE + PUSH_V, pb)
            store3(bodies.state, b * STATE + PUSH_W, qb)
    return worst


@func
def finish(w, p, bodies: RigidArrays, contacts: RigidContacts):
    """Angular momentum from the impulses of pair ``p``, and its contacts into the memory."""
    for s in range(SLOTS):
        m = (p * SLOTS + s) * MEMORY
        contacts.memory[m + 10] = 0
        if s < contacts.counts[p]:
            c = (p * SLOTS + s) * ROW
            n = load3(contacts.rows, c + NORMAL)
            rub, roll = load3(contacts.rows, c + RUB), load3(contacts.rows, c + ROLL)
            impulse = (contacts.rows[c + IMPULSE] - contacts.rows[c + PULL]) * n + rub
            acts = impulse.norm() > 0.0 or roll.norm() > 0.0 or contacts.rows[c + PUSH_IMPULSE] > 0.0
            for d in range(2):
                i = contacts.pairs[p * PAIRS + d]
                if i >= 0 and acts:
                    sign = ti.select(d == 0, 1, -1)
                    arm = load3(contacts.rows, c + ti.select(d == 0, ARM_A, ARM_B))
                    gain = sign * (arm.cross(impulse) + roll)
                    for k in ti.static(range(3)):
                        bodies.state[i * STATE + L + k] += gain[k]
                    bounced = contacts.rows[c + BOUNCE] > 0.5
                    bodies.state[i * STATE + TOUCHED] = ti.max(
                        bodies.state[i * STATE + TOUCHED], ti.select(bounced, 2, 1)
                    )
            store3(contacts.memory, m, load3(contacts.rows, c + PLACE))
            contacts.memory[m + 3] = ti.select(contacts.rows[c + BOUNCE] > 0.5, 0, contacts.rows[c + IMPULSE])
            store3(contacts.memory, m + 4, ti.select(contacts.rows[c + BOUNCE] > 0.5, 0, 1) * rub)
            store3(contacts.memory, m + 7, ti.select(contacts.rows[c + BOUNCE] > 0.5, 0, 1) * roll)
            contacts.memory[m + 10] = 1
            bodies.report[w * REPORT] += 1
            bodies.report[w * REPORT + 1] = ti.max(bodies.report[w * REPORT + 1], -contacts.rows[c + GAP])
