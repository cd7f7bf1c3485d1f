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

from ..mpm.materials import ElasticMaterial, VonMisesMaterial
from ..mpm.setup import WorldSetup
from .changes import SHAPED, change_materials, needs
from .schema import Effect, Parameter, Targets, Values


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    def yielding(material: ElasticMaterial) -> ElasticMaterial:
        same = {spec.name: getattr(material, spec.name) for spec in dataclasses.fields(ElasticMaterial)}
        return VonMisesMaterial(**same, yield_stress=values["yield_stress"])

    return change_materials(setup, targets, SHAPED, yielding)


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
    obstacle=needs(SHAPED, "which has no shape to lose by yielding"),
)
