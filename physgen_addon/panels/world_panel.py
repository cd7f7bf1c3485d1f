# SPDX-License-Identifier: GPL-3.0-or-later
"""World panel: gravity, ground, colliders and effects."""

from __future__ import annotations

import itertools
from typing import Any

import bpy

from ...sim.effects.registry import KINDS, Parameter, effects
from .. import text
from ..operators.body_ops import PHYSGEN_OT_add_colliders, PHYSGEN_OT_remove_body
from ..operators.world_ops import (
    PHYSGEN_OT_add_effect_targets,
    PHYSGEN_OT_add_stack_effect,
    PHYSGEN_OT_explain_effect,
    PHYSGEN_OT_ground_below,
    PHYSGEN_OT_move_stack_effect,
    PHYSGEN_OT_remove_effect_target,
    PHYSGEN_OT_remove_stack_effect,
    chosen_effect,
)
from ..props.body_props import bodies, is_body
from ..props.scene_props import EFFECT_ITEMS, known_effect
from .sidebar import WORLD, Sidebar, draw_static_friction_note, is_in, settings

KIND_ICONS = {"force": "FORCE_WIND", "contact": "MOD_PHYSICS", "material": "MATERIAL", "mass": "PIVOT_CURSOR"}


class PHYSGEN_PT_world(Sidebar, bpy.types.Panel):
    """Forces on all objects"""

    bl_idname = "PHYSGEN_PT_world"
    bl_label = "World"
    bl_order = WORLD
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw gravity, which is Blender's own."""
        scene = context.scene
        column = settings(self.layout, context)
        column.prop(scene, "use_gravity", text="Use Gravity")
        vector = column.column()
        vector.active = scene.use_gravity
        vector.prop(scene, "gravity", text="Gravity")


class _Part(Sidebar):
    bl_parent_id = "PHYSGEN_PT_world"


class PHYSGEN_PT_ground(_Part, bpy.types.Panel):
    """An infinite ground plane"""

    bl_label = "Ground"
    bl_order = 0

    def draw_header(self, context: bpy.types.Context) -> None:
        """Draw the toggle."""
        row = settings(self.layout, context)
        row.use_property_split = False
        row.prop(context.scene.physgen.world, "use_ground", text="")

    def draw(self, context: bpy.types.Context) -> None:
        """Draw its place and surface."""
        world = context.scene.physgen.world
        column = settings(self.layout, context)
        column.active = world.use_ground
        column.prop(world, "ground_object", text="Plane")
        if world.ground_object is None:
            column.prop(world, "ground_point")
            column.prop(world, "ground_normal")
            column.operator(PHYSGEN_OT_ground_below.bl_idname, icon="TRIA_DOWN_BAR")
        elif not is_in(world.ground_object, context.scene):
            text.sentences(column, context, "The plane was deleted: choose another, or clear the field.", icon="ERROR")
        column.prop(world, "friction")
        column.prop(world, "static_friction")
        draw_static_friction_note(column, context, world)
        column.prop(world, "restitution")


class PHYSGEN_PT_colliders(_Part, bpy.types.Panel):
    """Objects that others collide with and that are not affected"""

    bl_label = "Colliders"
    bl_order = 1

    def draw(self, context: bpy.types.Context) -> None:
        """Draw each with a button to remove it; add selected objects."""
        column = settings(self.layout, context)
        found = [item for item in bodies(context.scene) if item.physgen.role == "collider"]
        if not found:
            text.sentences(column, context, "Walls, tables, hands: objects that others collide with.")
        names = column.column(align=True)
        for item in found:
            row = names.row(align=True)
            row.label(text=item.name, icon="MOD_PHYSICS")
            row.operator(PHYSGEN_OT_remove_body.bl_idname, text="", icon="X", emboss=False).name = item.name
        column.operator(PHYSGEN_OT_add_colliders.bl_idname, icon="ADD")


class PHYSGEN_UL_effect_stack(bpy.types.UIList):
    """List of effects in the order in which they act."""

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
        """Draw name, number of targets, toggle."""
        row = layout.row()
        row.active = item.enabled
        kind = known_effect(item)
        if kind is None:
            row.label(text="Unknown effect", icon="ERROR")
        else:
            row.label(text=text.readable(item.effect), icon=KIND_ICONS[kind.kind])
        if item.targets:
            row.label(text=f"{len(item.targets)} obj.")
        row.prop(item, "enabled", text="")


