# SPDX-License-Identifier: MIT
"""Which worlds may take implicit steps (``quiet_matter``), and where these can pay. No Taichi."""

from __future__ import annotations

import math

import numpy as np

from .bodies import NO_FORCES, BodyParticles
from .rigid.rigid_layout import RECOVERY_HEIGHT
from .surface_contact import GROUND_NAME
from .world_setup import WorldSetup

LAWS = ("fixed_corotated", "neo_hookean")
"""Laws that implicit steps know."""

PAYS = 24.0
"""Explicit substeps that an implicit step has to replace, before it is known what it costs: at rest it takes 4 to 10
passes over the particles, in flight 3 to 13, where it slides or begins to carry a load many more."""

LONGEST = 4e-3
"""Seconds of an implicit step at most."""


def longest_step(most_hit: float, pull: float) -> float:
    """Longest implicit step in s under gravity of ``pull``, where matter may come to a surface at ``most_hit``."""
    return min(LONGEST, 0.5 * most_hit / max(pull, 1e-12))


def may_pay(setup: WorldSetup, explicit_step: float, cell: float) -> bool:
    """Whether implicit steps can pay where explicit ones are ``explicit_step`` s long and cells ``cell`` m wide."""
    pull = float(np.linalg.norm(setup.gravity)) / cell
    return PAYS * explicit_step < longest_step(math.sqrt(2.0 * RECOVERY_HEIGHT * pull), pull)


def why_explicit(setup: WorldSetup) -> str | None:
    """Why a world can take explicit steps only, in a few words; None if it can take implicit ones.

    While a rigid body moves, which starts later or has woken, there are explicit ones, too.
    """
    if all(body.rigid for body in setup.bodies):
        return "nothing deforms"
    if setup.gravity_track is not None:
        return "gravity changes"
    for collider in setup.colliders:
        if collider.vertices is not None:
            return f"{collider.name!r} is a collider that deforms"
    for body in setup.bodies:
        reason = _why_body(body) or _why_contact(setup, body)
        if reason is not None:
            return f"{body.name!r} {reason}"
    return None


def _why_body(body: BodyParticles) -> str | None:
    if body.rigid:
        return None if body.asleep or body.start_time > 0 else "is rigid"
    for material in body.materials_over_time:
        if material.law not in LAWS:
            return f"is of {material.law}"
        if material.fibre_modulus > 0 or material.damping_time > 0:
            return "has fibres or damping"
    if body.material_track or body.parameter_tracks:
        return "changes its material"
    if body.forces != NO_FORCES or body.acceleration is not None or body.velocity_keys is not None:
        return "is driven"
    if body.pins is not None or body.goal_stiffness > 0:
        return "is held"
    return None


def _why_contact(setup: WorldSetup, body: BodyParticles) -> str | None:
    surfaces = [collider.name for collider in setup.colliders]
    for name in surfaces if setup.ground is None else [GROUND_NAME, *surfaces]:
        contact = setup.contact(body.name, name)
        if not body.rigid and (contact.mode != "separate" or contact.restitution > 0 or contact.adhesion > 0):
            return f"sticks to {name!r} or bounces off it"
    return None
