# SPDX-License-Identifier: MIT
"""An unseen spring or string to a fixed point.

Equation: a = k (d - l) towards the anchor, d the distance of the centre of mass to it, l the length at rest; a string
    pulls where d > l and does nothing else.
Source: Hooke, De Potentia Restitutiva (1678).
Bodies: all, pulled at the centre of mass without turning them.
Twice: a body has one tether; a second one is refused.
"""

from __future__ import annotations

import dataclasses

from ..errors import InputError
from ..mpm.bodies import BodyForces
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values, vector, vector_parameters
from .setup_changes import change_forces


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    def tied(forces: BodyForces) -> BodyForces:
        if forces.tether_stiffness > 0:
            raise InputError("has a tether already, and a body can have one: remove one of them")
        return dataclasses.replace(
            forces,
            tether_stiffness=values["stiffness_per_mass"],
            tether_length=values["rest_length"],
            tether_anchor=vector(values, "anchor"),
            tether_string=values["string"] > 0,
        )

    return change_forces(setup, targets, tied)


EFFECT = Effect(
    name="tether",
    kind="force",
    parameters=(
        Parameter(
            name="stiffness_per_mass",
            unit="1/s²",
            low=0.0,
            high=1e6,
            default=20.0,
            description="spring constant over mass",
        ),
        Parameter(
            name="rest_length",
            unit="m",
            low=0.0,
            high=1000.0,
            default=0.3,
            description="length at which it does not pull",
        ),
        *vector_parameters("anchor", "m", 1000.0, (0.0, 0.0, 1.0), "where it is fixed, world"),
        Parameter(
            name="string",
            unit="1",
            low=0.0,
            high=1.0,
            default=1.0,
            whole=True,
            description="1: only pulls; 0: also pushes",
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"stiffness_per_mass": 0.0},
)
