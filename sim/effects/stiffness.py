# SPDX-License-Identifier: MIT
"""Young's modulus differs from the believed one.

Equation: E' = c E, at the same Poisson's ratio; a damping time stays, so the viscosity scales along.
Source: Young, A Course of Lectures on Natural Philosophy (1807).
Bodies: solids; every solid material in them. Not fluids, not rigid bodies.
Twice: factors multiply.
"""

from __future__ import annotations

import dataclasses

from ..errors import InputError
from ..mpm.bodies import BodyParticles
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import SOLIDS, change_materials, needs, solids


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    factor = values["factor"]
    return change_materials(
        setup, targets, SOLIDS, lambda m: dataclasses.replace(m, youngs_modulus=factor * m.youngs_modulus)
    )


EFFECT = Effect(
    name="stiffness",
    kind="material",
    parameters=(
        Parameter(
            name="factor",
            unit="1",
            low=1e-4,
            high=1e4,
            default=0.5,
            description="c, Young's modulus over that of the object's material",
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"factor": 1.0},
    obstacle=needs(SOLIDS, "which has no Young's modulus"),
)


def youngs_modulus(body: BodyParticles, factor: float) -> float:
    """Young's modulus in Pa that ``factor`` gives the body's first solid material."""
    return factor * _believed(body)


def _believed(body: BodyParticles) -> float:
    found = solids(body, SOLIDS)
    if not found:
        raise InputError(f"body {body.name!r} has no Young's modulus: give it a solid material that deforms")
    return found[0].youngs_modulus
