# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Where solids touch: surface points of one against the plane or the distance lattice of the other.

A pair keeps few of its contacts: on each side of b's frame that they face, the farthest in eight directions along that
side and the deepest. Those carry the same load as all of them would, and the solve converges in a few sweeps.
"""

import taichi as ti

from .layout import Integers, Scalars
from .rigid_math import Doubles, dvec3, dvec4, load3, load33, store3
from .shapes import outside_box, sample_distance
from .solid_layout import (
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
    SOLID,
    SPACING,
    WAITING,
    WORLD,
    R,
    V,
    W,
    X,
)

REACH = 0.02
"""Cells from the other surface within which points of a solid at rest count as touching."""

SPEEDING = 1.5
"""Factor by which solids may speed up within a substep."""

DEPTH_COUNTS = 4.0
"""Cells along the surface that a cell of depth is worth when the contacts of a pair are thinned out."""

TIE = 0.02
"""Share of the points' spacing by which a point must be better than one that was chosen before it."""

APART = 0.3
"""Contacts of a pair that lie closer than this share of the points' spacing are one."""

PATCH_LIMIT = 0.75
"""Share of the spacing that the contact may lie from the surface point that stands for its patch."""

SHARP = 0.995
"""Where the smoothed gradient is shorter than this, b has an edge near by, and its direction is not certain."""


@ti.func
def frame_of(w, b, world_numbers: Doubles, solids: Doubles):
    """Origin and axes (as columns) of solid ``b``, or of the plane, whose third axis is its normal, for -1."""
    axes = load33(world_numbers, w * WORLD + PLANE).transpose()
    origin = world_numbers[w * WORLD + OFFSET] * dvec3(axes[0, 2], axes[1, 2], axes[2, 2])
    if b >= 0:
        axes = load33(solids, b * SOLID + R)
        origin = load3(solids, b * SOLID + X)
    return origin, axes


@ti.func
def distance_to(
    b,
    local,
    solid_kinds: Integers,
    solids: Doubles,
    shape_numbers: Scalars,
    shape_dims: Integers,
    distances: Scalars,
):
    """(gradient, distance) of solid ``b``, or of the plane for -1, at a point in its frame, and the rate of a collider
    that deforms: distance of its second lattice less that of its first."""
    found = dvec4(0.0, 0.0, 1.0, local[2])
    change = ti.cast(0.0, ti.f64)
    if b >= 0:
        found = dvec4(0.0)
        blend = solids[b * SOLID + BLEND]
        shape = solid_kinds[b * KINDS + SHAPE]
        for k in range(solid_kinds[b * KINDS + LAYERS]):
            layer = sample_distance(shape + k, local, shape_numbers, shape_dims, distances)
            found += ti.select(k == 0, 1 - blend, blend) * layer
            change += ti.select(k == 0, -1.0, 1.0) * layer[3]
    return found, change


@ti.func
def box_distance(shape, local, shape_numbers: Scalars, shape_dims: Integers):
    """Least distance of a point from ``shape``: outside its lattice from there, inside 0; height over a plane (-1)."""
    far = local[2]
    if shape >= 0:
        far = outside_box(shape, local, shape_numbers, shape_dims).norm()
    return far


@ti.func
def patch(points: Scalars, p, facing, limit):
    """The place of point ``p``'s patch whose outer normal is nearest to ``facing`` (unit vector, or 0), the point
    itself where that is farther away than ``limit``; and the point's normal. In a's frame."""
    r = p * POINT
    place = dvec3(points[r], points[r + 1], points[r + 2])
    n = dvec3(points[r + 3], points[r + 4], points[r + 5])
    t = dvec3(points[r + 6], points[r + 7], points[r + 8])
    way = dvec3(0.0)
    for k in range(2):
        radius = ti.cast(points[r + 9 + k], ti.f64)
        axis = ti.select(k == 0, t, n.cross(t))
        tilt = facing.dot(axis)
        way += radius * tilt * axis - radius * (1 - ti.sqrt(ti.max(1 - tilt * tilt, 0))) * n
    if way.norm() < limit:
        place += way
    return place, n


