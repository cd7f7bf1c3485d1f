# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Where solids touch: surface points of one against the plane or the distance lattice of the other.

A pair keeps few of its contacts: on each side of b's frame that they face, the farthest in eight directions along that
side and the deepest. Those carry the same load as all of them would, and the solve converges in a few sweeps.
"""

import taichi as ti

from .layout import Integers, Scalars
from .rigid_math import Doubles, dmat3, dvec3, dvec4, load3, load33, store3
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
    ROLL,
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

APART = 0.3
"""Contacts of a pair that lie closer than this share of the points' spacing are one."""

PATCH_LIMIT = 0.75
"""Share of the spacing that the contact may lie from the surface point that stands for its patch."""

SHARP = 0.9
"""Where the smoothed gradient is shorter than this, b has an edge, and a's own normal is the better one."""


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
def patch(points: Scalars, p, facing):
    """The place of point ``p``'s patch whose outer normal is nearest to ``facing`` (unit vector); a's frame."""
    r = p * POINT
    place = dvec3(points[r], points[r + 1], points[r + 2])
    n = dvec3(points[r + 3], points[r + 4], points[r + 5])
    t = dvec3(points[r + 6], points[r + 7], points[r + 8])
    s = n.cross(t)
    fall = ti.cast(0.0, ti.f64)
    way = dvec3(0.0)
    for k in ti.static(range(2)):
        radius = ti.cast(points[r + 9 + k], ti.f64)
        axis = ti.select(k == 0, t, s)
        tilt = facing.dot(axis)
        if radius > 0.0:
            way += radius * tilt * axis
            fall += radius * (1 - ti.sqrt(ti.max(1 - tilt * tilt, 0)))
    return place, way - fall * n


