# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Contact search between rigid bodies: surface points of one against the plane or the distance lattice of the other.

A pair keeps few of its contacts: on each side of b's frame that they face, the farthest in eight directions along that
side and the deepest. Those carry the same load as all of them would, and the solve converges in a few sweeps.
"""

import taichi as ti

from ..kernels.collider_distance import outside_box, sample_distance, surface_slide
from ..kernels.kernel_arrays import RigidArrays, RigidContacts, ShapeArrays
from ..kernels.kernel_bundles import func
from .rigid_layout import (
    ADHESION_REACH,
    ARM_A,
    ARM_B,
    BINS,
    BLEND,
    BLEND_RATE,
    BULGE,
    CHOSEN,
    CLUSTERS,
    CLUSTERS_END,
    CONTACT,
    DRIFT,
    GAP,
    HULL_END,
    IMPULSE,
    KIND,
    KINDS,
    LAYERS,
    MEMORY,
    NORMAL,
    NUMBERS,
    OFFSET,
    PAIRS,
    PLACE,
    PLANE,
    POINT,
    RADIUS,
    ROW,
    RUB,
    SHAPE,
    SLOTS,
    SPACING,
    STATE,
    WAITING,
    WORLD,
    R,
    V,
    W,
    X,
)
from .rigid_math import dvec3, dvec4, load3, load33, store3

REACH = 0.02
"""Cells from the other surface within which points of a body at rest count as touching."""

SPEEDING = 1.5
"""Factor by which bodies may speed up within a substep."""

DEPTH_COUNTS = 4.0
"""Cells along the surface that a cell of depth is worth when the contacts of a pair are thinned out."""

TIE = 0.02
"""Share of the points' spacing by which a point must be better than one that was chosen before it."""

APART = 0.3
"""Contacts of a pair closer than this share of the points' spacing are merged."""

PATCH_LIMIT = 0.75
"""Share of the spacing that the contact may lie from the surface point that stands for its patch."""

SHARP = 0.995
"""Where the smoothed gradient is shorter than this, b has an edge near by, and its direction is not certain."""


@func
def frame_of(w, b, bodies: RigidArrays):
    """Origin and axes (as columns) of body ``b``, or of the plane, whose third axis is its normal, for -1."""
    axes = load33(bodies.world_numbers, w * WORLD + PLANE).transpose()
    origin = bodies.world_numbers[w * WORLD + OFFSET] * dvec3(axes[0, 2], axes[1, 2], axes[2, 2])
    if b >= 0:
        axes = load33(bodies.state, b * STATE + R)
        origin = load3(bodies.state, b * STATE + X)
    return origin, axes


@func
def distance_to(b, local, bodies: RigidArrays, shapes: ShapeArrays):
    """(gradient, distance) of body ``b``, or of the plane for -1, at a point in its frame, and the rate of a collider
    that deforms: distance of its second lattice less that of its first."""
    found = dvec4(0.0, 0.0, 1.0, local[2])
    change = ti.cast(0.0, ti.f64)
    if b >= 0:
        found = dvec4(0.0)
        blend = bodies.state[b * STATE + BLEND]
        shape = bodies.kinds[b * KINDS + SHAPE]
        for k in range(bodies.kinds[b * KINDS + LAYERS]):
            layer = sample_distance(shape + k, local, shapes)
            found += ti.select(k == 0, 1 - blend, blend) * layer
            change += ti.select(k == 0, -1.0, 1.0) * layer[3]
    return found, change


@func
def box_distance(shape, local, shapes: ShapeArrays):
    """Least distance of a point from ``shape``: outside its lattice from there, inside 0; height over a plane (-1)."""
    far = local[2]
    if shape >= 0:
        far = outside_box(shape, local, shapes).norm()
    return far


@func
def patch(p, facing, limit, shapes: ShapeArrays):
    """The place of point ``p``'s patch whose outer normal is nearest to ``facing`` (unit vector, or 0), the point
    itself where that is farther away than ``limit``; and the point's normal. In a's frame."""
    r = p * POINT
    place = dvec3(shapes.points[r], shapes.points[r + 1], shapes.points[r + 2])
    n = dvec3(shapes.points[r + 3], shapes.points[r + 4], shapes.points[r + 5])
    t = dvec3(shapes.points[r + 6], shapes.points[r + 7], shapes.points[r + 8])
    way = dvec3(0.0)
    for k in range(2):
        radius = ti.cast(shapes.points[r + 9 + k], ti.f64)
        axis = ti.select(k == 0, t, n.cross(t))
        tilt = facing.dot(axis)
        way += radius * tilt * axis - radius * (1 - ti.sqrt(ti.max(1 - tilt * tilt, 0))) * n
    if way.norm() < limit:
        place += way
    return place, n


