# SPDX-License-Identifier: MIT
"""Lift on a spinning body, perpendicular to its velocity and its axis.

Equation: a = s w x v with the spin w and s = S / m; a sphere in slow flow has s = 3 rho_air / (4 rho_body).
Source: Rubinow and Keller, The transverse force on a spinning sphere moving in a viscous fluid, J. Fluid
    Mech. 11 (1961).
Bodies: all, with the velocity and spin of the body as a whole. The air is assumed to be still.
Twice: coefficients add up.
"""

from __future__ import annotations

import dataclasses

from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import change_forces


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    return change_forces(setup, targets, lambda f: dataclasses.replace(f, lift=f.lift + values["lift_per_mass"]))


EFFECT = Effect(
    name="magnus",
    kind="force",
    parameters=(
        Parameter(
            name="lift_per_mass",
            unit="1",
            low=-10.0,
            high=10.0,
            default=0.01,
            description="S / m: acceleration over spin times speed; negative bends the other way",
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"lift_per_mass": 0.0},
)
