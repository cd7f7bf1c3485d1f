# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels of the tab "PhysGen" share: their place and order, what is locked while a bake runs."""

from __future__ import annotations

from typing import Any

import bpy

from .. import bake_state, text
from ..interpreter import TERMINAL
from ..props.body import is_body
from ..props.preferences import PHYSGEN_AP_preferences
from ..views import TAB

SCENE, OBJECTS, TOGETHER, MOTION, WORLD, SIMULATE, RENDER, DIAGNOSE = range(8)
"""``bl_order``: the order of work."""

COMMAND = f" In {TERMINAL}:"
"""What precedes the command that installs what a Python lacks (``interpreter``)."""


class Sidebar:
    """Mixin: a panel of the 3D viewport's sidebar."""

    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", TAB


def is_baking(scene: bpy.types.Scene) -> bool:
    """Whether what a bake depends on must not change now."""
    return bake_state.state(scene).status == "baking"


def settings(layout: bpy.types.UILayout, context: bpy.types.Context, *, why: bool = False) -> bpy.types.UILayout:
    """A column for settings that a bake depends on: names left, values right; locked while one runs.

    why: say so above it; once a panel is enough.
    """
    locked = is_baking(context.scene)
    if locked and why:
        text.sentences(layout, context, "Locked while baking. Pause or cancel to change it.", icon="LOCKED")
    column = layout.column()
    column.use_property_split, column.use_property_decorate = True, False
    column.enabled = not locked
    return column


def draw_static_friction_note(layout: bpy.types.UILayout, context: bpy.types.Context, surface: Any) -> None:
    """Where ``surface`` (a body or the world) has less static than sliding friction: what counts then."""
    if surface.static_friction < surface.friction:
        words = f"Static friction counts as {surface.friction:.3g}: it is never below the sliding one."
        text.sentences(layout, context, words, icon="INFO")


def draw_trouble(layout: bpy.types.UILayout, context: bpy.types.Context, message: str, *, icon: str = "NONE") -> None:
    """What went wrong; where the Python is to blame, the way to the preferences instead of a long command."""
    words, command, _ = message.partition(COMMAND)
    text.sentences(layout, context, text.brief(words), icon=icon)
    if command:
        button = layout.operator("preferences.addon_show", text="Choose a Python", icon="PREFERENCES")
        button.module = PHYSGEN_AP_preferences.bl_idname


def active_body(context: bpy.types.Context) -> bpy.types.Object | None:
    """The active object, if it takes part in the simulation."""
    item = context.active_object
    return item if is_body(item) else None


def is_in(item: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether ``item`` is in the scene; a deleted object lives on as long as something points to it."""
    return scene.objects.get(item.name) == item
