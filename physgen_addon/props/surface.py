# SPDX-License-Identifier: GPL-3.0-or-later
"""Friction and bounce, which objects and the ground have.

Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

import bpy
from bpy.props import FloatProperty


def _on_friction(self: "Surface", context: bpy.types.Context) -> None:
    # Only upwards and only from here, so that the two can be set in any order.
    if self.static_friction < self.friction:
        self.static_friction = self.friction


class Surface:
    """Mixin of property groups: fields of ``sim.scene.object.SceneObject`` and ``sim.scene.model.Ground``."""

    friction: FloatProperty(
        name="Friction",
        description="Coulomb's coefficient while sliding: ice 0.03, wood on wood 0.4, rubber 1",
        default=0.4,
        min=0.0,
        max=10.0,
        soft_max=1.5,
        update=_on_friction,
    )
    static_friction: FloatProperty(
        name="Static Friction",
        description="Coulomb's coefficient before it slides; never below the sliding one",
        default=0.4,
        min=0.0,
        max=10.0,
        soft_max=1.5,
    )
    restitution: FloatProperty(
        name="Bounce",
        description="Speed after over speed before an impact of rigid objects",
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