@ti.func
def find_contacts(
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
    counts: Integers,
    contacts: Doubles,
    memory: Doubles,
    scores: Doubles,
    chosen: Integers,
):
    """The contacts of pair ``p``, with the impulses that they had in the last substep."""
    a, b = pairs[p * PAIRS], pairs[p * PAIRS + 1]
    other = pairs[p * PAIRS + 2]
    count = 0
    sure = 0
    centre = load3(solids, a * SOLID + X)
    turn = load33(solids, a * SOLID + R)
    origin, axes = frame_of(w, b, world_numbers, solids)
    relative = axes.transpose() @ turn
    shift = axes.transpose() @ (centre - origin)
    radius = solid_numbers[a * NUMBERS + RADIUS]
    spacing = solid_numbers[a * NUMBERS + SPACING]
    velocity = load3(solids, a * SOLID + V)
    speed = load3(solids, a * SOLID + W).norm() * radius
    awake = solid_kinds[a * KINDS + KIND] != WAITING
    clusters_end = solid_kinds[a * KINDS + HULL_END]
    if b >= 0:
        velocity -= load3(solids, b * SOLID + V)
        speed += load3(solids, b * SOLID + W).norm() * (shift.norm() + radius)
        awake = awake and solid_kinds[b * KINDS + KIND] != WAITING
        clusters_end = solid_kinds[a * KINDS + CLUSTERS_END]
    reach = SPEEDING * dt * (speed + velocity.norm()) + REACH
    reach = ti.max(reach, pair_numbers[pairs[p * PAIRS + 3] * CONTACT + ADHESION_REACH])
    bulge = solid_numbers[a * NUMBERS + BULGE]
    near = awake
    if awake:
        if b < 0:
            near = shift[2] < radius + reach
        else:
            far = outside_box(solid_kinds[b * KINDS + SHAPE], shift, shape_numbers, shape_dims)
            near = far.norm() < radius + reach
    if near:
        base = w * BINS * CHOSEN
        for k in range(BINS * CHOSEN):
            scores[base + k] = -1e30
            chosen[base + k] = -1
        for c in range(solid_kinds[a * KINDS + CLUSTERS], clusters_end):
            middle = relative @ dvec3(clusters[4 * c], clusters[4 * c + 1], clusters[4 * c + 2]) + shift
            least = middle[2]
            if b >= 0:
                away = outside_box(solid_kinds[b * KINDS + SHAPE], middle, shape_numbers, shape_dims).norm()
                least = away
                if away == 0.0:
                    least = distance_to(b, middle, solid_kinds, solids, shape_numbers, shape_dims, distances)[0][3]
            if least < reach + bulge + clusters[4 * c + 3]:
                for i in range(cluster_starts[c], cluster_starts[c + 1]):
                    r = i * POINT
                    local = relative @ dvec3(points[r], points[r + 1], points[r + 2]) + shift
                    there = distance_to(b, local, solid_kinds, solids, shape_numbers, shape_dims, distances)[0]
                    if there[3] < reach + bulge:
                        g = ti.abs(dvec3(there[0], there[1], there[2]))
                        axis = ti.select(g[0] > g[1], ti.select(g[0] > g[2], 0, 2), ti.select(g[1] > g[2], 1, 2))
                        side = ti.select(axis == 0, there[0], ti.select(axis == 1, there[1], there[2]))
                        u = ti.select(axis == 0, local[1], local[0])
                        v = ti.select(axis == 2, local[1], local[2])
                        first = base + (2 * axis + ti.select(side > 0.0, 1, 0)) * CHOSEN
                        deep = -DEPTH_COUNTS * there[3]
                        for k in range(CHOSEN):
                            ku = ti.select(k < 4, 2 * (k & 1) - 1, ti.select(k < 6, 2 * (k & 1) - 1, 0))
                            kv = ti.select(k < 4, (k & 2) - 1, ti.select(k < 6, 0, 2 * (k & 1) - 1))
                            value = (ku * u + kv * v) * ti.select(k < 4, 0.70710678, 1.0) + deep
                            if k == CHOSEN - 1:
                                value = deep
                            # A little more, lest rounding decides between points that are as good as each other.
                            if value > scores[first + k] + 1e-6:
                                scores[first + k] = value
                                chosen[first + k] = i
        step = spacing
        if b >= 0:
            step = ti.cast(shape_numbers[4 * solid_kinds[b * KINDS + SHAPE] + 3], ti.f64)
        for turn_number in range(2 * BINS * CHOSEN):
            # First the contacts whose normal is certain, then those at edges of both, which borrow one from those.
            k = turn_number % (BINS * CHOSEN)
            last_turn = turn_number >= BINS * CHOSEN
            i = chosen[base + k]
            if i >= 0 and count < SLOTS:
                place = dvec3(points[i * POINT], points[i * POINT + 1], points[i * POINT + 2])
                own = relative @ dvec3(points[i * POINT + 3], points[i * POINT + 4], points[i * POINT + 5])
                normal = dvec3(0.0)
                certain = False
                gap, change = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
                # The patch faces b's surface where b's gradient is the patch's own normal reversed: two steps.
                for step_number in range(3):
                    local = relative @ place + shift
                    gradient = dvec3(0.0, 0.0, 1.0)
                    if b < 0:
                        gap = local[2]
                    else:
                        gradient = dvec3(0.0)
                        for n in range(7):
                            e = dvec3(
                                ti.select(n // 2 == 0, 1.0, 0.0),
                                ti.select(n // 2 == 1, 1.0, 0.0),
                                ti.select(n // 2 == 2, 1.0, 0.0),
                            )
                            e *= ti.select(n % 2 == 0, -step, step)
                            there, rate = distance_to(
                                b, local + e, solid_kinds, solids, shape_numbers, shape_dims, distances
                            )
                            gradient += there[3] / (2 * step * step) * e
                            if n == 6:
                                gap, change = there[3], rate
                    if step_number == 0:
                        normal = gradient
                    else:
                        normal = normal / ti.max(normal.norm(), 1e-9) + gradient / ti.max(gradient.norm(), 1e-9)
                    normal /= ti.max(normal.norm(), 1e-9)
                    if step_number < 2:
                        corner, way = patch(points, i, -(relative.transpose() @ normal))
                        far = way.norm()
                        if far < PATCH_LIMIT * spacing:
                            place = corner + way
                        else:
                            place = corner
                    else:
                        normal = gradient / ti.max(gradient.norm(), 1e-9)
                        certain = gradient.norm() > SHARP
                        if not certain and -own.dot(normal) > 0.4 and points[i * POINT + 11] > 0.5:
                            normal = -own
                            certain = True
                local = relative @ place + shift
                fresh = gap < reach and (certain or last_turn)
                if fresh or gap >= reach:
                    chosen[base + k] = -1
                if not certain and fresh:
                    alike = ti.cast(0.5, ti.f64)
                    raw = normal
                    for s in range(sure):
                        stated = axes.transpose() @ load3(contacts, (p * SLOTS + s) * ROW + NORMAL)
                        if stated.dot(raw) > alike:
                            alike = stated.dot(raw)
                            normal = stated
                for s in range(count):
                    row = (p * SLOTS + s) * ROW
                    if (load3(contacts, row + PLACE) - local).norm() < APART * spacing and (
                        load3(contacts, row + NORMAL).dot(axes @ normal) > 0.9
                    ):
                        fresh = False
                world = axes @ local + origin
                if other >= 0 and other < p:
                    for s in range(counts[ti.max(other, 0)]):
                        row = (other * SLOTS + s) * ROW
                        if (load3(contacts, row + ARM_B) + centre - world).norm() < APART * spacing and (
                            load3(contacts, row + NORMAL).dot(axes @ normal) < -0.9
                        ):
                            fresh = False
                if fresh:
                    row = (p * SLOTS + count) * ROW
                    for n in range(ROW):
                        contacts[row + n] = 0
                    store3(contacts, row + ARM_A, world - centre)
                    store3(contacts, row + ARM_B, world - origin)
                    store3(contacts, row + NORMAL, axes @ normal)
                    store3(contacts, row + PLACE, local)
                    contacts[row + GAP] = gap
                    if b >= 0:
                        rate = solid_numbers[ti.max(b, 0) * NUMBERS + BLEND_RATE]
                        store3(contacts, row + DRIFT, -change * rate * (axes @ normal))
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
