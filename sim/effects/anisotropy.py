# SPDX-License-Identifier: MIT
"""Stiffer along one axis: fibres in the body.

Equation: psi += k/2 (s - 1)², s the stretch of the fibres; a bar along them has the modulus E + k at small strain.
Source: Bonet and Burton, A simple orthotropic, transversely isotropic hyperelastic constitutive equation for large
    strain computations, Comput. Methods Appl. Mech. Eng. 162 (1998).
Bodies: solids that have a shape (elastic, plastic). Not snow, sand and fluids, not rigid bodies.
Twice: moduli along the same axis add up; matter has one axis, and another one is refused.
"""

from __future__ import annotations

import dataclasses
import math

from ..constitutive import DeformableMaterial
from ..errors import InputError
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values, unit_vector, vector_parameters
from .setup_changes import SHAPED_SOLIDS, change_materials, needs

SAME_AXIS = 1e-6
"""Sine of the angle below which two axes count as one."""


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    axis = unit_vector(values, "axis")

    def fibred(material: DeformableMaterial) -> DeformableMaterial:
        if material.fibre_modulus > 0:
            x, y, z = material.fibre_axis
            a, b, c = axis
            if math.hypot(b * z - c * y, c * x - a * z, a * y - b * x) > SAME_AXIS:
                raise InputError(
                    f"axis is {axis!r}: the material has fibres along {material.fibre_axis!r} already; "
                    "give the same axis, or remove one of them"
                )
            return dataclasses.replace(material, fibre_modulus=material.fibre_modulus + values["fibre_modulus"])
        return dataclasses.replace(material, fibre_modulus=values["fibre_modulus"], fibre_axis=axis)

    return change_materials(setup, targets, SHAPED_SOLIDS, fibred)


EFFECT = Effect(
    name="anisotropy",
    kind="material",
    parameters=(
        Parameter(
            name="fibre_modulus",
            unit="Pa",
            low=0.0,
            high=1e12,
            default=1e5,
            description="k, extra modulus along the axis",
        ),
        *vector_parameters(
            "axis", "1", 1.0, (0.0, 0.0, 1.0), "along the fibres, world axes, of the body at the start; any length"
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"fibre_modulus": 0.0},
    obstacle=needs(SHAPED_SOLIDS, "which has no fibres"),
)
