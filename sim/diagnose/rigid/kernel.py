# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Many worlds of one rigid body each above a plane, all of them in one launch.

A body is a set of points of one radius: one point and its radius is a sphere, the corners of a hull and none a
polyhedron. It flies by Runge and Kutta's fourth-order steps with its angular momentum kept, and touches by springs and
dashpots in the directions of its contacts, scaled so that every contact has the same half period and restitution
whatever mass it meets (Schwager and Pöschel, Granular Matter 9 (2007), for one spring and dashpot; Todorov, ICRA 2014,
for many at once). Friction is Coulomb's, within the cone, at every contact. All per unit of the body's mass.
"""

import taichi as ti

from ...mpm.rigid_math import dmat3, dvec3, dvec4, matrix_of, turned

Table = ti.types.ndarray(dtype=ti.f64, ndim=2)
Cube = ti.types.ndarray(dtype=ti.f64, ndim=3)
Counts = ti.types.ndarray(dtype=ti.i32, ndim=1)

ITERATIONS = 512
"""Loop iterations spent on one world: Taichi's CPU backend gives a thread at least so many at a time."""

MOST_CONTACTS = 6
SWEEPS = 8
CALM_STEP, CALM_SPEED, CALM_FORCE = 1e-3, 0.02, 40.0
"""Step in s, and what a body that touches may have to take it: speed in m/s towards or off the plane, m/s² of force."""

LEAVES = 1e-3
"""m/s away from the plane, from which adhesion holds a body back; its pull falls to none at its reach."""

GRAVITY, DRAG, WIND, LIFT = 0, 3, 4, 7
TETHER, LENGTH, ANCHOR, STRING = 8, 9, 10, 13
FRICTION, ROLLING, PULL, REACH = 14, 15, 16, 17
CENTER, INERTIA, MOBILITY = 18, 21, 27
SPRING, DASHPOT, RUB, STEP = 33, 34, 35, 36
NORMAL, POINT = 37, 40
NUMBERS = 43
"""Where a world's numbers begin. Inertia and its inverse (mobility) are per mass, as xx, yy, zz, xy, xz, yz. Spring in
1/s², dashpot and rub (how fast sliding is taken up) in 1/s, step in s."""

STATE = 13
RECORD = 17
"""Position, quaternion, velocity, spin; then, added up since the start: impulse along the normal and along the plane
in m/s, time in contact, time sliding in s."""


@ti.func
def vec(table: Table, w, i):
    """Three numbers of world ``w``."""
    return dvec3(table[w, i], table[w, i + 1], table[w, i + 2])


@ti.func
def symmetric(table: Table, w, i):
    """Six numbers of world ``w`` as a symmetric matrix."""
    a, b, c = table[w, i], table[w, i + 1], table[w, i + 2]
    d, e, f = table[w, i + 3], table[w, i + 4], table[w, i + 5]
    return dmat3([a, d, e], [d, b, f], [e, f, c])


@ti.func
def acceleration(p: Table, w, x, v, spin):
    """Force per mass on a body at ``x`` that nothing touches."""
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
    """Smallest distance of the body to the plane."""
    least = ti.cast(1e30, ti.f64)
    for i in range(count):
        gap = (x + r @ dvec3(points[i, 0], points[i, 1], points[i, 2]) - foot).dot(n) - radius
        least = ti.min(least, gap)
    return least


