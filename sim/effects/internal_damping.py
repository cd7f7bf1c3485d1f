# SPDX-License-Identifier: MIT
"""Viscous loss inside a body.

Equation: tau += t (2 mu D + lambda tr D), D the rate of strain, t = viscosity / modulus (Kelvin–Voigt); a vibration of
    angular frequency w decays at the rate t w² / 2.
Source: Landau and Lifshitz, Theory of Elasticity (1986), chapter V, viscosity of solids.
Bodies: solids that hold together (elastic, plastic, snow). Not sand, whose grains rub, not fluids, not rigid bodies.
Twice: times add up.
"""

from __future__ import annotations

import dataclasses

from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import COHERENT_SOLIDS, change_materials, needs


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    more = values["damping_time"]
    return change_materials(
        setup, targets, COHERENT_SOLIDS, lambda m: dataclasses.replace(m, damping_time=m.damping_time + more)
    )


EFFECT = Effect(
    name="internal_damping",
    kind="material",
    parameters=(
        Parameter(
            name="damping_time",
            unit="s",
            low=0.0,
            high=10.0,
            default=0.001,
            description="t, retardation time; long ones cost substeps (docs/physics.md)",
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"damping_time": 0.0},
    obstacle=needs(COHERENT_SOLIDS, "which has no inner damping of this kind"),
)
