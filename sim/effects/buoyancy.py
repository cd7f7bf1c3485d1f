# SPDX-License-Identifier: MIT
"""Buoyancy: the medium carries a part of the weight, or adds to it.

Equation: a = (1 - f) g; a medium of density rho_m carries the share f = rho_m / rho_body of the weight.
Source: Archimedes, On Floating Bodies; the medium's added mass is not in it.
Bodies: all.
Twice: shares add up.
"""

from __future__ import annotations

import dataclasses

from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import change_forces


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    return change_forces(
        setup, targets, lambda f: dataclasses.replace(f, gravity_factor=f.gravity_factor - values["fraction"])
    )


EFFECT = Effect(
    name="buoyancy",
    kind="force",
    parameters=(
        Parameter(
            name="fraction",
            unit="1",
            low=-5.0,
            high=10.0,
            default=0.5,
            description="share of the weight that is carried: 1 floats, above 1 rises, below 0 weighs more",
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"fraction": 0.0},
)
