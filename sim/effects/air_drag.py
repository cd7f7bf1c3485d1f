# SPDX-License-Identifier: MIT
"""Quadratic drag in still air.

Equation: a = -k |v| v with k = rho c_d A / (2 m), rho the air's density, A the body's cross-section, m its mass.
Source: the drag equation, Rayleigh, Phil. Mag. 2 (1876); coefficients c_d in Hoerner, Fluid-Dynamic Drag (1965).
Bodies: all. Deformables are slowed by their local velocity.
Twice: coefficients add up, with those of ``wind`` too: drag acts against one air.
"""

from __future__ import annotations

import dataclasses

from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import change_forces

DRAG = Parameter(
    name="drag_per_mass", unit="1/m", low=0.0, high=100.0, default=0.05, description="rho c_d A / (2 m): drag over mass"
)


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    return change_forces(setup, targets, lambda f: dataclasses.replace(f, drag=f.drag + values["drag_per_mass"]))


EFFECT = Effect(
    name="air_drag",
    kind="force",
    parameters=(DRAG,),
    description=__doc__,
    transform=_transform,
    neutral={"drag_per_mass": 0.0},
)
