# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Batched kernel: many worlds of one rigid body above a plane, in one launch.

A body is a set of points with a common radius: one point is a sphere, hull corners with radius zero a polyhedron.
Flight uses fourth-order Runge–Kutta steps with conserved angular momentum. Contacts are springs and dashpots, scaled so
that each has the same half period and restitution whatever its effective mass (Schwager and Pöschel, Granular Matter 9
(2007), for one contact; Todorov, ICRA 2014, for many). Coulomb friction within the cone at every contact. All per unit
mass of the body.
"""

from typing import NamedTuple

import taichi as ti
import taichi.math as tm

from ...mpm.kernels.kernel_bundles import kernel
from ...mpm.rigid.rigid_math import dmat3, dvec3, dvec4, matrix_of, turned

Table = ti.types.ndarray(dtype=ti.f64, ndim=2)
Cube = ti.types.ndarray(dtype=ti.f64, ndim=3)
Counts = ti.types.ndarray(dtype=ti.i32, ndim=1)

ITERATIONS = 512
"""Loop iterations per world: Taichi's CPU backend gives a thread at least this many."""

MOST_CONTACTS = 6
"""Points that carry a body at once. Where more lie below the plane, those that reach farthest in as many directions are
taken: a rim of 32 corners stands on a hexagon of its own size, and not on the arc that comes first."""
SWEEPS = 8
CALM_STEP, CALM_SPEED, CALM_FORCE = 1e-3, 0.02, 40.0
"""Step in s of a calm contact, and its limits: normal speed in m/s and force per mass in m/s²."""

LEAVES = 1e-3
"""Speed in m/s away from the plane above which adhesion pulls; the pull falls to zero at its reach."""

GRAVITY, DRAG, WIND, LIFT = 0, 3, 4, 7
TETHER, LENGTH, ANCHOR, STRING = 8, 9, 10, 13
FRICTION, ROLLING, PULL, REACH = 14, 15, 16, 17
CENTER, INERTIA, MOBILITY = 18, 21, 27
SPRING, DASHPOT, RUB, STEP = 33, 34, 35, 36
NORMAL, POINT, INSET = 37, 40, 43
NUMBERS = 44
"""Offsets of a world's numbers. Inertia and its inverse (mobility) are per mass, as xx, yy, zz, xy, xz, yz. Spring in
1/s², dashpot and rub (tangential damping) in 1/s, step in s. Inset: share by which friction under a face, carried by
three corners or more, acts nearer to the middle than these."""

STATE = 13
RECORD = 17
"""Position, quaternion, velocity, spin; then accumulated since the start: normal and tangential impulse in m/s, time
in contact and time sliding in s."""


class BodyPoints(NamedTuple):
    """Surface points of the body about its reference point, all of one radius."""

    corners: ti.i32
    """Number of points."""

    radius: ti.f64
    """m."""

    bound: ti.f64
    """Largest distance of a point to the reference point, plus the radius, m."""

    points: Table
    """(corners, 3) m, body axes."""


class RunArrays(NamedTuple):
    """W worlds of the body and M times, padded."""

    starts: Table
    """(W, STATE) position (m), quaternion, velocity (m/s), spin (rad/s) of the reference point at time 0."""

    p: Table
    """(W, NUMBERS) parameters; the reference point's distance to the centre of mass is CENTER, body axes."""

    counts: Counts
    """(W,) times of a world."""

    times: Table
    """(W, M) seconds since the start, rising."""

    out: Cube
    """(W, M, RECORD) written: state of the reference point, and sums over contacts."""

    steps: Counts
    """(W,) written: steps taken."""


@ti.func
def vec(table: Table, w, i):
    """Return three numbers of world ``w``."""
    return dvec3(table[w, i], table[w, i + 1], table[w, i + 2])


@ti.func
def symmetric(table: Table, w, i):
    """Return six numbers of world ``w`` as a symmetric matrix."""
    a, b, c = table[w, i], table[w, i + 1], table[w, i + 2]
    d, e, f = table[w, i + 3], table[w, i + 4], table[w, i + 5]
    return dmat3([a, d, e], [d, b, f], [e, f, c])


