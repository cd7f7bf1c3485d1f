# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties > Physics: role and material of the active object, for who looks there first."""

from __future__ import annotations

import bpy

from .. import text
from ..operators.bake_ops import PHYSGEN_OT_bake
from ..props.body_props import is_body
from .objects_panel import draw_preset
from .sidebar import draw_job, settings


class PHYSGEN_PT_physics(bpy.types.Panel):
    """The object's part in the simulation"""

    bl_idname = "PHYSGEN_PT_physics"
    bl_label = "PhysGen"
    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "physics"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown for objects of the simulation; others have the button PhysGen among those above."""
        return is_body(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw what most objects need, and where the rest is."""
        body = context.object.physgen
        column = settings(self.layout, context, why=True)
        column.prop(body, "role")
        if body.role == "dynamic":
            draw_preset(column, context, body.material)
            column.prop(body, "velocity")
            column.prop(body, "spin")
        if not draw_job(self.layout, context, PHYSGEN_OT_bake.job_title):
            self.layout.operator(PHYSGEN_OT_bake.bl_idname, icon="PHYSICS")
        text.sentences(self.layout, context, "More in the 3D viewport: press N, tab PhysGen.")