@ti.func
def gather_points(
    w,
    p,
    dt,
    world_numbers: Doubles,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    clusters: Scalars,
    cluster_starts: Integers,
    points: Scalars,
    shape_numbers: Scalars,
    shape_dims: Integers,
    distances: Scalars,
    pairs: Integers,
    pair_numbers: Doubles,
    reaches: Doubles,
    scores: Doubles,
    chosen: Integers,
):
    """The surface points of pair ``p`` that may touch, thinned out: ``chosen``, -1 for none. ``reaches``: how far
    (cells) the points may be from the other surface, -1 when nothing is near."""
    a, b = pairs[p * PAIRS], pairs[p * PAIRS + 1]
    centre = load3(solids, a * SOLID + X)
    origin, axes = frame_of(w, b, world_numbers, solids)
    shift = axes.transpose() @ (centre - origin)
    radius = solid_numbers[a * NUMBERS + RADIUS]
    velocity = load3(solids, a * SOLID + V)
    speed = load3(solids, a * SOLID + W).norm() * radius
    awake = solid_kinds[a * KINDS + KIND] != WAITING
    clusters_end = solid_kinds[a * KINDS + HULL_END]
    shape = -1
    if b >= 0:
        velocity -= load3(solids, b * SOLID + V)
        speed += load3(solids, b * SOLID + W).norm() * (shift.norm() + radius)
        awake = awake and solid_kinds[b * KINDS + KIND] != WAITING
        clusters_end = solid_kinds[a * KINDS + CLUSTERS_END]
        shape = solid_kinds[b * KINDS + SHAPE]
    reach = SPEEDING * dt * (speed + velocity.norm()) + REACH
    reach = ti.max(reach, pair_numbers[pairs[p * PAIRS + 3] * CONTACT + ADHESION_REACH])
    far = box_distance(shape, shift, shape_numbers, shape_dims)
    reaches[p] = -1
    if awake and far < radius + reach:
        reaches[p] = reach
        reach += solid_numbers[a * NUMBERS + BULGE]
        relative = axes.transpose() @ load33(solids, a * SOLID + R)
        base = p * BINS * CHOSEN
        tie = TIE * solid_numbers[a * NUMBERS + SPACING]
        for k in range(BINS * CHOSEN):
            scores[base + k] = -1e30
            chosen[base + k] = -1
        for c in range(solid_kinds[a * KINDS + CLUSTERS], clusters_end):
            # The cluster's middle comes first, as if it were a point, and tells whether the points need a look.
            first_point = cluster_starts[c]
            last = first_point
            i = first_point - 1
            while i < last:
                whole = i < first_point
                r = ti.max(i, 0) * POINT
                place = dvec3(points[r], points[r + 1], points[r + 2])
                if whole:
                    place = dvec3(clusters[4 * c], clusters[4 * c + 1], clusters[4 * c + 2])
                local = relative @ place + shift
                there = distance_to(b, local, solid_kinds, solids, shape_numbers, shape_dims, distances)[0]
                if whole:
                    away = box_distance(shape, local, shape_numbers, shape_dims)
                    if ti.select(shape >= 0 and away > 0.0, away, there[3]) < reach + clusters[4 * c + 3]:
                        last = cluster_starts[c + 1]
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
                        # Clearly more, lest the choice wavers between points that are as good as each other.
                        if value > scores[first + k] + tie:
                            scores[first + k] = value
                            chosen[first + k] = i
                i += 1


