# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects: what takes part, in which role, and what it is made of."""

from __future__ import annotations

from typing import Any

import bpy

from .. import text
from ..bridge import splats
from ..operators.body import PHYSGEN_OT_add_bodies, PHYSGEN_OT_remove_body, PHYSGEN_OT_select_bodies
from ..operators.material import (
    PHYSGEN_OT_copy_material,
    PHYSGEN_OT_delete_preset,
    PHYSGEN_OT_reset_preset,
    PHYSGEN_OT_save_preset,
)
from ..props import presets
from ..props.body import bodies, is_body
from ..props.material import LAW_FIELDS, is_modified
from .sidebar import OBJECTS, Sidebar, active_body, draw_static_friction_note, settings

ROLE_ICONS = {"dynamic": "PHYSICS", "collider": "MOD_PHYSICS"}
UNITS = {
    "youngs_modulus": text.pressure,
    "yield_stress": text.pressure,
    "bulk_modulus": text.pressure,
    "fibre_modulus": text.pressure,
}
"""How a number that spans many powers of ten is said beside its field."""
SURFACE = ("friction", "static_friction", "restitution", "contact_mode")


class PHYSGEN_UL_bodies(bpy.types.UIList):
    """The objects of the simulation, of all that are in the scene."""

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
        """Role, name, material, whether it is shown."""
        body = item.physgen
        row = layout.row(align=True)
        row.prop(item, "name", text="", emboss=False, icon=ROLE_ICONS[body.role])
        row = row.row()
        row.alignment = "RIGHT"
        words = "Collider" if body.role == "collider" else presets.title(body.material.preset_name)
        row.label(text=words + ("*" if body.role == "dynamic" and is_modified(body.material) else ""))
        row.prop(item, "hide_viewport", text="", emboss=False)

    def filter_items(self, context: bpy.types.Context, data: Any, prop: str) -> tuple[list[int], list[int]]:
        """Bodies whose name fits the filter, by name."""
        items = getattr(data, prop)
        names = bpy.types.UI_UL_list
        if self.filter_name:
            flags = names.filter_items_by_name(self.filter_name, self.bitflag_filter_item, items, "name")
        else:
            flags = [self.bitflag_filter_item] * len(items)
        flags = [flag if is_body(item) else 0 for flag, item in zip(flags, items, strict=True)]
        return flags, names.sort_items_by_name(items, "name")


class PHYSGEN_PT_objects(Sidebar, bpy.types.Panel):
    """What takes part in the simulation"""

    bl_idname = "PHYSGEN_PT_objects"
    bl_label = "Objects"
    bl_order = OBJECTS

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There are some; until then the Scene panel says how to begin."""
        return bool(bodies(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        """The list; the role of the active object."""
        layout, scene = self.layout, context.scene
        editing = context.mode != "OBJECT"
        row = layout.row()
        names = row.column()
        names.enabled = not editing
        names.template_list("PHYSGEN_UL_bodies", "", scene, "objects", scene.physgen, "body_index", rows=3)
        side = settings(row, context)
        side.use_property_split = False
        side = side.column(align=True)
        side.operator(PHYSGEN_OT_add_bodies.bl_idname, text="", icon="ADD")
        side.operator(PHYSGEN_OT_remove_body.bl_idname, text="", icon="REMOVE")
        side.separator()
        side.operator(PHYSGEN_OT_select_bodies.bl_idname, text="", icon="RESTRICT_SELECT_OFF")
        if editing:
            text.sentences(layout, context, "Leave Edit Mode to choose another object.", icon="INFO")
        item = active_body(context)
        if item is None:
            active = context.active_object
            words = f"{active.name} is not in the simulation." if active is not None else "No object is active."
            text.sentences(layout, context, f"{words} Choose one in the list.", icon="INFO")
            return
        column = settings(layout, context, why=True)
        column.row().prop(item.physgen, "role", expand=True)
        if splats.find(item) is not None:
            column.row().prop(item.physgen, "splats_as", expand=True)
        if item.physgen.role == "dynamic":
            _draw_preset(column, context, item.physgen.material)
        if item.physgen.role == "collider":
            text.sentences(layout, context, "Others hit it. It stays where it is, or goes where its keyframes lead.")


class _Part(Sidebar):
    bl_parent_id = "PHYSGEN_PT_objects"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The active object moves."""
        item = active_body(context)
        return item is not None and item.physgen.role == "dynamic"


