# SPDX-License-Identifier: MIT
"""Permanent deformation above a yield stress.

Equation: sqrt(3/2) |dev tau| <= Y, by radial return; the moduli stay, and so do density, damping and fibres. Below Y
    the stress is Hencky's, 2 mu e + lambda tr e with e = ln of the stretch, at small strain that of any elastic law.
Source: von Mises, Nachr. Ges. Wiss. Göttingen (1913); Simo, Comput. Methods Appl. Mech. Eng. 99 (1992).
Bodies: solids that have a shape (elastic, plastic). Not snow, sand and fluids, which flow by themselves, not rigid
    bodies.
Twice: the value is set; the last one counts.
"""

from __future__ import annotations

import dataclasses

from ..constitutive import DeformableMaterial, VonMisesMaterial
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values
from .setup_changes import SHAPED_SOLIDS, change_materials, needs


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    def yielding(material: DeformableMaterial) -> DeformableMaterial:
        same = {spec.name: getattr(material, spec.name) for spec in dataclasses.fields(DeformableMaterial)}
        return VonMisesMaterial(**same, yield_stress=values["yield_stress"])

    return change_materials(setup, targets, SHAPED_SOLIDS, yielding)


EFFECT = Effect(
    name="plastic_yield",
    kind="material",
    parameters=(
        Parameter(
            name="yield_stress",
            unit="Pa",
            low=1.0,
            high=1e12,
            default=1e4,
            description="Y, stress at which a bar in tension begins to flow",
        ),
    ),
    description=__doc__,
    transform=_transform,
    obstacle=needs(SHAPED_SOLIDS, "which has no shape to lose by yielding"),
)
