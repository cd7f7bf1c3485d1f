# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Springs between particles and the surfaces that they touch in an implicit step, and the arrays of a step.

``implicit_step`` has the equations. The nearest of ground and colliders is found once, at the beginning of the step;
``pushed`` is its force on a particle after any displacement.
"""

from typing import NamedTuple

import taichi as ti

from ..rigid.rigid_layout import STATE, V, W, X
from .collider_distance import body_distance, single3
from .kernel_arrays import (
    NearBlocks,
    ParticleArrays,
    ParticleBlocks,
    RigidArrays,
    ShapeArrays,
    WorldArrays,
)
from .kernel_bundles import func, kernel
from .layout import (
    FIELD_INTEGERS,
    FIRST_RIGID_BODY,
    FIRST_TOUCH,
    HAS_PLANE,
    PLANE_NORMAL,
    PLANE_OFFSET,
    RIGID_BODIES,
    SLIDING,
    SPREAD,
    STICKING,
    TOUCH_ROW,
    Scalars,
    Vectors4,
    triple,
    vec3,
    vec4,
)
from .windows import in_cells

CONTACT_STIFFNESS = 4.0
"""Stiffness of the spring between a particle and a surface over (2 mu + lambda) V0, per cell²: of a particle's share
of the surface, a quarter of a cell², half a cell of the matter has this."""

FREE = -1.0
"""State of a particle that no surface pushes; of one that is pushed, the share of the spring along the surface that
friction bears, 1 where it sticks."""

CLOSE = 1e-4
"""Cells from a surface within which a particle counts as touching it for the solver, which else would let what stands
on it fall first."""

CENTRING = 0.1
"""Share of its gap by which a particle that a collider pushes is brought back to the surface in a step: where that is
round, what slides along its tangent plane leaves it."""

REACH = 2.0
"""Cells from a surface within which particles may come to touch it."""

YIELDING = 0.5
"""Share of the secant stiffness of friction that slides which the solver counts with: with all of it, as iteratively
reweighted least squares have it, no step overshoots, but they are slow; half is the least that is stable."""


class ImplicitArrays(NamedTuple):
    """Values at nodes and particles of an implicit step. G grid blocks, P particle blocks, N particles."""

    given: Vectors4
    """(G, BLOCK_NODES) what a kernel reads at the nodes."""

    motion: Vectors4
    """(G, BLOCK_NODES) velocities at the end of the step, cells/s."""

    found: Vectors4
    """(G, BLOCK_NODES) what a kernel sums up at the nodes."""

    contact: Vectors4
    """(N,) force of a surface on a particle at the end of the step (kg cells/s²), and the state of the contact."""

    surface: Vectors4
    """(N,) normal of the nearest surface, and how far it is from the particle at the beginning (cells)."""

    carried: Vectors4
    """(N,) displacement of that surface over the step (cells), and its row of contacts."""

    report: Scalars
    """(P, REPORT)"""


@func
def ground_of(k: ti.i32, worlds: WorldArrays, blocks: ParticleBlocks):
    """Normal of the ground, and its distance (cells) from the origin of block ``k``'s window; far if there is none."""
    normal = triple(worlds.numbers, PLANE_NORMAL)
    level = normal.dot(ti.cast(blocks.cells[k] * 4 - 1, ti.f32)) - worlds.numbers[PLANE_OFFSET]
    if worlds.numbers[HAS_PLANE] < 0.5:
        level = 1e9
    return normal, level


@kernel
def find_surfaces(
    dt: ti.f32,
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    near: NearBlocks,
    particles: ParticleArrays,
    bodies: RigidArrays,
    shapes: ShapeArrays,
    arrays: ImplicitArrays,
):
    """The surface nearest to each particle, ``surface``, and its displacement over ``dt``, ``carried``."""
    for kk in range(blocks.count * SPREAD):
        if kk % SPREAD == 0:
            k = kk // SPREAD
            plane, level = ground_of(k, worlds, blocks)
            first_touch = worlds.field_integers[blocks.field[k] * FIELD_INTEGERS + FIRST_TOUCH]
            first_node = ti.cast(blocks.cells[k] * 4 - 1, ti.f32)
            first = worlds.integers[FIRST_RIGID_BODY]
            colliders = ti.select(near.slot[k] >= 0, worlds.integers[RIGID_BODIES], 0)
            for p in range(blocks.starts[k], blocks.starts[k + 1]):
                here = in_cells(particles.x[p])
                radius = particles.constants[p][3]
                gap, normal, moved, row = level + plane.dot(here) - radius, plane, vec3(0.0), first_touch * TOUCH_ROW
                for o in range(colliders):
                    distance, along, _ = body_distance(first + o, first_node + here, REACH + radius, bodies, shapes)
                    if distance - radius < gap:
                        start = (first + o) * STATE
                        arm = first_node + here - single3(bodies.state, start + X)
                        moved = dt * (single3(bodies.state, start + V) + single3(bodies.state, start + W).cross(arm))
                        gap, normal, row = distance - radius, along, (first_touch + o + 1) * TOUCH_ROW
                arrays.surface[p] = vec4(normal[0], normal[1], normal[2], gap)
                arrays.carried[p] = vec4(moved[0], moved[1], moved[2], ti.cast(row, ti.f32))


@func
def contact_stiffness(p: ti.i32, particles: ParticleArrays):
    """Of the spring between particle ``p`` and a surface, kg/s²."""
    return CONTACT_STIFFNESS * (particles.constants[p][1] + particles.constants[p][2])


@func
def pushed(
    p: ti.i32,
    touch: ti.i32,
    is_ground: ti.i32,
    gap: ti.f32,
    normal: vec3,
    shift: vec3,
    worlds: WorldArrays,
    particles: ParticleArrays,
):
    """Force of a surface (kg cells/s²) on particle ``p``, ``gap`` cells away before the particle moves by ``shift``
    against it, and the state of the contact."""
    past = particles.reaction[p]
    before = particles.constants[p][0] * vec3(past[0], past[1], past[2])
    stiffness = contact_stiffness(p, particles)
    along = shift.dot(normal)
    pressed = before.dot(normal)
    # A contact goes on from where it is; a new one begins at the surface.
    moved = along
    if pressed <= 0.0:
        moved += ti.max(gap, 0.0)
    elif not is_ground:
        moved += CENTRING * gap
    trial = pressed - stiffness * moved
    pressing = ti.max(0.0, trial)
    force = pressing * normal
    state = FREE
    if trial > -CLOSE * stiffness:
        state = 1.0
        rubbing = before - pressed * normal - stiffness * (shift - along * normal)
        size = rubbing.norm()
        if size > 0.0 and size > worlds.contacts[touch + STICKING] * pressing:
            share = worlds.contacts[touch + SLIDING] * pressing / size
            rubbing *= share
            state = YIELDING * share
        force += rubbing
    return force, state