@func
def gather_points(w, p, dt, bodies: RigidArrays, shapes: ShapeArrays, contacts: RigidContacts):
    """The surface points of pair ``p`` that may touch, thinned out: ``chosen``, -1 for none. ``reaches``: how far
    (cells) the points may be from the other surface, -1 when nothing is near."""
    a, b = contacts.pairs[p * PAIRS], contacts.pairs[p * PAIRS + 1]
    centre = load3(bodies.state, a * STATE + X)
    origin, axes = frame_of(w, b, bodies)
    shift = axes.transpose() @ (centre - origin)
    radius = bodies.numbers[a * NUMBERS + RADIUS]
    velocity = load3(bodies.state, a * STATE + V)
    speed = load3(bodies.state, a * STATE + W).norm() * radius
    awake = bodies.kinds[a * KINDS + KIND] != WAITING
    clusters_end = bodies.kinds[a * KINDS + HULL_END]
    shape = -1
    if b >= 0:
        velocity -= load3(bodies.state, b * STATE + V)
        speed += load3(bodies.state, b * STATE + W).norm() * (shift.norm() + radius)
        awake = awake and bodies.kinds[b * KINDS + KIND] != WAITING
        clusters_end = bodies.kinds[a * KINDS + CLUSTERS_END]
        shape = bodies.kinds[b * KINDS + SHAPE]
    reach = SPEEDING * dt * (speed + velocity.norm()) + REACH
    reach = ti.max(reach, contacts.pair_numbers[contacts.pairs[p * PAIRS + 3] * CONTACT + ADHESION_REACH])
    far = box_distance(shape, shift, shapes)
    contacts.reaches[p] = -1
    if awake and far < radius + reach:
        contacts.reaches[p] = reach
        reach += bodies.numbers[a * NUMBERS + BULGE]
        relative = axes.transpose() @ load33(bodies.state, a * STATE + R)
        base = p * BINS * CHOSEN
        tie = TIE * bodies.numbers[a * NUMBERS + SPACING]
        for k in range(BINS * CHOSEN):
            contacts.scores[base + k] = -1e30
            contacts.chosen[base + k] = -1
        for c in range(bodies.kinds[a * KINDS + CLUSTERS], clusters_end):
            # The cluster's middle comes first, as if it were a point, and tells whether the points need a look.
            first_point = shapes.cluster_starts[c]
            last = first_point
            i = first_point - 1
            while i < last:
                whole = i < first_point
                r = ti.max(i, 0) * POINT
                place = dvec3(shapes.points[r], shapes.points[r + 1], shapes.points[r + 2])
                if whole:
                    place = dvec3(shapes.clusters[4 * c], shapes.clusters[4 * c + 1], shapes.clusters[4 * c + 2])
                local = relative @ place + shift
                there = distance_to(b, local, bodies, shapes)[0]
                if whole:
                    away = box_distance(shape, local, shapes)
                    if ti.select(shape >= 0 and away > 0.0, away, there[3]) < reach + shapes.clusters[4 * c + 3]:
                        last = shapes.cluster_starts[c + 1]
                elif there[3] < reach:
                    g = ti.abs(dvec3(there[0], there[1], there[2]))
                    axis = ti.select(g[0] > g[1], ti.select(g[0] > g[2], 0, 2), ti.select(g[1] > g[2], 1, 2))
                    side = ti.select(axis == 0, there[0], ti.select(axis == 1, there[1], there[2]))
                    u = ti.select(axis == 0, local[1], local[0])
                    v = ti.select(axis == 2, local[1], local[2])
                    first = base + (2 * axis + ti.select(side > 0.0, 1, 0)) * CHOSEN
                    for k in range(CHOSEN):
                        # Diagonals, then axes, then depth alone.
                        sign = 2 * (k & 1) - 1
                        ku = ti.select(k < 6, sign, 0)
                        kv = ti.select(k < 4, (k & 2) - 1, ti.select(k < 6, 0, sign))
                        value = (ku * u + kv * v) * ti.select(k < 4, 0.70710678, 1.0)
                        value = ti.select(k < CHOSEN - 1, value, 0) - DEPTH_COUNTS * there[3]
                        # By a margin, so that the choice does not flicker between equally good points.
                        if value > contacts.scores[first + k] + tie:
                            contacts.scores[first + k] = value
                            contacts.chosen[first + k] = i
                i += 1