@ti.func
def find_contacts(
    w,
    p,
    world_numbers: Doubles,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    points: Scalars,
    shape_numbers: Scalars,
    shape_dims: Integers,
    distances: Scalars,
    pairs: Integers,
    counts: Integers,
    contacts: Doubles,
    memory: Doubles,
    reaches: Doubles,
    chosen: Integers,
):
    """The contacts of pair ``p`` from its chosen points, with the impulses that they had in the last substep."""
    a, b = pairs[p * PAIRS], pairs[p * PAIRS + 1]
    count = 0
    sure = 0
    reach = reaches[p]
    if reach >= 0.0:
        centre = load3(solids, a * SOLID + X)
        origin, axes = frame_of(w, b, world_numbers, solids)
        relative = axes.transpose() @ load33(solids, a * SOLID + R)
        shift = axes.transpose() @ (centre - origin)
        spacing = solid_numbers[a * NUMBERS + SPACING]
        step = spacing
        if b >= 0:
            step = ti.cast(shape_numbers[4 * solid_kinds[b * KINDS + SHAPE] + 3], ti.f64)
        base = p * BINS * CHOSEN
        for turn_number in range(2 * BINS * CHOSEN):
            # First the contacts whose normal is certain, then those at edges of both, which borrow one from those.
            k = turn_number % (BINS * CHOSEN)
            last_turn = turn_number >= BINS * CHOSEN
            i = chosen[base + k]
            if i >= 0 and count < SLOTS:
                place, own = dvec3(0.0), dvec3(0.0)
                normal, gradient = dvec3(0.0), dvec3(0.0)
                gap, change = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
                # The patch faces b's surface where b's gradient is the patch's own normal reversed: two steps.
                bent = points[i * POINT + 9] > 0.0 or points[i * POINT + 10] > 0.0
                for step_number in range(ti.select(bent, 3, 1)):
                    place, own = patch(points, i, -(relative.transpose() @ normal), PATCH_LIMIT * spacing)
                    gradient = dvec3(0.0)
                    for n in range(7):
                        e = dvec3(0.0)
                        for c in ti.static(range(3)):
                            e[c] = ti.select(n // 2 == c, ti.select(n % 2 == 0, -step, step), 0)
                        local = relative @ place + shift + e
                        there, rate = distance_to(b, local, solid_kinds, solids, shape_numbers, shape_dims, distances)
                        gradient += there[3] / (2 * step * step) * e
                        gap, change = there[3], rate
                    normal = ti.select(step_number == 0, 0, 1) * normal + gradient / ti.max(gradient.norm(), 1e-9)
                    normal /= ti.max(normal.norm(), 1e-9)
                normal = gradient / ti.max(gradient.norm(), 1e-9)
                own = relative @ own
                certain = gradient.norm() > SHARP
                r = i * POINT
                flat = points[r + 11] > 0.5 and points[r + 9] == 0.0 and points[r + 10] == 0.0
                if flat and -own.dot(normal) > 0.4:
                    normal = -own
                    certain = True
                fresh = gap < reach and (certain or last_turn)
                if fresh or gap >= reach:
                    chosen[base + k] = -1
                normal = axes @ normal
                world = axes @ (relative @ place + shift) + origin
                if fresh and not certain:
                    alike = ti.cast(0.5, ti.f64)
                    raw = normal
                    for s in range(sure):
                        stated = load3(contacts, (p * SLOTS + s) * ROW + NORMAL)
                        if stated.dot(raw) > alike:
                            alike = stated.dot(raw)
                            normal = stated
                for d in range(2):
                    q = ti.select(d == 0, p, pairs[p * PAIRS + 2])
                    if q >= 0 and q <= p:
                        for s in range(ti.select(d == 0, count, counts[ti.max(q, 0)])):
                            row = (q * SLOTS + s) * ROW
                            away = load3(contacts, row + ti.select(d == 0, ARM_A, ARM_B)) + centre - world
                            along = load3(contacts, row + NORMAL).dot(normal) * ti.select(d == 0, 1, -1)
                            if away.norm() < APART * spacing and along > 0.9:
                                fresh = False
                if fresh:
                    row = (p * SLOTS + count) * ROW
                    for n in range(ROW):
                        contacts[row + n] = 0
                    local = axes.transpose() @ (world - origin)
                    store3(contacts, row + ARM_A, world - centre)
                    store3(contacts, row + ARM_B, world - origin)
                    store3(contacts, row + NORMAL, normal)
                    store3(contacts, row + PLACE, local)
                    contacts[row + GAP] = gap
                    rate = solid_numbers[ti.max(b, 0) * NUMBERS + BLEND_RATE]
                    store3(contacts, row + DRIFT, -change * rate * normal)
                    recall(p, row, local, spacing, contacts, memory)
                    count += 1
                    if certain:
                        sure = count
    counts[p] = count


@ti.func
def recall(p, row, local, spacing, contacts: Doubles, memory: Doubles):
    """Give the contact at ``row`` the impulses of the last substep's contact in the same place, if there was one."""
    best = -1
    nearest = 0.25 * spacing * spacing
    for s in range(SLOTS):
        old = (p * SLOTS + s) * MEMORY
        if memory[old + 10] > 0.5:
            away = (load3(memory, old) - local).norm_sqr()
            if away < nearest:
                nearest = away
                best = old
    if best >= 0:
        memory[best + 10] = 0
        contacts[row + IMPULSE] = memory[best + 3]
        for n in range(6):
            contacts[row + RUB + n] = memory[best + 4 + n]
