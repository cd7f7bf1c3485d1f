# SPDX-License-Identifier: MIT
"""Drag against moving air.

Equation: a = -k |v - w| (v - w) with the air's velocity w and k = rho c_d A / (2 m).
Source: the drag equation, Rayleigh, Phil. Mag. 2 (1876), in the frame of the air.
Bodies: all. Matter that deforms is pushed by the difference of its local velocity.
Twice: there is one air: velocities add up, and so do coefficients, with those of ``air_drag`` too.
"""

from __future__ import annotations

import dataclasses

from ..mpm.bodies import BodyForces
from ..mpm.world_setup import WorldSetup
from .air_drag import DRAG
from .schema import Effect, Targets, Values, vector, vector_parameters
from .setup_changes import change_forces


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    x, y, z = vector(values, "wind")

    def blown(forces: BodyForces) -> BodyForces:
        wind = (forces.wind[0] + x, forces.wind[1] + y, forces.wind[2] + z)
        return dataclasses.replace(forces, drag=forces.drag + values["drag_per_mass"], wind=wind)

    return change_forces(setup, targets, blown)


EFFECT = Effect(
    name="wind",
    kind="force",
    parameters=(DRAG, *vector_parameters("wind", "m/s", 100.0, (3.0, 0.0, 0.0), "velocity of the air")),
    description=__doc__,
    transform=_transform,
    neutral={"drag_per_mass": 0.0, "wind_x": 0.0, "wind_y": 0.0, "wind_z": 0.0},
)