@ti.kernel
def advance(
    worlds: ti.i32,
    corners: ti.i32,
    radius: ti.f64,
    bound: ti.f64,
    longest: ti.f64,
    points: Table,
    starts: Table,
    p: Table,
    counts: Counts,
    times: Table,
    out: Cube,
):
    """Take every world from its start to each of its times.

    points: corners about the reference point; bound: their largest distance to it plus the radius; longest: step in s
    in flight. starts (W, 13), p (W, NUMBERS), counts (W,), times (W, M) s since the start, rising; out (W, M, 17). Both
    are of the reference point, from which the world's centre of mass lies CENTER away, body axes.
    """
    for ww in range(worlds * ITERATIONS):
        if ww % ITERATIONS == 0:
            w = ww // ITERATIONS
            n, foot, center = vec(p, w, NORMAL), vec(p, w, POINT), vec(p, w, CENTER)
            inertia, mobility = symmetric(p, w, INERTIA), symmetric(p, w, MOBILITY)
            q = dvec4(starts[w, 3], starts[w, 4], starts[w, 5], starts[w, 6])
            r = matrix_of(q)
            arm = r @ center
            spin = vec(starts, w, 10)
            x = vec(starts, w, 0) + arm
            v = vec(starts, w, 7) + spin.cross(arm)
            momentum = r @ (inertia @ (r.transpose() @ spin))
            # Where a start is known to noise only, it may lie in the plane; that must not throw the body up.
            sunk = ti.min(0.0, lowest(points, corners, radius, x - arm, r, n, foot))
            t = ti.cast(0.0, ti.f64)
            pushed = ti.cast(0.0, ti.f64)
            rubbed = ti.cast(0.0, ti.f64)
            touched = ti.cast(0.0, ti.f64)
            slid = ti.cast(0.0, ti.f64)
            small = p[w, STEP]
            # A body that lies, slides or rolls without a blow to come takes longer steps, with springs solved for
            # at their end, which holds them still at any step.
            calm = False
            for m in range(counts[w]):
                while t < times[w, m] - 1e-9:
                    left = times[w, m] - t
                    gap = (x - arm - foot).dot(n) - bound
                    if gap < 0.5 * bound:
                        gap = lowest(points, corners, radius, x - arm, r, n, foot) - sunk
                    room = gap - p[w, REACH] * (1.0 if p[w, PULL] > 0 else 0.0)
                    closing = ti.abs(v.dot(n)) + spin.norm() * bound * (1.0 if corners > 1 else 0.0) + 0.05
                    h = ti.min(left, longest)
                    near = room < closing * h
                    if near:
                        h = ti.min(h, ti.max(small, 0.8 * room / closing))
                    if room > closing * h:
                        k1 = acceleration(p, w, x, v, spin)
                        v2 = v + 0.5 * h * k1
                        k2 = acceleration(p, w, x + 0.5 * h * v, v2, spin)
                        v3 = v + 0.5 * h * k2
                        k3 = acceleration(p, w, x + 0.5 * h * v2, v3, spin)
                        v4 = v + h * k3
                        k4 = acceleration(p, w, x + h * v3, v4, spin)
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
                        a = acceleration(p, w, x, v, spin)
                        if p[w, PULL] > 0 and gap < p[w, REACH] and v.dot(n) > LEAVES:
                            a -= p[w, PULL] * (1.0 - ti.max(gap, 0.0) / p[w, REACH]) * n
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
                        for i in range(corners):
                            lever = r @ dvec3(points[i, 0], points[i, 1], points[i, 2]) - arm - radius * n
                            depth = (x + lever - foot).dot(n) - sunk
                            u = before + spun.cross(lever)
                            un = u.dot(n)
                            if depth >= 0 and depth < 4 * CALM_STEP * ti.max(-un, 0.0):
                                calm = False
                            if depth < 0 and found < MOST_CONTACTS:
                                # Where a bounce turns round, its speed is small too, but not its spring's force.
                                if ti.abs(un) > CALM_SPEED or p[w, SPRING] * depth < -CALM_FORCE:
                                    calm = False
                                # What the contact's velocity is to be after the step, along the plane and across it.
                                keep = ti.exp(-p[w, RUB] * h)
                                pull = h * (p[w, SPRING] * depth + p[w, DASHPOT] * un)
                                if implicit > 0:
                                    pull = un - (un - h * p[w, SPRING] * depth) / (
                                        1.0 + h * (p[w, DASHPOT] + h * p[w, SPRING])
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
                                    # The 2 % give redundant contacts (four under a face) one answer.
                                    new_n = ti.max(
                                        0.0, pn + eases[i] * ((want - u).dot(n) - 0.02 * pn / eases[i] / 1.02)
                                    )
                                    push = (new_n - pn) * n
                                    v += push
                                    spin += inverse @ lever.cross(push)
                                    u = v + spin.cross(lever)
                                    off = want - u
                                    off -= off.dot(n) * n
                                    size = off.norm()
                                    new_t = old - pn * n
                                    if size > 1e-12:
                                        way = off / size
                                        cross = lever.cross(way)
                                        new_t += off / (1.0 + cross.dot(inverse @ cross))
                                    most = p[w, FRICTION] * new_n
                                    length = new_t.norm()
                                    if length > most:
                                        new_t *= most / length
                                        sliding = 1
                                    turn = new_t - (old - pn * n)
                                    v += turn
                                    spin += inverse @ lever.cross(turn)
                                    change = ti.max(change, ti.abs(new_n - pn), turn.norm())
                                    for c in ti.static(range(3)):
                                        sums[i, c] = new_t[c] + new_n * n[c]
                            whole = dvec3(0.0, 0.0, 0.0)
                            for i in range(found):
                                one = dvec3(sums[i, 0], sums[i, 1], sums[i, 2])
                                lever = dvec3(arms[i, 0], arms[i, 1], arms[i, 2])
                                momentum += lever.cross(one)
                                whole += one
                            total = whole.dot(n)
                            pushed += total
                            rubbed += (whole - total * n).norm()
                            touched += h
                            slid += h * sliding
                        if p[w, ROLLING] > 0 and total > 0:
                            around = spin - spin.dot(n) * n
                            rate = around.norm()
                            if rate > 1e-9:
                                axis = around / rate
                                most = rate / axis.dot(inverse @ axis)
                                # A rolling body is held back at its contact, which has the inertia of both.
                                momentum -= ti.min(p[w, ROLLING] * total, most) * axis
                        # Velocity of before and after: exact where only a constant force acts.
                        x += h * v - 0.5 * h * h * a * (1.0 if found == 0 else 0.0)
                        spin = r @ (mobility @ (r.transpose() @ momentum))
                        q = turned(q, h * spin)
                        r = matrix_of(q)
                        spin = r @ (mobility @ (r.transpose() @ momentum))
                    arm = r @ center
                    t += h
                at = x - arm
                speed = v - spin.cross(arm)
                for c in ti.static(range(3)):
                    out[w, m, c] = at[c]
                    out[w, m, 7 + c] = speed[c]
                    out[w, m, 10 + c] = spin[c]
                for c in ti.static(range(4)):
                    out[w, m, 3 + c] = q[c]
                out[w, m, 13] = pushed
                out[w, m, 14] = rubbed
                out[w, m, 15] = touched
                out[w, m, 16] = slid
