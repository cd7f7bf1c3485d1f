# SPDX-License-Identifier: MIT
"""A surface attracts a body that separates from it.

Equation: a = -p n within the reach r of the surface, n its normal; parting takes the work p r per mass.
    Of two bodies, p is the pull over their reduced mass, m_a m_b / (m_a + m_b).
Source: Maugis, Adhesion of spheres: the JKR–DMT transition using a Dugdale model, J. Colloid Interface Sci. 150 (1992):
    a constant pull up to a largest distance, here per mass of the body and not per area of contact.
Bodies: all; every contact of theirs.
Twice: pulls of equal reach add up; a contact has one reach, and another one is refused.
"""

from __future__ import annotations

import dataclasses

from ..errors import InputError
from ..mpm.surface_contact import SurfaceContact
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import change_contacts


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    pull, reach = values["pull_per_mass"], values["reach"]

    def held(contact: SurfaceContact) -> SurfaceContact:
        if contact.adhesion > 0 and contact.adhesion_reach != reach:
            raise InputError(
                f"reach is {reach:g}: the contact pulls within {contact.adhesion_reach:g} m already; "
                "give the same reach, or remove one of them"
            )
        return dataclasses.replace(contact, adhesion=contact.adhesion + pull, adhesion_reach=reach)

    return change_contacts(setup, targets, held)


EFFECT = Effect(
    name="adhesion",
    kind="contact",
    parameters=(
        Parameter(
            name="pull_per_mass",
            unit="m/s²",
            low=0.0,
            high=1e5,
            default=30.0,
            description="p, pull over the body's mass; of two bodies, over their reduced mass",
        ),
        Parameter(
            name="reach", unit="m", low=0.0, high=1.0, default=0.005, description="r, distance within which it pulls"
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"pull_per_mass": 0.0},
)