class PHYSGEN_PT_material(_Part, bpy.types.Panel):
    """The numbers of what the object is made of"""

    bl_label = "Material"
    bl_order = 0
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Behaviour, and the numbers that count for it."""
        material = active_body(context).physgen.material
        column = settings(self.layout, context)
        column.prop(material, "law")
        _number(column, material, "density", "kg/m³")
        for name in LAW_FIELDS[material.law]:
            if name == "fibre_axis":
                if material.fibre_modulus > 0:
                    column.prop(material, name)
                continue
            _number(column, material, name, UNITS[name](getattr(material, name)) if name in UNITS else "")
        if any(is_body(o) and o != context.active_object for o in context.selected_objects):
            column.operator(PHYSGEN_OT_copy_material.bl_idname, icon="COPYDOWN")


def _draw_preset(layout: bpy.types.UILayout, context: bpy.types.Context, material: Any) -> None:
    own = presets.own_presets()
    name = material.preset_name
    row = layout.row(align=True)
    row.use_property_split = False
    row.prop(material, "preset", text="")
    modified = is_modified(material)
    if modified:
        row.operator(PHYSGEN_OT_reset_preset.bl_idname, text="", icon="LOOP_BACK")
    row.operator(PHYSGEN_OT_save_preset.bl_idname, text="", icon="FILE_TICK")
    if name in own.good:
        row.operator(PHYSGEN_OT_delete_preset.bl_idname, text="", icon="TRASH").name = name
    if modified:
        text.sentences(layout, context, f"{presets.title(name)}, with numbers changed by hand.", icon="GREASEPENCIL")
    elif name != presets.CUSTOM and presets.find(name) is None:
        words = f"There is no preset {name} on this computer. The object keeps its numbers."
        text.sentences(layout, context, words, icon="INFO")
    for broken in own.broken:
        row = layout.row(align=True)
        row.alert = True
        row.label(text=f"Unreadable preset: {broken}", icon="ERROR")
        row.operator(PHYSGEN_OT_delete_preset.bl_idname, text="", icon="TRASH").name = broken


def _number(layout: bpy.types.UILayout, data: Any, name: str, words: str) -> None:
    """A field with its unit or its value in words beside it; all fields end at the same place."""
    split = layout.split(factor=0.4, align=True)
    split.use_property_split = False
    title = split.row()
    title.alignment = "RIGHT"
    title.label(text=data.bl_rna.properties[name].name)
    field = split.split(factor=0.58, align=True)
    field.prop(data, name, text="")
    unit = field.row()
    unit.active = False
    unit.label(text=words)


class PHYSGEN_PT_inside(_Part, bpy.types.Panel):
    """Solid or hollow; collapsing into sand"""

    bl_label = "Filling"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Solid, wall, sand."""
        body = active_body(context).physgen
        column = settings(self.layout, context)
        column.prop(body, "fill")
        if not body.fill:
            column.prop(body, "shell_thickness")
            if body.shell_thickness == 0:
                text.sentences(column, context, "0: the thinnest wall that the quality resolves.")
        law = body.material.law
        # Only what deforms can fall apart.
        if law not in ("rigid", "sand", "fluid"):
            column.prop(body, "sandy")
            if body.sandy:
                column.prop(body, "sandy_frame")


class PHYSGEN_PT_surface(Sidebar, bpy.types.Panel):
    """Friction and bounce"""

    bl_parent_id = "PHYSGEN_PT_objects"
    bl_label = "Surface"
    bl_order = 2
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The active object takes part; colliders have a surface too."""
        return active_body(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Its own numbers, or the ground's."""
        body = active_body(context).physgen
        column = settings(self.layout, context)
        column.prop(body, "own_surface")
        if not body.own_surface:
            text.sentences(column, context, "Rubs and bounces as the ground does (see World).")
            return
        for name in SURFACE:
            column.prop(body, name)
        draw_static_friction_note(column, context, body)


CLASSES = (PHYSGEN_UL_bodies, PHYSGEN_PT_objects, PHYSGEN_PT_material, PHYSGEN_PT_inside, PHYSGEN_PT_surface)