class PHYSGEN_MT_add_effect(bpy.types.Menu):
    """All effects, by type"""

    bl_label = "Add Effect"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw one heading a type."""
        names = {name for name, *_ in EFFECT_ITEMS}
        for kind in KINDS:
            of_kind = [name for name, item in effects().items() if item.kind == kind and name in names]
            if not of_kind:
                continue
            if kind != KINDS[0]:
                self.layout.separator()
            self.layout.label(text=kind.capitalize(), icon=KIND_ICONS[kind])
            for name in of_kind:
                self.layout.operator(PHYSGEN_OT_add_stack_effect.bl_idname, text=text.readable(name)).effect = name


class PHYSGEN_PT_effects(_Part, bpy.types.Panel):
    """Effects besides gravity and contact"""

    bl_label = "Effects"
    bl_order = 2

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the stack; parameters and targets of the active effect."""
        column, world = settings(self.layout, context), context.scene.physgen.world
        if not world.effects:
            text.sentences(column, context, "Forces besides gravity and contact: wind, a tether, adhesion.")
            column.menu("PHYSGEN_MT_add_effect", icon="ADD")
            return
        row = column.row()
        row.template_list("PHYSGEN_UL_effect_stack", "", world, "effects", world, "effect_index", rows=4)
        side = row.column(align=True)
        side.menu("PHYSGEN_MT_add_effect", text="", icon="ADD")
        side.operator(PHYSGEN_OT_remove_stack_effect.bl_idname, text="", icon="REMOVE")
        side.separator()
        side.operator(PHYSGEN_OT_move_stack_effect.bl_idname, text="", icon="TRIA_UP").direction = "UP"
        side.operator(PHYSGEN_OT_move_stack_effect.bl_idname, text="", icon="TRIA_DOWN").direction = "DOWN"
        entry = chosen_effect(context.scene)
        if entry is not None:
            _draw_entry(column, context, entry)


def _draw_entry(layout: bpy.types.UILayout, context: bpy.types.Context, entry: Any) -> None:
    item = known_effect(entry)
    if item is None:
        words = "Unknown effect, stored by another version of PhysGen: remove it."
        text.sentences(layout, context, words, icon="ERROR")
        return
    box = layout.box().column()
    box.active = entry.enabled
    row = box.row()
    row.label(text=text.readable(item.name))
    row.operator(PHYSGEN_OT_explain_effect.bl_idname, text="", icon="QUESTION", emboss=False).effect = item.name
    text.sentences(box, context, item.summary)
    known = {parameter.name: parameter for parameter in item.parameters}
    lines = [(known[number.name], number) for number in entry.parameters if number.name in known]
    # The three components of a vector are aligned, as in Blender.
    for _, group in itertools.groupby(lines, key=lambda line: _stem(line[0].name)):
        column = box.column(align=True)
        for index, (parameter, number) in enumerate(group):
            _draw_parameter(column, item.name, parameter, number, first=index == 0)
    if item.name == "sandy":
        start = next((number.value for parameter, number in lines if parameter.name == "start"), 0.0)
        simulation, render = context.scene.physgen.simulation, context.scene.render
        frame = simulation.frame_start + start * simulation.slow * render.fps / render.fps_base
        text.sentences(box, context, f"That is frame {frame:.0f}.")
    _draw_targets(box, context, entry, of_world=item.of_world)


def _stem(name: str) -> str:
    stem, _, axis = name.rpartition("_")
    return stem if axis in ("x", "y", "z") else name


def _draw_parameter(layout: bpy.types.UILayout, name: str, parameter: Parameter, number: Any, *, first: bool) -> None:
    stem = _stem(parameter.name)
    title = text.readable(stem).replace(" per mass", " / mass")
    if stem != parameter.name:
        title = f"{title} {parameter.name[-1].upper()}" if first else parameter.name[-1].upper()
    row = layout.row(align=True)
    if parameter.whole and (parameter.low, parameter.high) == (0.0, 1.0):
        row.prop(number, "switch", text=title)
    elif parameter.unit == "rad":
        row.prop(number, "angle", text=title)
    else:
        row.prop(number, "value", text=title)
    words = row.row()
    words.ui_units_x = 2.4
    words.active = False
    words.label(text="" if parameter.unit in ("1", "rad") else parameter.unit)
    info = row.operator(PHYSGEN_OT_explain_effect.bl_idname, text="", icon="INFO", emboss=False)
    info.effect, info.parameter = name, parameter.name


def _draw_targets(layout: bpy.types.UILayout, context: bpy.types.Context, entry: Any, *, of_world: bool) -> None:
    if of_world:
        text.sentences(layout, context, "Acts on the whole world.")
        return
    if not entry.targets:
        text.sentences(layout, context, "Acts on all applicable objects.")
    names = layout.column(align=True)
    for index, target in enumerate(entry.targets):
        item = target.item
        good = is_body(item) and item.physgen.role == "dynamic" and is_in(item, context.scene)
        row = names.row(align=True)
        row.alert = not good
        row.label(text=item.name if item is not None else "Deleted", icon="OBJECT_DATA" if good else "ERROR")
        row.operator(PHYSGEN_OT_remove_effect_target.bl_idname, text="", icon="X", emboss=False).index = index
        if not good:
            text.sentences(
                names, context, "It does not move in the simulation: remove it here, or give it the role Moves."
            )
    layout.operator(PHYSGEN_OT_add_effect_targets.bl_idname, icon="RESTRICT_SELECT_OFF")
