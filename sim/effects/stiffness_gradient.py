# SPDX-License-Identifier: MIT
"""Stiffness varies across a body.

Equation: E(X) = E (1 + q s), s going from -1 to 1 across the body along the direction d.
Source: the linear case of functionally graded matter, Suresh and Mortensen, Fundamentals of Functionally Graded
    Materials (1998).
Bodies: solids; every solid particle in them. Not fluids, not rigid bodies.
Twice: factors multiply.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..mpm.bodies import BodyParticles
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values, unit_vector, vector_parameters
from .setup_changes import SOLIDS, change_bodies, needs


def place_across(body: BodyParticles, direction: tuple[float, float, float]) -> NDArray[np.float64]:
    """Place (N,) of each particle along ``direction`` (unit): -1 at one end of the body's surface, 1 at the other."""
    assert body.contact_radii is not None
    along = body.positions @ np.asarray(direction)
    low, high = float((along - body.contact_radii).min()), float((along + body.contact_radii).max())
    if high - low < 1e-12 * max(1.0, abs(low), abs(high)):
        return np.zeros_like(along)
    return np.asarray(np.clip((2 * along - (low + high)) / (high - low), -1.0, 1.0))


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    direction = unit_vector(values, "direction")

    def graded(body: BodyParticles) -> BodyParticles:
        scale = 1.0 + values["slope"] * place_across(body, direction)
        if body.material_index is not None:
            solid = np.array([getattr(m, "cohesion", None) in SOLIDS for m in (body.material, *body.materials)])
            scale = np.where(solid[body.material_index], scale, 1.0)
        return dataclasses.replace(
            body, stiffness_scale=scale if body.stiffness_scale is None else scale * body.stiffness_scale
        )

    return change_bodies(setup, targets, graded)


EFFECT = Effect(
    name="stiffness_gradient",
    kind="material",
    parameters=(
        Parameter(
            name="slope",
            unit="1",
            low=-0.99,
            high=0.99,
            default=0.5,
            description="q: stiffness is 1 - q times that of the material at one end and 1 + q times at the other",
        ),
        *vector_parameters(
            "direction",
            "1",
            1.0,
            (0.0, 0.0, 1.0),
            "to the stiffer end, world axes, of the body at the start; any length",
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"slope": 0.0},
    obstacle=needs(SOLIDS, "which has no Young's modulus"),
)
