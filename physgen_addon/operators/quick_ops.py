# SPDX-License-Identifier: GPL-3.0-or-later
"""Where artists look: Object > Quick Effects, Object > PhysGen, a pie menu with its key, and a button in Physics."""

from typing import ClassVar

import bpy

from ..compat import OperatorMixin
from ..context import active
from ..preview.live_preview import PHYSGEN_OT_toggle_preview
from ..props.body_props import bodies, is_body
from ..props.preferences import PIE
from ..text import count
from .asset_ops import PHYSGEN_OT_open_sample
from .bake_cache_ops import PHYSGEN_OT_free_bake
from .bake_ops import PHYSGEN_OT_bake
from .body_ops import (
    OfSelected,
    PHYSGEN_OT_add_bodies,
    PHYSGEN_OT_add_colliders,
    PHYSGEN_OT_clear_motion,
    PHYSGEN_OT_remove_body,
    add,
    settle_ground,
)
from .compose_ops import PHYSGEN_OT_compose_objects
from .photo_ops import PHYSGEN_OT_open_photo

KEY = {"type": "P", "value": "PRESS", "shift": True}
"""Of the pie menu, in Object Mode, where Blender uses it for nothing."""


class _Quick(OfSelected, OperatorMixin):
    """Mixin: let the selected objects move, of the material ``preset``."""

    preset: ClassVar[str]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add them, set the material, and put the ground below them if it was at their height."""
        added = add(self, context, "dynamic")
        for item in added:
            item.physgen.material.preset = self.preset
        if not added:
            return {"CANCELLED"}
        self.report({"INFO"}, f"{count(len(added), 'object')} of {self.preset}; press Bake (Shift P, or N > PhysGen)")
        words = settle_ground(context.scene, added)
        if words:
            self.report({"WARNING"}, words)
        return {"FINISHED"}


class PHYSGEN_OT_quick_jelly(_Quick, bpy.types.Operator):
    """Let the selected objects fall and wobble like jelly"""

    bl_idname, bl_label, preset = "physgen.quick_jelly", "Quick Jelly", "jelly"


class PHYSGEN_OT_quick_sand(_Quick, bpy.types.Operator):
    """Let the selected objects fall apart into dry sand"""

    bl_idname, bl_label, preset = "physgen.quick_sand", "Quick Sand", "sand"


class PHYSGEN_OT_quick_liquid(_Quick, bpy.types.Operator):
    """Let the selected objects pour out as water"""

    bl_idname, bl_label, preset = "physgen.quick_liquid", "Quick Liquid", "water"


class PHYSGEN_OT_quick_rigid(_Quick, bpy.types.Operator):
    """Let the selected objects fall and bounce without deforming, like wood"""

    bl_idname, bl_label, preset = "physgen.quick_rigid", "Quick Rigid", "wood"


QUICK = (
    (PHYSGEN_OT_quick_jelly, "META_BALL"),
    (PHYSGEN_OT_quick_sand, "POINTCLOUD_DATA"),
    (PHYSGEN_OT_quick_liquid, "MOD_FLUIDSIM"),
    (PHYSGEN_OT_quick_rigid, "RIGID_BODY"),
)


class PHYSGEN_MT_object(bpy.types.Menu):
    """Everything that one would look for in the menu Object, and by F3"""

    bl_idname = "PHYSGEN_MT_object"
    bl_label = "PhysGen"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw what acts on the selected objects, then on the scene."""
        layout = self.layout
        layout.operator(PHYSGEN_OT_add_bodies.bl_idname, text="Simulate Selected", icon="PHYSICS")
        layout.operator(PHYSGEN_OT_add_colliders.bl_idname, text="Add Selected as Colliders", icon="MOD_PHYSICS")
        layout.operator(PHYSGEN_OT_remove_body.bl_idname, text="Remove from Simulation", icon="X")
        layout.operator(PHYSGEN_OT_clear_motion.bl_idname, text="Clear Initial Motion")
        layout.separator()
        for operator, icon in QUICK:
            layout.operator(operator.bl_idname, icon=icon)
        layout.separator()
        layout.operator(PHYSGEN_OT_toggle_preview.bl_idname, text="Live Preview of the Simulation", icon="PLAY")
        row = layout.row()
        row.enabled = bool(bodies(context.scene))
        row.operator(PHYSGEN_OT_bake.bl_idname, text="Bake Simulation", icon="PHYSICS")
        layout.operator(PHYSGEN_OT_free_bake.bl_idname, text="Free Simulation Bake", icon="TRASH")
        layout.separator()
        layout.operator(PHYSGEN_OT_compose_objects.bl_idname, icon="CON_SHRINKWRAP")
        layout.operator(PHYSGEN_OT_open_photo.bl_idname, text="Start from a Photo", icon="IMAGE_DATA")
        layout.operator(PHYSGEN_OT_open_sample.bl_idname, text="Open Sample Meshes").sample = "MESHES"
        layout.operator(PHYSGEN_OT_open_sample.bl_idname, text="Open Sample Photo").sample = "PHOTO"


