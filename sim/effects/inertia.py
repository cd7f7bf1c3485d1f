# SPDX-License-Identifier: MIT
"""The moments of inertia are not those of uniform density: a hollow body has more, one with a heavy core less.

Equation: J' = k J, the tensor of inertia J about the centre of mass c; mass and centre stay. A thin shell has k = 5/3
    if it is a ball or a cube. A free body turns alike whatever k is: it shows in contact only.
Source: moments of inertia of solids and shells, Goldstein, Poole and Safko, Classical Mechanics (2002), chapter 5.
Bodies: rigid.
Twice: factors multiply.
"""

from __future__ import annotations

import dataclasses

from ..mpm.bodies import BodyParticles
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import change_bodies, rigid_only


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    def harder_to_turn(body: BodyParticles) -> BodyParticles:
        return dataclasses.replace(body, inertia_factor=body.inertia_factor * values["factor"])

    return change_bodies(setup, targets, harder_to_turn)


EFFECT = Effect(
    name="inertia",
    kind="mass",
    parameters=(
        Parameter(
            name="factor",
            unit="1",
            low=0.3,
            high=3.0,
            default=1.6,
            description="k, over the moments of inertia of the body as it is",
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"factor": 1.0},
    obstacle=rigid_only("so its inertia is where its matter is: use mass_offset, or make it rigid"),
)
