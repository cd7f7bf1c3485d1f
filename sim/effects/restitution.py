# SPDX-License-Identifier: MIT
"""Coefficient of restitution: how fast a body separates after an impact.

Equation: v_n' = -e v_n, v_n the speed of approach at the contact.
Source: Newton, Principia (1687), scholium to the laws of motion.
Bodies: all. Deformables bounce by their own elasticity; for them e is the share of their outermost layer's
    energy that is returned.
Twice: the value is set; the last one counts.
"""

from __future__ import annotations

import dataclasses

from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import change_contacts, contact_with_ground, rigid_only


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    return change_contacts(setup, targets, lambda c: dataclasses.replace(c, restitution=values["restitution"]))


EFFECT = Effect(
    name="restitution",
    kind="contact",
    parameters=(
        Parameter(
            name="restitution",
            unit="1",
            low=0.0,
            high=1.0,
            default=0.7,
            description="speed of leaving over speed of approach: 0 does not bounce, 1 loses nothing",
        ),
    ),
    description=__doc__,
    transform=_transform,
    current=lambda setup, targets: {"restitution": contact_with_ground(setup, targets).restitution},
    obstacle=rigid_only("so its bounce is that of its material: use stiffness or internal_damping, or make it rigid"),
)