@ti.func
def acceleration(p: Table, w, x, v, spin):
    """Return the force per mass on a free body at ``x``."""
    u = v - vec(p, w, WIND)
    a = vec(p, w, GRAVITY) - p[w, DRAG] * u.norm() * u + p[w, LIFT] * spin.cross(u)
    if p[w, TETHER] > 0:
        way = vec(p, w, ANCHOR) - x
        distance = way.norm()
        stretch = distance - p[w, LENGTH]
        if distance > 1e-9 and (stretch > 0 or p[w, STRING] < 0.5):
            a += p[w, TETHER] * stretch / distance * way
    return a


@ti.func
def lowest(points: Table, count, radius, x, r, n, foot):
    """Return the smallest distance of the body to the plane."""
    least = ti.cast(1e30, ti.f64)
    for i in range(count):
        gap = (x + r @ dvec3(points[i, 0], points[i, 1], points[i, 2]) - foot).dot(n) - radius
        least = ti.min(least, gap)
    return least


@kernel
def advance(worlds: ti.i32, longest: ti.f64, body: BodyPoints, runs: RunArrays):
    """Take every world from its start to each of its times; longest: step in flight, s."""
    for ww in range(worlds * ITERATIONS):
        if ww % ITERATIONS == 0:
            w = ww // ITERATIONS
            n, foot, center = vec(runs.p, w, NORMAL), vec(runs.p, w, POINT), vec(runs.p, w, CENTER)
            inertia, mobility = symmetric(runs.p, w, INERTIA), symmetric(runs.p, w, MOBILITY)
            q = dvec4(runs.starts[w, 3], runs.starts[w, 4], runs.starts[w, 5], runs.starts[w, 6])
            r = matrix_of(q)
            arm = r @ center
            spin = vec(runs.starts, w, 10)
            x = vec(runs.starts, w, 0) + arm
            v = vec(runs.starts, w, 7) + spin.cross(arm)
            momentum = r @ (inertia @ (r.transpose() @ spin))
            # A noisy start may lie below the plane; that must not throw the body up.
            sunk = ti.min(0.0, lowest(body.points, body.corners, body.radius, x - arm, r, n, foot))
            t = ti.cast(0.0, ti.f64)
            pushed = ti.cast(0.0, ti.f64)
            rubbed = ti.cast(0.0, ti.f64)
            touched = ti.cast(0.0, ti.f64)
            slid = ti.cast(0.0, ti.f64)
            small = runs.p[w, STEP]
            # A body that rests, slides or rolls without an impact takes longer steps, with springs solved for
            # at their end, which holds them still at any step.
            calm = False
            taken = 0
            for m in range(runs.counts[w]):
                while t < runs.times[w, m] - 1e-9:
                    left = runs.times[w, m] - t
                    gap = (x - arm - foot).dot(n) - body.bound
                    if gap < 0.5 * body.bound:
                        gap = lowest(body.points, body.corners, body.radius, x - arm, r, n, foot) - sunk
                    room = gap - runs.p[w, REACH] * (1.0 if runs.p[w, PULL] > 0 else 0.0)
                    closing = ti.abs(v.dot(n)) + spin.norm() * body.bound * (1.0 if body.corners > 1 else 0.0) + 0.05
                    h = ti.min(left, longest)
                    near = room < closing * h
                    if near:
                        h = ti.min(h, ti.max(small, 0.8 * room / closing))
                    if room > closing * h:
                        k1 = acceleration(runs.p, w, x, v, spin)
                        v2 = v + 0.5 * h * k1
                        k2 = acceleration(runs.p, w, x + 0.5 * h * v, v2, spin)
                        v3 = v + 0.5 * h * k2
                        k3 = acceleration(runs.p, w, x + 0.5 * h * v2, v3, spin)
                        v4 = v + h * k3
                        k4 = acceleration(runs.p, w, x + h * v3, v4, spin)
                        x += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
                        v += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                        middle = matrix_of(turned(q, 0.5 * h * spin))
                        q = turned(q, h * (middle @ (mobility @ (middle.transpose() @ momentum))))
                        r = matrix_of(q)
                        spin = r @ (mobility @ (r.transpose() @ momentum))
                    else:
                        h = ti.min(left, small)
                        implicit = 0.0
                        if calm:
                            h = ti.min(left, CALM_STEP)
                            implicit = 1.0
                        a = acceleration(runs.p, w, x, v, spin)
                        if runs.p[w, PULL] > 0 and gap < runs.p[w, REACH] and v.dot(n) > LEAVES:
                            a -= runs.p[w, PULL] * (1.0 - ti.max(gap, 0.0) / runs.p[w, REACH]) * n
                        inverse = r @ mobility @ r.transpose()
                        before = v
                        spun = spin
                        v += h * a
                        found = 0
                        arms = ti.Matrix.zero(ti.f64, MOST_CONTACTS, 3)
                        wants = ti.Matrix.zero(ti.f64, MOST_CONTACTS, 3)
                        sums = ti.Matrix.zero(ti.f64, MOST_CONTACTS, 3)
                        eases = ti.Vector.zero(ti.f64, MOST_CONTACTS)
                        calm = True
                        below, chosen = 0, 0
                        picks = ti.Vector([-1] * MOST_CONTACTS, ti.i32)
                        for i in range(body.corners if body.corners > MOST_CONTACTS else 0):
                            reach = r @ dvec3(body.points[i, 0], body.points[i, 1], body.points[i, 2])
                            below += (x + reach - arm - body.radius * n - foot).dot(n) - sunk < 0
                        if below > MOST_CONTACTS:
                            chosen = 1
                            side = n.cross(dvec3(1.0, 0.0, 0.0))
                            if ti.abs(n[0]) > 0.8:
                                side = n.cross(dvec3(0.0, 1.0, 0.0))
                            side = side.normalized()
                            for k in range(MOST_CONTACTS):
                                angle = 2.0 * tm.pi * k / MOST_CONTACTS
                                way = ti.cos(angle) * side + ti.sin(angle) * n.cross(side)
                                farthest = ti.cast(-1e30, ti.f64)
                                for i in range(body.corners):
                                    reach = r @ dvec3(body.points[i, 0], body.points[i, 1], body.points[i, 2])
                                    depth = (x + reach - arm - body.radius * n - foot).dot(n) - sunk
                                    if depth < 0 and reach.dot(way) > farthest:
                                        farthest = reach.dot(way)
                                        picks[k] = i
                        for i in range(body.corners):
                            carries = 1 - chosen
                            for k in ti.static(range(MOST_CONTACTS)):
                                carries |= picks[k] == i
                            lever = (
                                r @ dvec3(body.points[i, 0], body.points[i, 1], body.points[i, 2])
                                - arm
                                - body.radius * n
                            )
                            depth = (x + lever - foot).dot(n) - sunk
                            u = before + spun.cross(lever)
                            un = u.dot(n)
                            if depth >= 0 and depth < 4 * CALM_STEP * ti.max(-un, 0.0):
                                calm = False
                            if depth < 0 and carries > 0 and found < MOST_CONTACTS:
                                # At the turning point of a bounce the speed is small too, but not the spring force.
                                if ti.abs(un) > CALM_SPEED or runs.p[w, SPRING] * depth < -CALM_FORCE:
                                    calm = False
                                # Target velocity of the contact after the step, tangential and normal.
                                keep = ti.exp(-runs.p[w, RUB] * h)
                                pull = h * (runs.p[w, SPRING] * depth + runs.p[w, DASHPOT] * un)
                                if implicit > 0:
                                    pull = un - (un - h * runs.p[w, SPRING] * depth) / (
                                        1.0 + h * (runs.p[w, DASHPOT] + h * runs.p[w, SPRING])
                                    )
                                want = keep * (u - un * n) + (un - pull) * n
                                cross = lever.cross(n)
                                for c in ti.static(range(3)):
                                    arms[found, c] = lever[c]
                                    wants[found, c] = want[c]
                                eases[found] = 1.0 / (1.02 * (1.0 + cross.dot(inverse @ cross)))
                                found += 1
                        if found == 0:
                            calm = False
                        total = ti.cast(0.0, ti.f64)
                        sliding = 0
                        inset = ti.cast(0.0, ti.f64)
                        if found > 2 and runs.p[w, INSET] > 0:
                            inset = runs.p[w, INSET]
                            for i in range(found):
                                lever = dvec3(arms[i, 0], arms[i, 1], arms[i, 2])
                                slip = spun.cross(inset * (lever.dot(n) * n - lever))
                                slip -= slip.dot(n) * n
                                for c in ti.static(range(3)):
                                    wants[i, c] += ti.exp(-runs.p[w, RUB] * h) * slip[c]
                        if found > 0:
                            sweep, change = 0, 1.0
                            while sweep < (SWEEPS if found > 1 else 3) and change > 1e-7:
                                sweep += 1
                                change = 0.0
                                sliding = 0
                                for i in range(found):
                                    lever = dvec3(arms[i, 0], arms[i, 1], arms[i, 2])
                                    want = dvec3(wants[i, 0], wants[i, 1], wants[i, 2])
                                    old = dvec3(sums[i, 0], sums[i, 1], sums[i, 2])
                                    u = v + spin.cross(lever)
                                    pn = old.dot(n)
                                    # The 2 % make redundant contacts (four under a face) unique.
                                    new_n = ti.max(
                                        0.0, pn + eases[i] * ((want - u).dot(n) - 0.02 * pn / eases[i] / 1.02)
                                    )
                                    push = (new_n - pn) * n
                                    v += push
                                    spin += inverse @ lever.cross(push)
                                    grip = lever + inset * (lever.dot(n) * n - lever)
                                    u = v + spin.cross(grip)
                                    off = want - u
                                    off -= off.dot(n) * n
                                    size = off.norm()
                                    new_t = old - pn * n
                                    if size > 1e-12:
                                        way = off / size
                                        cross = grip.cross(way)
                                        new_t += off / (1.0 + cross.dot(inverse @ cross))
                                    most = runs.p[w, FRICTION] * new_n
                                    length = new_t.norm()
                                    if length > most:
                                        new_t *= most / length
                                        sliding = 1
                                    turn = new_t - (old - pn * n)
                                    v += turn
                                    spin += inverse @ grip.cross(turn)
                                    change = ti.max(change, ti.abs(new_n - pn), turn.norm())
                                    for c in ti.static(range(3)):
                                        sums[i, c] = new_t[c] + new_n * n[c]
                            whole = dvec3(0.0, 0.0, 0.0)
                            for i in range(found):
                                one = dvec3(sums[i, 0], sums[i, 1], sums[i, 2])
                                lever = dvec3(arms[i, 0], arms[i, 1], arms[i, 2])
                                momentum += lever.cross(one)
                                if inset > 0:
                                    momentum += inset * (lever.dot(n) * n - lever).cross(one - one.dot(n) * n)
                                whole += one
                            total = whole.dot(n)
                            pushed += total
                            rubbed += (whole - total * n).norm()
                            touched += h
                            slid += h * sliding
                        if runs.p[w, ROLLING] > 0 and total > 0:
                            around = spin - spin.dot(n) * n
                            rate = around.norm()
                            if rate > 1e-9:
                                axis = around / rate
                                most = rate / axis.dot(inverse @ axis)
                                # Rolling resistance acts at the contact, with the inertia of both motions.
                                momentum -= ti.min(runs.p[w, ROLLING] * total, most) * axis
                        # Mean of old and new velocity: exact under constant force.
                        x += h * v - 0.5 * h * h * a * (1.0 if found == 0 else 0.0)
                        spin = r @ (mobility @ (r.transpose() @ momentum))
                        q = turned(q, h * spin)
                        r = matrix_of(q)
                        spin = r @ (mobility @ (r.transpose() @ momentum))
                    arm = r @ center
                    t += h
                    taken += 1
                at = x - arm
                speed = v - spin.cross(arm)
                for c in ti.static(range(3)):
                    runs.out[w, m, c] = at[c]
                    runs.out[w, m, 7 + c] = speed[c]
                    runs.out[w, m, 10 + c] = spin[c]
                for c in ti.static(range(4)):
                    runs.out[w, m, 3 + c] = q[c]
                runs.out[w, m, 13] = pushed
                runs.out[w, m, 14] = rubbed
                runs.out[w, m, 15] = touched
                runs.out[w, m, 16] = slid
            runs.steps[w] = taken