class PHYSGEN_MT_pie(bpy.types.Menu):
    """Materials around, Bake and Live Preview above and below"""

    bl_idname = PIE
    bl_label = "PhysGen"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw eight entries, in Blender's order: left, right, bottom, top, then the corners."""
        pie = self.layout.menu_pie()
        pie.operator(PHYSGEN_OT_quick_jelly.bl_idname, icon="META_BALL")
        pie.operator(PHYSGEN_OT_quick_rigid.bl_idname, icon="RIGID_BODY")
        pie.operator(PHYSGEN_OT_toggle_preview.bl_idname, text="Live Preview", icon="PLAY")
        ready = pie.row()
        ready.enabled = bool(bodies(context.scene))
        ready.operator(PHYSGEN_OT_bake.bl_idname, icon="PHYSICS")
        pie.operator(PHYSGEN_OT_quick_sand.bl_idname, icon="POINTCLOUD_DATA")
        pie.operator(PHYSGEN_OT_quick_liquid.bl_idname, icon="MOD_FLUIDSIM")
        pie.operator(PHYSGEN_OT_add_colliders.bl_idname, text="Collider", icon="MOD_PHYSICS")
        pie.operator(PHYSGEN_OT_remove_body.bl_idname, text="Remove", icon="X")


def _draw_quick_effects(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    """Draw them below Blender's own, of which one is a Quick Liquid, too."""
    self.layout.separator()
    for operator, icon in QUICK:
        self.layout.operator(operator.bl_idname, text=f"{operator.bl_label} (PhysGen)", icon=icon)


def _draw_object_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.separator()
    self.layout.menu(PHYSGEN_MT_object.bl_idname)


def _draw_physics_button(self: bpy.types.Panel, context: bpy.types.Context) -> None:
    """Draw the button among those of cloth, fluid and rigid body."""
    if is_body(active(context)):
        self.layout.operator(PHYSGEN_OT_remove_body.bl_idname, text="PhysGen", icon="X")
    else:
        self.layout.operator(PHYSGEN_OT_add_bodies.bl_idname, text="PhysGen", icon="PHYSICS")


MENUS = (
    ("VIEW3D_MT_object_quick_effects", _draw_quick_effects),
    ("VIEW3D_MT_object", _draw_object_menu),
    ("PHYSICS_PT_add", _draw_physics_button),
)
_keys: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


def register_quick_access() -> None:
    """Add menus and the key; users change it in Preferences > Keymap, or on the extension's page."""
    for menu, draw in MENUS:
        getattr(bpy.types, menu).append(draw)
    configuration = bpy.context.window_manager.keyconfigs.addon
    if configuration is not None:
        keymap = configuration.keymaps.new("Object Mode")
        item = keymap.keymap_items.new("wm.call_menu_pie", **KEY)
        item.properties.name = PIE
        _keys.append((keymap, item))


def unregister_quick_access() -> None:
    """Remove menus and the key."""
    for menu, draw in MENUS:
        getattr(bpy.types, menu).remove(draw)
    for keymap, item in _keys:
        keymap.keymap_items.remove(item)
    _keys.clear()
