# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Where two deformable bodies face each other at a node: normal and gap, from the shares of both there and around.

``deformable_contact`` has the equations. A cell from a face the distance hangs on the last hundredth of a share, and
behind a wall of a cell the node sees the air beyond: bodies that touch then seem 0.1 to 1 cell apart. Such nodes take
normal and gap from those around, which see the same face from nearer by.
"""

import taichi as ti

from .kernel_arrays import GridBlocks, NodeArrays, OverlapBlocks, WorldArrays
from .kernel_bundles import func
from .layout import (
    BLOCK_NODES,
    CONTROL_ROW,
    FIELD_INTEGERS,
    FULL,
    FULL_MASS,
    PHASE,
    SPREAD,
    THICKNESS,
    WORLD,
    vec3,
    vec4,
)
from .sorting import node_beside
from .surface_shares import LEAST_SLOPE, distance_from_middle, distance_of_share, slope_along

LEAST_WALL = 0.99
"""Cells across a thin body from which on it bounds fluids as thick ones do."""

SURE, LEAST_SURE = 0.01, 1e-4
"""Reliability of a node (see below) from which on it needs no others: 0.7 cells from plane faces; and the least of all
around that is of use."""

MOST_SHARE = 0.6
"""Share of a thick body at a node that may lie behind a thin one which touches it; 0.5 where nothing overlaps."""

LEAST_SHARE = 0.0026
"""Share below which a body is too far from the node (1.25 cells) for a distance."""


@func
def left_by_others(whole: ti.f32, a: ti.i32, lead: ti.i32, i: ti.i32, overlap: OverlapBlocks, nodes: NodeArrays):
    """What is left of ``whole`` at node ``i`` without the shares of all fields but that of block ``a``, of the blocks
    that lie where ``lead`` does."""
    left = whole
    b = lead
    while b >= 0:
        if b != a:
            left -= nodes.sums[overlap.slot[b] * BLOCK_NODES + i][3]
        b = overlap.mate[b]
    return left


@func
def facing(sa: vec4, sb: vec4):
    """Whether two fields meet at a node, by the slopes and shares ``sa`` and ``sb`` of both there; the normal from the
    first to the second, and the gap in cells."""
    found, gap = False, 0.0
    normal = vec3(sb[0] - sa[0], sb[1] - sa[1], sb[2] - sa[2])
    length = normal.norm()
    if sa[3] > LEAST_SHARE and sb[3] > LEAST_SHARE and length > 1e-6:
        normal /= length
        gap = distance_of_share(sa[3]) + distance_of_share(sb[3])
        found = True
    return found, normal, gap


@func
def reliability(sa: vec4, sb: vec4, normal: vec3):
    """How well a node tells normal and gap: the fourth power of the steepness at which both shares change there, 0
    where they do not face each other. On plane faces 0.32, a cell away 0.0002."""
    falls = -vec3(sa[0], sa[1], sa[2]).dot(normal)
    rises = vec3(sb[0], sb[1], sb[2]).dot(normal)
    return (ti.max(falls, 0.0) * ti.max(rises, 0.0)) ** 2


@func
def find_faces(worlds: WorldArrays, grid: GridBlocks, overlap: OverlapBlocks, nodes: NodeArrays):
    """What the nodes tell about the faces of the first field in each place and each other one, to ``overlap.faces``."""
    for ss in range(overlap.lead_count * SPREAD):
        if ss % SPREAD == 0:
            lead = overlap.leads[ss // SPREAD]
            w = worlds.field_integers[grid.field[lead] * FIELD_INTEGERS + WORLD]
            if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                b = overlap.mate[lead]
                while b >= 0:
                    for i in range(BLOCK_NODES):
                        sa = nodes.sums[overlap.slot[lead] * BLOCK_NODES + i]
                        sb = nodes.sums[overlap.slot[b] * BLOCK_NODES + i]
                        found, normal, gap = facing(sa, sb)
                        face = vec4(0.0)
                        if found:
                            face = reliability(sa, sb, normal) * vec4(normal[0], normal[1], normal[2], gap)
                        overlap.faces[overlap.slot[b] * BLOCK_NODES + i] = face
                    b = overlap.mate[b]


@func
def surer(b: ti.i32, i: ti.i32, sa: vec4, sb: vec4, overlap: OverlapBlocks):
    """As ``facing`` at node ``i`` of block ``b`` and of the first one there, from ``overlap.faces``; where that node is
    not reliable, normal and gap of the nodes around, which see the faces from nearer by."""
    slot = overlap.slot[b]
    face = overlap.faces[slot * BLOCK_NODES + i]
    own = vec3(face[0], face[1], face[2])
    reliable = own.norm()
    found, normal, gap = False, own / ti.max(reliable, 1e-30), face[3] / ti.max(reliable, 1e-30)
    if reliable >= SURE:
        found = True
    elif sa[3] > LEAST_SHARE and sb[3] > LEAST_SHARE:
        total = vec4(0.0)
        weight = 0.0
        for d in range(27):
            block, n = node_beside(slot, i, d, overlap.around)
            if block >= 0:
                other = overlap.slot[block]
                if other >= 0:
                    if overlap.lead_fields[other] == overlap.lead_fields[slot]:
                        seen = overlap.faces[other * BLOCK_NODES + n]
                        total += seen
                        weight += vec3(seen[0], seen[1], seen[2]).norm()
        along = vec3(total[0], total[1], total[2])
        size = along.norm()
        if size > LEAST_SURE:
            trust = reliable / SURE
            normal = trust * normal + (1.0 - trust) * along / size
            gap = trust * gap + (1.0 - trust) * total[3] / weight
            found = normal.norm() > 1e-6
            normal /= ti.max(normal.norm(), 1e-6)
        else:
            found, normal, gap = facing(sa, sb)
    return found, normal, gap


@func
def field_thickness(row: ti.i32, worlds: WorldArrays):
    """Cells across the body whose field's numbers start at ``row``; 0 where it is not thin."""
    t = 0.0
    if worlds.field_numbers[row + FULL_MASS] == 0.0:
        t = worlds.field_numbers[row + THICKNESS]
    return t


