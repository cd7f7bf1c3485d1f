# SPDX-License-Identifier: MIT
"""From a given time the body is dry sand and collapses.

Equation: from the time t on |dev tau| <= -alpha tr tau with alpha = sqrt(2)/3 tan(phi), and no tension. Density and
    moduli stay (the softest ones where there are several), so that it adds neither mass nor energy nor substeps.
Source: Klár et al., Drucker–Prager elastoplasticity for sand animation, ACM TOG 35(4) (2016); alpha as in
    docs/physics.md.
Bodies: solids, snow included. Not fluids, and not rigid bodies: give them an elastic material first.
Twice: each holds from its time on until the next one's; of two at the same time the last one counts.
"""

from __future__ import annotations

import dataclasses

from ..constitutive import SandMaterial
from ..mpm.bodies import BodyParticles
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import SOLIDS, change_bodies, needs, solids


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    start = values["start"]

    def crumbling(body: BodyParticles) -> BodyParticles:
        softest = min(solids(body, SOLIDS), key=lambda m: m.youngs_modulus)
        sand = SandMaterial(
            density=softest.density,
            youngs_modulus=softest.youngs_modulus,
            poisson_ratio=softest.poisson_ratio,
            friction_angle=values["friction_angle"],
        )
        kept = [(time, index) for time, index in body.material_track if time != start]
        track = tuple(sorted([*kept, (start, len(body.materials) + 1)]))
        return dataclasses.replace(body, materials=(*body.materials, sand), material_track=track)

    return change_bodies(setup, targets, crumbling)


EFFECT = Effect(
    name="sandy",
    kind="material",
    parameters=(
        Parameter(name="start", unit="s", low=0.0, high=1e4, default=1.0, description="t, when it turns to sand"),
        Parameter(
            name="friction_angle",
            unit="rad",
            low=0.01,
            high=1.4,
            default=0.576,
            description="phi, steepest slope that stands: 0.576 is loose dry sand",
        ),
    ),
    description=__doc__,
    transform=_transform,
    obstacle=needs(SOLIDS, "which cannot turn to sand"),
)
