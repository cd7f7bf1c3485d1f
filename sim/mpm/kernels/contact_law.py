# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""The law of contact of a particle with a surface: no attraction beyond adhesion, no penetration, Coulomb friction.

    phi_p = distance(x_p) - r_p              r_p: contact radius, the particle's distance to its body's surface
    a_n >= 0,   v_n + phi_p / dt >= 0,   one of the two an equality         (no attraction, no penetration)
    |a_t| <= mu_s a_n,   v_t = 0 inside the cone, mu_k a_n beyond it        (Coulomb; v against the surface's velocity)

Where the pair's restitution e is above 0, the share e of a_n comes from a spring on the depth instead, which gives back
the energy of the layer that the inelastic condition stops.
"""

import taichi as ti

from .adhesion import least_speed
from .kernel_arrays import WorldArrays
from .kernel_bundles import func
from .layout import MODE, RESTITUTION, SEPARATE, SLIDING, SLIP, STICKING, vec3

RECOVERY = 0.2
"""Share of a particle's penetration that one substep may correct."""

SPRING = 0.15
"""Share of a particle's depth, in velocity times substep, that an elastic contact gives back each substep: the spring
of a layer one cell thick where waves travel 0.39 cells a substep, hence as stable as the body itself."""

HOLD = 0.1
"""Cells within which surfaces that must not part count as touching."""


@ti.func
def parting_speed(gap: ti.f32, dt: ti.f32, recovery: ti.f32):
    """Least separating speed (cells/s) of surfaces ``gap`` cells apart: they may touch; depth is reduced gently."""
    speed = -gap / dt
    if gap < 0.0:
        speed = ti.min(RECOVERY * speed, recovery)
    return speed


@ti.func
def coulomb(wanted: vec3, normal_size: ti.f32, sticking: ti.f32, sliding: ti.f32):
    """Return the tangential impulse ``wanted`` to stop sliding, limited by friction on ``normal_size``."""
    size = wanted.norm()
    result = wanted
    if size > sticking * normal_size:
        result = wanted * (sliding * normal_size / size)
    return result


@func
def press(
    adheres: ti.template(),
    old: vec3,
    velocity: vec3,
    phi: ti.f32,
    normal: vec3,
    share: ti.f32,
    dt: ti.f32,
    recovery: ti.f32,
    touch: ti.i32,
    pull: ti.f32,
    worlds: WorldArrays,
):
    """New impulse over mass (cells/s) of a particle that moves at ``velocity`` against a surface ``phi`` cells away,
    which pulls with at most ``pull`` (cells/s) where it ``adheres``."""
    v_n = velocity.dot(normal)
    wanted = parting_speed(phi, dt, recovery)
    old_n = old.dot(normal)
    elastic = worlds.contacts[touch + RESTITUTION]
    new_n = (1.0 - elastic) * (old_n + (wanted - v_n) / share) + elastic * (SPRING * ti.max(0.0, -phi) / (dt * share))
    new_t = old - old_n * normal - (velocity - v_n * normal) / share
    mode = ti.cast(worlds.contacts[touch + MODE], ti.i32)
    if mode == SEPARATE or phi > HOLD:
        pressing = ti.max(0.0, new_n)
        new_n = pressing
        if ti.static(adheres):
            if pressing == 0.0:
                new_n = ti.max(-pull, ti.min(0.0, old_n + (least_speed(phi, wanted, dt) - v_n) / share))
            pressing = new_n + pull
        new_t = coulomb(new_t, pressing, worlds.contacts[touch + STICKING], worlds.contacts[touch + SLIDING])
    elif mode == SLIP:
        new_t *= 0.0
    return new_n * normal + new_t
