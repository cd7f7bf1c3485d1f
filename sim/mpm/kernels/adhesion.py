# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Adhesion of bodies that deform to one another, to rigid bodies and to colliders.

A pair of bodies holds together with a force of at most p m within the reach of its surfaces, p the pair's adhesion and
m the reduced mass m_a m_b / (m_a + m_b) of the two, which is the mass of one where the other is a collider. The force
is spread over the contact in proportion to the mass there. It shifts the conditions of contact: with c_i the largest
pull of contact i (impulse), j_i its impulse along the normal and t_i that along the surface,

    j_i + c_i >= 0,   v_n + gap / dt >= 0,   one of the two an equality;     |t_i| <= mu (j_i + c_i)

(Jean, Acary, Monerie 2001, Non-smooth contact dynamics approach of cohesive materials). In touch it pulls only as hard
as something pulls away, out of touch with all of c_i, beyond the reach not at all: Dugdale's constant stress, as in
Maugis 1992. Impulses act on both bodies at one point, so momentum and angular momentum are exact.

How much mass is in reach is summed anew in every substep, in whole numbers, whose sum does not depend on the order.
"""

import taichi as ti

from .collider_distance import REACH_FACTOR, body_distance
from .kernel_arrays import (
    AdhesionArrays,
    NearBlocks,
    ParticleArrays,
    ParticleBlocks,
    RigidArrays,
    ShapeArrays,
    WorldArrays,
)
from .kernel_bundles import func
from .layout import (
    ADHESION_PULL,
    ADHESION_REACH,
    ADHESION_ROW,
    ADHESION_UNIT,
    CONTROL_ROW,
    FIELD_INTEGERS,
    FIRST_RIGID_BODY,
    FIRST_TOUCH,
    FULL,
    HAS_PLANE,
    PHASE,
    PLANE_NORMAL,
    PLANE_OFFSET,
    RIGID_BODIES,
    RIGID_SPEED,
    SPEED,
    SPREAD,
    STEP,
    WORLD,
    WORLD_INTEGERS,
    WORLD_ROW,
    Keys,
    Scalars,
    triple,
)
from .windows import in_cells

LEAST_REACH, MOST_REACH = 0.1, 1.0
"""Cells between which a pair's reach is kept: surfaces are not known better, and nodes and particles see no farther."""

LEAST_PART = 0.005
"""Share of a body's mass (of two, of the reduced mass) over which the pull is spread at least: a corner that touches
with less is held by as much less, and not torn off."""

APPROACH, MOST_APPROACH = 0.2, 0.1
"""Share of a gap, and cells, by which surfaces in reach may come nearer in a substep by their pull. Gaps are known to
some hundredths of a cell: a pull that closed them at once would shake what hangs."""

WHOLE = float(1 << 40)
"""What the sums of mass in reach count a whole body as."""


@ti.func
def counted(share: ti.f32):
    """``share`` of a body's mass as the sums count it."""
    return ti.cast(share * ti.static(WHOLE), ti.i64)


@ti.func
def largest_pull(pair: ti.i32, gap: ti.f32, dt: ti.f32, rows: Scalars, sums: Keys):
    """Change of velocity (cells/s) by the largest pull of ``pair`` in a substep, its surfaces ``gap`` apart."""
    pull = 0.0
    if gap < rows[pair * ADHESION_ROW + ADHESION_REACH]:
        part = ti.cast(sums[pair], ti.f32) * ti.static(1.0 / WHOLE)
        pull = dt * rows[pair * ADHESION_ROW + ADHESION_PULL] / ti.max(part, LEAST_PART)
    return pull


@ti.func
def least_speed(gap: ti.f32, wanted: ti.f32, dt: ti.f32):
    """Least speed (cells/s) of parting that a pull may cause, where contact allows ``wanted``, negative: approach."""
    return ti.max(wanted, -ti.min(APPROACH * ti.abs(gap), MOST_APPROACH) / dt)


@func
def sum_reached(
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    near: NearBlocks,
    particles: ParticleArrays,
    bodies: RigidArrays,
    shapes: ShapeArrays,
    adhesion: AdhesionArrays,
):
    """Sum the mass that each rigid body or collider holds of each field, by particles whose nearest surface it is."""
    for n in range(adhesion.touch_count):
        adhesion.touch_sums[n] = 0
    for ss in range(near.particle_count * SPREAD):
        k = near.particle_blocks[ss // SPREAD]
        f = blocks.field[k]
        w = worlds.field_integers[f * FIELD_INTEGERS + WORLD]
        c = w * CONTROL_ROW
        fastest = ti.cast(ti.max(worlds.control[c + SPEED], worlds.control[c + RIGID_SPEED]), ti.f32)
        way = 2.0 * REACH_FACTOR * fastest * ti.cast(worlds.control[c + STEP], ti.f32)
        if worlds.control[c + PHASE] == FULL and near.slack[k] <= way:
            first_touch = worlds.field_integers[f * FIELD_INTEGERS + FIRST_TOUCH]
            first_body = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
            first_node = ti.cast(blocks.cells[k] * 4 - 1, ti.f32)
            plane = triple(worlds.numbers, w * WORLD_ROW + PLANE_NORMAL)
            level = plane.dot(first_node) - worlds.numbers[w * WORLD_ROW + PLANE_OFFSET]
            p = blocks.starts[k] + ss % SPREAD
            while p < blocks.starts[k + 1]:
                here = in_cells(particles.x[p])
                fixed = particles.constants[p]
                phi, obstacle = 1e9, 0
                if worlds.numbers[w * WORLD_ROW + HAS_PLANE] > 0.5:
                    phi = level + plane.dot(here) - fixed[3]
                for o in range(worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
                    found, _, _ = body_distance(
                        first_body + o, first_node + here, MOST_REACH + fixed[3], bodies, shapes
                    )
                    if found - fixed[3] < phi:
                        phi, obstacle = found - fixed[3], o + 1
                row = (first_touch + obstacle) * ADHESION_ROW
                if phi < adhesion.touches[row + ADHESION_REACH]:
                    share = fixed[0] * adhesion.touches[row + ADHESION_UNIT]
                    ti.atomic_add(adhesion.touch_sums[first_touch + obstacle], counted(share))
                p += SPREAD