@func
def meet_as_thin(fa: ti.i32, fb: ti.i32, worlds: WorldArrays):
    """Whether ``facing_thin`` is for two fields, where their rows start: one is thin. A wall of a cell or more that
    holds a fluid is none: its outer face bears nothing, and the fluid's pressure is to act as on any other."""
    thickness = ti.max(field_thickness(fa, worlds), field_thickness(fb, worlds))
    fluid = ti.max(worlds.field_numbers[fa + FULL_MASS], worlds.field_numbers[fb + FULL_MASS]) > 0.0
    return thickness > 0.0 and not (fluid and thickness > LEAST_WALL)


@func
def facing_thin(fa: ti.i32, fb: ti.i32, sa: vec4, sb: vec4, worlds: WorldArrays):
    """As ``facing`` where bodies may be thin; ``fa`` and ``fb``: where the rows of both fields start."""
    found, direction, gap = False, vec3(0.0), 0.0
    if sa[3] > LEAST_SHARE and sb[3] > LEAST_SHARE:
        slope_a, slope_b = vec3(sa[0], sa[1], sa[2]), vec3(sb[0], sb[1], sb[2])
        ta, tb = field_thickness(fa, worlds), field_thickness(fb, worlds)
        da, db, middle_a, middle_b = 0.0, 0.0, 1e9, 1e9
        if ta > 0.0:
            middle_a = distance_from_middle(sa[3], slope_along(slope_a, slope_b, ti.cast(tb == 0.0, ti.i32)), ta)
            da = middle_a - 0.5 * ta
        else:
            da = distance_of_share(sa[3])
        if tb > 0.0:
            middle_b = distance_from_middle(sb[3], slope_along(slope_b, slope_a, ti.cast(ta == 0.0, ti.i32)), tb)
            db = middle_b - 0.5 * tb
        else:
            db = distance_of_share(sb[3])
        alike = slope_a.dot(slope_b) > 0.0 and ti.min(slope_a.norm(), slope_b.norm()) > LEAST_SLOPE
        # Well inside a thick body its share may fall towards its other face.
        if alike and middle_a < middle_b and (tb > 0.0 or sb[3] < MOST_SHARE):
            da = -middle_a - 0.5 * ta
            slope_a = -slope_a
        elif alike and middle_b < 1e8 and (ta > 0.0 or sa[3] < MOST_SHARE):
            db = -middle_b - 0.5 * tb
            slope_b = -slope_b
        normal = slope_b - slope_a
        length = normal.norm()
        if length > 1e-6:
            found, direction, gap = True, normal / length, da + db
    return found, direction, gap
