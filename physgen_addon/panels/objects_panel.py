# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects panel: roles, materials, composition, initial motion and pins."""

from __future__ import annotations

from typing import Any

import bpy

from ...sim.constitutive import COHERENT, SHAPED, cohesion_of
from .. import bake_state, text
from ..operators.body_ops import (
    PHYSGEN_OT_add_bodies,
    PHYSGEN_OT_copy_material,
    PHYSGEN_OT_delete_preset,
    PHYSGEN_OT_remove_body,
    PHYSGEN_OT_reset_preset,
    PHYSGEN_OT_save_preset,
    PHYSGEN_OT_select_bodies,
)
from ..operators.compose_ops import Compose, PHYSGEN_OT_compose_objects, chosen_meshes
from ..playback import splat_clouds
from ..props import material_props
from ..props.body_props import bodies, is_body
from ..props.material_props import ADVANCED, LAW_FIELDS, WITH_UNITS, is_modified, shown_as
from .sidebar import (
    COMPOSE,
    OBJECTS,
    Sidebar,
    active_body,
    draw_job,
    draw_static_friction_note,
    optional,
    settings,
)

ROLE_ICONS = {"dynamic": "PHYSICS", "collider": "MOD_PHYSICS"}
LIST_SIDES = 150
"""px of the sidebar that a row of the list has for neither name nor material: icons, buttons, margins."""
SURFACE = ("friction", "static_friction", "restitution", "contact_mode")


class PHYSGEN_UL_bodies(bpy.types.UIList):
    """List of the simulated objects of the scene."""

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
        """Draw role, name, material and visibility."""
        body = item.physgen
        row = layout.row(align=True)
        # What cannot be baked as it is; below the list stands why, of the active one.
        is_unfit = item.name in bake_state.state(context.scene).unfit
        row.prop(item, "name", text="", emboss=False, icon="ERROR" if is_unfit else ROLE_ICONS[body.role])
        row = row.row()
        row.alignment = "RIGHT"
        chosen = body.material.preset_name
        words = "Collider" if body.role == "collider" else material_props.preset_title(chosen)
        if body.role == "dynamic" and chosen == material_props.CUSTOM:
            words = material_props.own_title(body.material.likeness)
        # A narrow list has no room for the bracket, nor for the material of what has a long name.
        words = words.partition(" (")[0] + ("*" if body.role == "dynamic" and is_modified(body.material) else "")
        if len(item.name) + len(words) <= text.room(context, LIST_SIDES):
            row.label(text=words)
        row.prop(item, "hide_viewport", text="", emboss=False)

    def filter_items(self, context: bpy.types.Context, data: Any, prop: str) -> tuple[list[int], list[int]]:
        """Return bodies whose name matches the filter, by name."""
        items = getattr(data, prop)
        names = bpy.types.UI_UL_list
        if self.filter_name:
            flags = names.filter_items_by_name(self.filter_name, self.bitflag_filter_item, items, "name")
        else:
            flags = [self.bitflag_filter_item] * len(items)
        flags = [flag if is_body(item) else 0 for flag, item in zip(flags, items, strict=True)]
        return flags, names.sort_items_by_name(items, "name")


class PHYSGEN_PT_objects(Sidebar, bpy.types.Panel):
    """Objects of the simulation"""

    bl_idname = "PHYSGEN_PT_objects"
    bl_label = "Objects"
    bl_order = OBJECTS

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown if there are any; before that the Scene panel offers starting points."""
        return bool(bodies(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the list and the role of the active object."""
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
        why = bake_state.state(scene).unfit.get(item.name)
        if why:
            text.sentences(layout, context, text.brief(why), icon="ERROR")
        if item.override_library is not None:
            words = "An override keeps the settings of its own file. To change them: Object > Relations > Make Local."
            text.sentences(layout, context, words, icon="INFO")
        column = settings(layout, context, why=True)
        column.row().prop(item.physgen, "role", expand=True)
        if splat_clouds.find(item) is not None:
            column.row().prop(item.physgen, "splats_as", expand=True)
        if item.physgen.role == "dynamic":
            draw_preset(column, context, item.physgen.material)
        if item.physgen.role == "collider":
            text.sentences(layout, context, "Other objects collide with it. It is static, or follows its keyframes.")


class DynamicPart(Sidebar):
    """Below the panel of objects, for one that is dynamic."""

    bl_parent_id = "PHYSGEN_PT_objects"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown if the active object is dynamic."""
        item = active_body(context)
        return item is not None and item.physgen.role == "dynamic"


class PHYSGEN_PT_material(DynamicPart, bpy.types.Panel):
    """Material of the object"""

    bl_label = "Material"
    bl_order = 0
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw behaviour, and the values it uses."""
        material = active_body(context).physgen.material
        column = settings(self.layout, context)
        column.prop(material, "law")
        for name in ("density", *LAW_FIELDS[material.law]):
            if name not in ADVANCED:
                _draw_number(column, material, name)
        body = context.active_object.physgen
        for kind in ("stiffness", "density") if material.law != "rigid" else ("density",):
            group = f"{kind}_group"
            column.prop_search(body, group, context.active_object, "vertex_groups")
            if getattr(body, group):
                column.prop(body, f"{kind}_factor")
        if any(is_body(o) and o != context.active_object for o in context.selected_objects):
            column.operator(PHYSGEN_OT_copy_material.bl_idname, icon="COPYDOWN")


