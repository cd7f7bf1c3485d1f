# SPDX-License-Identifier: GPL-3.0-or-later
"""Material presets of one's own: save, delete, go back to; one object's material to others."""

import bpy

from ...sim.scene.materials import delete_preset, save_preset
from ..chosen import active, selected
from ..props import presets
from ..props.body import is_body
from ..props.material import get_material, set_material
from ..props.presets import CUSTOM
from ..reports import reports_errors
from ..text import count
from .body import OfBody


class PHYSGEN_OT_save_preset(OfBody, bpy.types.Operator):
    """Keep these numbers under a name, for all your files"""

    bl_idname = "physgen.save_preset"
    bl_label = "Save as Preset"

    name: bpy.props.StringProperty(
        name="Name", description="Letters, digits, spaces, _ and -", maxlen=48, options={"SKIP_SAVE"}
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the name; that of a preset of one's own is suggested, so that it can be changed."""
        chosen = active(context).physgen.material.preset_name
        self.name = self.name or (chosen if chosen in presets.own_presets().good else active(context).name)
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context: bpy.types.Context) -> None:
        """The name, and whether it is taken."""
        self.layout.prop(self, "name")
        if self.name.strip() in presets.own_presets().good:
            self.layout.label(text="Replaces your preset of that name", icon="INFO")

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Write it, and let the object use it."""
        material, name = active(context).physgen.material, self.name.strip()
        path = save_preset(presets.own_folder(create=True), name, get_material(material))
        presets.forget()
        material.preset_name = path.stem
        self.report({"INFO"}, f"Material preset {path.stem!r} is saved")
        return {"FINISHED"}


class PHYSGEN_OT_delete_preset(bpy.types.Operator):
    """Delete this preset of your own from the disk; objects keep their numbers"""

    bl_idname = "physgen.delete_preset"
    bl_label = "Delete Preset"

    name: bpy.props.StringProperty(name="Name", options={"SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask, because undo does not bring a file back."""
        return context.window_manager.invoke_confirm(self, event)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Delete the file; what used it becomes custom."""
        delete_preset(presets.own_folder(), self.name)
        presets.forget()
        for item in bpy.data.objects:
            if item.physgen.material.preset_name == self.name and item.is_editable:
                item.physgen.material.preset_name = CUSTOM
        self.report({"INFO"}, f"Material preset {self.name!r} is deleted")
        return {"FINISHED"}


class PHYSGEN_OT_reset_preset(OfBody, bpy.types.Operator):
    """Go back to the preset's numbers"""

    bl_idname = "physgen.reset_preset"
    bl_label = "Reset to Preset"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set them all."""
        material = active(context).physgen.material
        preset = presets.find(material.preset_name)
        if preset is None:
            self.report({"WARNING"}, f"There is no preset {material.preset_name!r} here: choose another")
            return {"CANCELLED"}
        set_material(material, preset)
        return {"FINISHED"}


class PHYSGEN_OT_copy_material(OfBody, bpy.types.Operator):
    """Give all selected objects of the simulation the active one's material"""

    bl_idname = "physgen.copy_material"
    bl_label = "Copy to Selected"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is another one."""
        if not super().poll(context):
            return False
        if not any(is_body(o) and o != active(context) for o in selected(context)):
            cls.poll_message_set("Select more objects of the simulation; the active one's material is copied")
            return False
        return True

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Numbers and the preset's name."""
        source = active(context).physgen.material
        others = [o for o in selected(context) if is_body(o) and o != active(context) and o.is_editable]
        material = get_material(source)
        for item in others:
            set_material(item.physgen.material, material)
            item.physgen.material.preset_name = source.preset_name
        self.report({"INFO"}, f"Material copied to {count(len(others), 'object')}")
        return {"FINISHED"}


CLASSES = (
    PHYSGEN_OT_save_preset,
    PHYSGEN_OT_delete_preset,
    PHYSGEN_OT_reset_preset,
    PHYSGEN_OT_copy_material,
)
