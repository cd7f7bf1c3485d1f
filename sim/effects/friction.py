# SPDX-License-Identifier: MIT
"""Coulomb's friction coefficient of a body's contacts.

Equation: |T| <= mu N, against the sliding; where the contact has a larger static coefficient, it keeps its ratio to mu.
Source: Coulomb, Théorie des machines simples (1785).
Bodies: all; every contact of theirs, with ground, colliders and each other. Contacts of mode "slip" and "sticky" have
    no friction to set.
Twice: the value is set; the last one counts.
"""

from __future__ import annotations

import dataclasses

from ..mpm.surface_contact import SurfaceContact
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import change_contacts, contact_with_ground

MOST = 10.0


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    friction = values["friction"]

    def rubbing(contact: SurfaceContact) -> SurfaceContact:
        static = contact.static_friction
        if static is not None and friction != contact.friction:
            ratio = static / contact.friction if contact.friction > 0 else 1.0
            static = max(friction, min(MOST, friction * ratio))
        return dataclasses.replace(contact, friction=friction, static_friction=static)

    return change_contacts(setup, targets, rubbing)


EFFECT = Effect(
    name="friction",
    kind="contact",
    parameters=(
        Parameter(
            name="friction",
            unit="1",
            low=0.0,
            high=MOST,
            default=0.1,
            description="kinetic coefficient: 0 is ice, 0.4 wood on wood, 0.9 rubber",
        ),
    ),
    description=__doc__,
    transform=_transform,
    current=lambda setup, targets: {"friction": contact_with_ground(setup, targets).friction},
)