def draw_preset(layout: bpy.types.UILayout, context: bpy.types.Context, material: Any) -> None:
    """Draw the menu of materials with its buttons, and what is unusual about the chosen one."""
    own = material_props.own_presets()
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
    if not modified and name != material_props.CUSTOM and material_props.find_preset(name) is None:
        words = f"There is no preset {name} on this computer. The object keeps its values."
        text.sentences(layout, context, words, icon="INFO")
    for broken in own.broken:
        row = layout.row(align=True)
        row.alert = True
        row.label(text=f"Unreadable preset: {broken}", icon="ERROR")
        row.operator(PHYSGEN_OT_delete_preset.bl_idname, text="", icon="TRASH").name = broken


def _draw_number(layout: bpy.types.UILayout, material: Any, name: str) -> None:
    """Draw a number of the material, with its unit."""
    layout.prop(material, shown_as(name) if name in WITH_UNITS else name)


class PHYSGEN_PT_advanced(DynamicPart, bpy.types.Panel):
    """Settings that few materials need: fibres, stiffness that gives way, and numbers to be animated"""

    bl_parent_id = "PHYSGEN_PT_material"
    bl_label = "Advanced"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw a switch each, and its numbers where it is on."""
        material = active_body(context).physgen.material
        column = settings(self.layout, context)
        known = LAW_FIELDS[material.law]
        if "relaxing_share" in known:
            optional(column, material, "relaxes", "relaxing_share", "Gives Way")
            if material.relaxes:
                column.prop(material, "relaxation_time")
        if "fibre_modulus" in known:
            optional(column, material, "has_fibres", shown_as("fibre_modulus"), "Fibres")
            if material.has_fibres:
                column.prop(material, "fibre_axis")
        animated = [name for name in known if name in WITH_UNITS and name != "fibre_modulus"]
        if animated:
            # Keyframes and drivers are those of numbers, and words that show one have none.
            text.sentences(column, context, "To animate, in Pa and Pa s:")
            numbers = column.column(align=True)
            numbers.use_property_decorate = True
            for name in animated:
                numbers.prop(material, name)


class PHYSGEN_PT_inside(DynamicPart, bpy.types.Panel):
    """Solid or hollow; turning to sand"""

    bl_label = "Filling"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw fill, wall and sand."""
        body = active_body(context).physgen
        column = settings(self.layout, context)
        column.prop(body, "fill")
        if not body.fill:
            optional(column, body, "own_wall", "shell_thickness", "Wall", otherwise="Automatic")
        law = body.material.law
        # Only deformable objects can turn to sand.
        if cohesion_of(law) in (SHAPED, COHERENT):
            column.prop(body, "sandy")
            if body.sandy:
                column.prop(body, "sandy_frame")


class PHYSGEN_PT_surface(Sidebar, bpy.types.Panel):
    """Friction and bounce"""

    bl_parent_id = "PHYSGEN_PT_objects"
    bl_label = "Friction and Bounce"
    bl_order = 2
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown for all bodies; colliders have a surface too."""
        return active_body(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw its own values, or the ground's."""
        body = active_body(context).physgen
        column = settings(self.layout, context)
        choice = column.row()
        choice.use_property_split = False
        choice.prop(body, "surface", expand=True)
        if not body.own_surface:
            return
        for name in SURFACE:
            column.prop(body, name)
        draw_static_friction_note(column, context, body)


class PHYSGEN_PT_compose(Sidebar, bpy.types.Panel):
    """Resolve intersections of objects"""

    bl_idname = "PHYSGEN_PT_compose"
    bl_label = "Compose Objects"
    bl_order = COMPOSE
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the fixed and the yielding objects, method, button and last result."""
        layout, state = self.layout, context.scene.physgen_compose
        items = chosen_meshes(context)
        if len(items) < 2:
            text.sentences(layout, context, "Select two or more meshes that intersect.", icon="INFO")
        else:
            text.sentences(layout, context, f"Stays: {items[0].name}", icon="PINNED")
            text.sentences(layout, context, f"Yields: {', '.join(item.name for item in items[1:])}", icon="MOD_CLOTH")
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        if context.scene.physgen.folder:
            column.prop(state, "method")
        else:
            text.sentences(column, context, "Without a photo, by physics alone.")
        column.prop(state, "steps")
        column.prop(state, "keep_strain")
        column.prop(state, "keep_original")
        if not draw_job(layout, context, Compose.job_title):
            row = layout.row()
            row.scale_y = 1.4
            row.operator(PHYSGEN_OT_compose_objects.bl_idname, icon="CON_SHRINKWRAP")
        if state.pairs:
            _draw_result(layout, state)


def _draw_result(layout: bpy.types.UILayout, state: bpy.types.PropertyGroup) -> None:
    box = layout.box()
    box.label(text="Penetration, before → after")
    for pair in state.pairs:
        column = box.column(align=True)
        column.scale_y = 0.8
        column.label(text=pair.name)
        column.label(
            text=f"{text.volume(pair.volume_before)} ({text.percent(pair.share_before)}) → "
            f"{text.volume(pair.volume_after)} ({text.percent(pair.share_after)})",
            icon="BLANK1",
        )
        deepest = f"{text.length(pair.deepest_before)} → {text.length(pair.deepest_after)}"
        column.label(text=f"deepest {deepest}", icon="BLANK1")
