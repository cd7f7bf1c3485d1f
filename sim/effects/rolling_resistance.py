# SPDX-License-Identifier: MIT
"""A rolling body slows down.

Equation: M = -b N w_t / |w_t|, the moment against the spin w_t along the surface under the normal force N; a rolling
    sphere of radius r loses the speed 5/7 b g / r a second.
Source: Coulomb, Théorie des machines simples (1785); Johnson, Contact Mechanics (1985), chapter 9.
Bodies: rigid ones; every contact of theirs. Deformables lose energy by their own damping.
Twice: lever arms add up.
"""

from __future__ import annotations

import dataclasses

from ..mpm.surface_contact import SurfaceContact
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import change_contacts, rigid_only


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    def slowed(contact: SurfaceContact) -> SurfaceContact:
        return dataclasses.replace(contact, rolling_resistance=contact.rolling_resistance + values["lever_arm"])

    return change_contacts(setup, targets, slowed)


EFFECT = Effect(
    name="rolling_resistance",
    kind="contact",
    parameters=(
        Parameter(
            name="lever_arm", unit="m", low=0.0, high=1.0, default=0.002, description="b, lever arm of the normal force"
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"lever_arm": 0.0},
    obstacle=rigid_only("so what it loses in rolling is lost inside it: use internal_damping, or make it rigid"),
)
