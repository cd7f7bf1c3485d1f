# SPDX-License-Identifier: GPL-3.0-or-later
"""Motion: how the object begins, and what holds it."""

from __future__ import annotations

import math
from typing import Any

import bpy
from mathutils import Vector

from .. import text
from ..operators.body import PHYSGEN_OT_add_pin, PHYSGEN_OT_clear_motion, PHYSGEN_OT_remove_pin
from ..props.body import bodies
from .preview import draw_arrows
from .sidebar import MOTION, Sidebar, active_body, is_in, settings


class PHYSGEN_UL_pins(bpy.types.UIList):
    """The boxes that hold the object."""

    def draw_item(
        self,
        context: bpy.types.Context,
        layout: bpy.types.UILayout,
        data: Any,
        item: Any,
        icon: int,
        active_data: Any,
        active_property: str,
    ) -> None:
        """The box, which can be another empty; what is wrong with it."""
        box = item.box
        row = layout.row(align=True)
        row.alert = box is None or not is_in(box, context.scene)
        row.prop(item, "box", text="", icon="CUBE")
        if row.alert:
            row.label(text="", icon="ERROR")


class PHYSGEN_PT_motion(Sidebar, bpy.types.Panel):
    """How the chosen object begins"""

    bl_idname = "PHYSGEN_PT_motion"
    bl_label = "Motion"
    bl_order = MOTION

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is something that could move."""
        return bool(bodies(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        """Velocity, spin, start."""
        layout, item = self.layout, active_body(context)
        if item is None:
            text.sentences(layout, context, "Choose an object of the simulation to say how it begins.")
            return
        if item.physgen.role == "collider":
            text.sentences(layout, context, "A collider goes where its keyframes lead. Animate it as any object.")
            return
        body = item.physgen
        text.sentences(layout, context, f"{item.name} at the start:")
        column = settings(layout, context)
        column.prop(body, "velocity")
        column.prop(body, "speed")
        column.prop(body, "spin")
        turns = Vector(body.spin).length / (2 * math.pi)
        if turns > 0:
            split = column.split(factor=0.4)
            split.label(text="")
            split.active = False
            split.label(text=f"{turns:.2g} turns/s")
        column.prop(body, "start_frame")
        row = layout.row(align=True)
        draw_arrows(row, context)
        cleared = row.row(align=True)
        cleared.enabled = column.enabled
        cleared.operator(PHYSGEN_OT_clear_motion.bl_idname, text="", icon="LOOP_BACK")


class PHYSGEN_PT_pins(Sidebar, bpy.types.Panel):
    """What holds the chosen object"""

    bl_parent_id = "PHYSGEN_PT_motion"
    bl_label = "Hold"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The active object moves."""
        item = active_body(context)
        return item is not None and item.physgen.role == "dynamic"

    def draw(self, context: bpy.types.Context) -> None:
        """Pins; the pull back to its shape."""
        layout, body = self.layout, active_body(context).physgen
        locked = settings(layout, context)
        if body.pins:
            row = locked.row()
            row.template_list("PHYSGEN_UL_pins", "", body, "pins", body, "pin_index", rows=2)
            side = row.column(align=True)
            side.operator(PHYSGEN_OT_add_pin.bl_idname, text="", icon="ADD")
            side.operator(PHYSGEN_OT_remove_pin.bl_idname, text="", icon="REMOVE")
            if any(pin.box is None or not is_in(pin.box, context.scene) for pin in body.pins):
                text.sentences(
                    locked, context, "A pin has lost its box: choose another empty or remove it.", icon="ERROR"
                )
            text.sentences(locked, context, "Move, scale or animate the box in the viewport.")
        else:
            text.sentences(locked, context, "A pin is a box: what of the object is inside it stays in place.")
            locked.operator(PHYSGEN_OT_add_pin.bl_idname, icon="PINNED")
        column = locked.column()
        column.prop(body, "goal_stiffness")
        damping = column.column()
        damping.active = body.goal_stiffness > 0
        damping.prop(body, "goal_damping")


CLASSES = (PHYSGEN_UL_pins, PHYSGEN_PT_motion, PHYSGEN_PT_pins)