@func
def find_contacts(w, p, bodies: RigidArrays, shapes: ShapeArrays, contacts: RigidContacts):
    """The contacts of pair ``p`` from its chosen points, with the impulses that they had in the last substep."""
    a, b = contacts.pairs[p * PAIRS], contacts.pairs[p * PAIRS + 1]
    count = 0
    sure = 0
    reach = contacts.reaches[p]
    if reach >= 0.0:
        centre = load3(bodies.state, a * STATE + X)
        origin, axes = frame_of(w, b, bodies)
        relative = axes.transpose() @ load33(bodies.state, a * STATE + R)
        shift = axes.transpose() @ (centre - origin)
        spacing = bodies.numbers[a * NUMBERS + SPACING]
        step = spacing
        if b >= 0:
            step = ti.cast(shapes.lattices[4 * bodies.kinds[b * KINDS + SHAPE] + 3], ti.f64)
        base = p * BINS * CHOSEN
        for turn_number in range(2 * BINS * CHOSEN):
            # First the contacts whose normal is certain, then those at edges of both, which borrow one from those.
            k = turn_number % (BINS * CHOSEN)
            last_turn = turn_number >= BINS * CHOSEN
            i = contacts.chosen[base + k]
            if i >= 0 and count < SLOTS:
                place, own = dvec3(0.0), dvec3(0.0)
                normal, gradient = dvec3(0.0), dvec3(0.0)
                gap, change = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
                # The patch faces b's surface where b's gradient is the patch's own normal reversed: two steps.
                bent = shapes.points[i * POINT + 9] > 0.0 or shapes.points[i * POINT + 10] > 0.0
                for step_number in range(ti.select(bent, 3, 1)):
                    place, own = patch(i, -(relative.transpose() @ normal), PATCH_LIMIT * spacing, shapes)
                    gradient = dvec3(0.0)
                    for n in range(7):
                        e = dvec3(0.0)
                        for c in ti.static(range(3)):
                            e[c] = ti.select(n // 2 == c, ti.select(n % 2 == 0, -step, step), 0)
                        local = relative @ place + shift + e
                        there, rate = distance_to(b, local, bodies, shapes)
                        gradient += there[3] / (2 * step * step) * e
                        gap, change = there[3], rate
                    normal = ti.select(step_number == 0, 0, 1) * normal + gradient / ti.max(gradient.norm(), 1e-9)
                    normal /= ti.max(normal.norm(), 1e-9)
                normal = gradient / ti.max(gradient.norm(), 1e-9)
                own = relative @ own
                certain = gradient.norm() > SHARP
                r = i * POINT
                flat = shapes.points[r + 11] > 0.5 and shapes.points[r + 9] == 0.0 and shapes.points[r + 10] == 0.0
                if flat and -own.dot(normal) > 0.4:
                    normal = -own
                    certain = True
                fresh = gap < reach and (certain or last_turn)
                if fresh or gap >= reach:
                    contacts.chosen[base + k] = -1
                normal = axes @ normal
                world = axes @ (relative @ place + shift) + origin
                if fresh and not certain:
                    alike = ti.cast(0.5, ti.f64)
                    raw = normal
                    for s in range(sure):
                        stated = load3(contacts.rows, (p * SLOTS + s) * ROW + NORMAL)
                        if stated.dot(raw) > alike:
                            alike = stated.dot(raw)
                            normal = stated
                for d in range(2):
                    q = ti.select(d == 0, p, contacts.pairs[p * PAIRS + 2])
                    if q >= 0 and q <= p:
                        for s in range(ti.select(d == 0, count, contacts.counts[ti.max(q, 0)])):
                            row = (q * SLOTS + s) * ROW
                            away = load3(contacts.rows, row + ti.select(d == 0, ARM_A, ARM_B)) + centre - world
                            along = load3(contacts.rows, row + NORMAL).dot(normal) * ti.select(d == 0, 1, -1)
                            if away.norm() < APART * spacing and along > 0.9:
                                fresh = False
                if fresh:
                    row = (p * SLOTS + count) * ROW
                    for n in range(ROW):
                        contacts.rows[row + n] = 0
                    local = axes.transpose() @ (world - origin)
                    store3(contacts.rows, row + ARM_A, world - centre)
                    store3(contacts.rows, row + ARM_B, world - origin)
                    store3(contacts.rows, row + NORMAL, normal)
                    store3(contacts.rows, row + PLACE, local)
                    contacts.rows[row + GAP] = gap
                    rate = bodies.numbers[ti.max(b, 0) * NUMBERS + BLEND_RATE]
                    drift = -change * rate * normal
                    if b >= 0:
                        drift += surface_slide(b, local, normal, bodies, shapes)
                    store3(contacts.rows, row + DRIFT, drift)
                    recall(p, row, local, spacing, contacts)
                    count += 1
                    if certain:
                        sure = count
    contacts.counts[p] = count


@func
def recall(p, row, local, spacing, contacts: RigidContacts):
    """Give the contact at ``row`` the impulses of the last substep's contact in the same place, if there was one."""
    best = -1
    nearest = 0.25 * spacing * spacing
    for s in range(SLOTS):
        old = (p * SLOTS + s) * MEMORY
        if contacts.memory[old + 10] > 0.5:
            away = (load3(contacts.memory, old) - local).norm_sqr()
            if away < nearest:
                nearest = away
                best = old
    if best >= 0:
        contacts.memory[best + 10] = 0
        contacts.rows[row + IMPULSE] = contacts.memory[best + 3]
        for n in range(6):
            contacts.rows[row + RUB + n] = contacts.memory[best + 4 + n]
