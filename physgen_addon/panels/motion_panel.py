# SPDX-License-Identifier: GPL-3.0-or-later
"""Panels: how an object begins to move, and what holds it."""

from __future__ import annotations

import math
from typing import Any

import bpy
from mathutils import Vector

from .. import text
from ..operators.body_ops import (
    PHYSGEN_OT_add_pin,
    PHYSGEN_OT_add_push,
    PHYSGEN_OT_clear_motion,
    PHYSGEN_OT_remove_pin,
    PHYSGEN_OT_remove_push,
)
from ..props.body_props import bodies
from ..scene_io.export_animation import metres_per_unit
from .objects_panel import DynamicPart
from .sidebar import (
    MOTION,
    Sidebar,
    active_body,
    draw_arrows,
    edited_list,
    is_in,
    optional,
    settings,
)


class PHYSGEN_UL_pins(bpy.types.UIList):
    """List of pins."""

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
        """Draw the box and its problem, if any."""
        box = item.box
        row = layout.row(align=True)
        row.alert = box is None or not is_in(box, context.scene)
        row.prop(item, "box", text="", icon="CUBE")
        if row.alert:
            row.label(text="", icon="ERROR")


class PHYSGEN_UL_pushes(bpy.types.UIList):
    """List of later pushes."""

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
        """Draw the frame and the speed."""
        row = layout.row(align=True)
        row.prop(item, "frame", text="Frame", emboss=False)
        speed = text.number(Vector(item.velocity).length * metres_per_unit(context.scene), "m/s")
        row.label(text=speed)


class PHYSGEN_PT_motion(Sidebar, bpy.types.Panel):
    """Initial motion of the active object"""

    bl_idname = "PHYSGEN_PT_motion"
    bl_label = "Motion"
    bl_order = MOTION

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown if an object may be dynamic."""
        return bool(bodies(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        """Draw velocity and spin."""
        layout, item = self.layout, active_body(context)
        if item is None:
            text.sentences(layout, context, "Select an object of the simulation to set its initial motion.")
            return
        if item.physgen.role == "collider":
            text.sentences(layout, context, "A collider follows its keyframes. Animate it as any object.")
            return
        body = item.physgen
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
        row = layout.row(align=True)
        draw_arrows(row, context)
        cleared = row.row(align=True)
        cleared.enabled = column.enabled
        cleared.operator(PHYSGEN_OT_clear_motion.bl_idname, text="", icon="LOOP_BACK")


class PHYSGEN_PT_start(DynamicPart, bpy.types.Panel):
    """When the active object begins to move"""

    bl_parent_id = "PHYSGEN_PT_motion"
    bl_label = "Start"
    bl_order = 0
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the frame and sleep."""
        body = active_body(context).physgen
        column = settings(self.layout, context)
        optional(column, body, "waits", "start_frame", "At Frame")
        column.prop(body, "asleep")
        if body.asleep:
            column.prop(body, "held")


class PHYSGEN_PT_pushes(DynamicPart, bpy.types.Panel):
    """When the active object is pushed again"""

    bl_parent_id = "PHYSGEN_PT_motion"
    bl_label = "Later Pushes"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        """Draw their frames behind the title, to be seen while this is closed, too."""
        frames = sorted(push.frame for push in active_body(context).physgen.pushes)
        if frames:
            self.layout.label(text=f"at {', '.join(map(str, frames))}")

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the list and the active push."""
        layout, body = self.layout, active_body(context).physgen
        locked = settings(layout, context)
        if not body.pushes:
            text.sentences(locked, context, "A push gives it a velocity at a later frame: it hops again.")
            locked.operator(PHYSGEN_OT_add_push.bl_idname, icon="ADD")
            return
        add, remove = PHYSGEN_OT_add_push.bl_idname, PHYSGEN_OT_remove_push.bl_idname
        edited_list(locked, "PHYSGEN_UL_pushes", body, "pushes", "push_index", add, remove)
        if body.push_index < len(body.pushes):
            push = body.pushes[body.push_index]
            locked.prop(push, "frame")
            locked.prop(push, "velocity")


class PHYSGEN_PT_pins(DynamicPart, bpy.types.Panel):
    """Pins of the active object"""

    bl_parent_id = "PHYSGEN_PT_motion"
    bl_label = "Hold"
    bl_order = 2
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw pins and shape stiffness."""
        layout, body = self.layout, active_body(context).physgen
        locked = settings(layout, context)
        if body.pins:
            add, remove = PHYSGEN_OT_add_pin.bl_idname, PHYSGEN_OT_remove_pin.bl_idname
            edited_list(locked, "PHYSGEN_UL_pins", body, "pins", "pin_index", add, remove)
            if any(pin.box is None or not is_in(pin.box, context.scene) for pin in body.pins):
                text.sentences(
                    locked, context, "A pin has lost its box: choose another empty or remove it.", icon="ERROR"
                )
            text.sentences(locked, context, "Move, scale or animate the box in the viewport.")
        else:
            text.sentences(locked, context, "A pin is a box: the part of the object inside it is held.")
            locked.operator(PHYSGEN_OT_add_pin.bl_idname, icon="PINNED")
        column = locked.column()
        optional(column, body, "holds_shape", "goal_stiffness", "Hold Shape")
        if body.holds_shape:
            column.prop(body, "goal_damping")
