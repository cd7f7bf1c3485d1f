# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels of the tab "PhysGen" share: their place and order, what is locked while a bake runs."""

from __future__ import annotations

import importlib.util
from typing import Any

import bpy

from ..props.body import is_body
from . import text

SCENE, OBJECTS, MOTION, WORLD, SIMULATE, RENDER, DIAGNOSE = range(7)
"""``bl_order``: the order of work."""

if importlib.util.find_spec(f"{__package__.rpartition('.')[0]}.bake_state") is None:
    bake_state = None
else:
    from .. import bake_state


class Sidebar:
    """Mixin: a panel of the 3D viewport's sidebar."""

    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "PhysGen"


def state(scene: bpy.types.Scene) -> Any:
    """How the scene's bake stands (``bake_state.BakeState``); None where this build cannot bake."""
    return None if bake_state is None else bake_state.state(scene)


def is_baking(scene: bpy.types.Scene) -> bool:
    """Whether what a bake depends on must not change now."""
    found = state(scene)
    return found is not None and found.status == "baking"


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


def exists(operator: str) -> bool:
    """Whether the operator ``physgen.NAME`` is there."""
    return hasattr(bpy.types, f"PHYSGEN_OT_{operator.partition('.')[2]}")


def button(layout: bpy.types.UILayout, operator: str, **options: Any) -> bpy.types.OperatorProperties | None:
    """The operator's button; nothing where this build lacks the operator."""
    return layout.operator(operator, **options) if exists(operator) else None


def active_body(context: bpy.types.Context) -> bpy.types.Object | None:
    """The active object, if it takes part in the simulation."""
    item = context.active_object
    return item if is_body(item) else None


def is_in(item: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether ``item`` is in the scene; a deleted object lives on as long as something points to it."""
    return scene.objects.get(item.name) == item
