# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: add objects to the simulation, their initial motion, pins, and material presets."""

import bpy
from mathutils import Matrix, Vector

from ...sim.errors import InputError
from ...sim.scene.material import delete_preset, save_preset
from ..compat import OperatorMixin
from ..context import active, remove_entry, selected
from ..props import material_props
from ..props.body_props import bodies, is_body
from ..props.material_props import CUSTOM, get_material, set_material
from ..scene_io import stand_ins
from ..scene_io.export_animation import metres_per_unit
from ..scene_io.export_meshes import mesh_trouble, rest_bounds
from ..scene_io.export_scene import SUNK
from ..text import count, report_errors
from .bake_ops import warm_up

PIN_MARK = "physgen_pin"
"""Custom property of the empties made by "Add Pin"; only those are deleted with their pin."""
UPPER_PART = 0.25
"""Share of the object's height that a new pin holds."""
UPWARDS = 1.0
"""Speed in m/s of a push of what has no velocity to repeat."""
_MARGIN = 0.02
"""Margin of a pin beyond the surface, as a share of the object's size."""


def _unfit(item: bpy.types.Object) -> str | None:
    """Return why ``item`` cannot be simulated, or None."""
    if item.type == "POINTCLOUD" or (item.type != "MESH" and item.type not in stand_ins.CONVERTIBLE):
        if not stand_ins.is_instance(item):
            return f"{item.name!r} has no surface ({item.type.lower()}): only what Blender shows as a mesh is simulated"
    elif item.type == "MESH" and not item.data.polygons and not item.modifiers:
        return f"{item.name!r} has no faces"
    if not item.is_editable:
        return f"{item.name!r} is linked from another file: Object > Relations > Make Local first"
    if item.override_library is not None and not item.physgen.enabled:
        # One that took part in its own file does here; new settings would be grey, and gone when this one is opened.
        return f"{item.name!r} is a library override, which keeps no physics: Object > Relations > Make Local first"
    return None


def add(operator: bpy.types.Operator, context: bpy.types.Context, role: str | None) -> list[bpy.types.Object]:
    """Add the selected objects as bodies and return them; report unsuitable ones. ``role`` None keeps theirs."""
    added = []
    for item in selected(context):
        trouble = _unfit(item)
        if trouble is not None:
            operator.report({"WARNING"}, trouble)
            continue
        if stand_ins.is_set_up(item):
            name = item.name
            items = stand_ins.unpack(context.scene, item)
            words = "its objects are in the scene now, and take part as they were set up"
            operator.report({"INFO"}, f"{name!r} is an instance of a collection: {words}")
            for made in items:
                made.physgen.role = role or made.physgen.role
            added += items
            continue
        wanted = role or item.physgen.role
        why = "" if is_body(item) and item.physgen.original is not None else stand_ins.reason(item, wanted)
        try:
            items = stand_ins.make(context.scene, item) if why else [item]
        except InputError as error:
            operator.report({"WARNING"}, str(error))
            continue
        if why:
            names = ", ".join(repr(made.name) for made in items)
            operator.report({"INFO"}, f"{item.name!r} {why}: {names} stands in for it, and the original is hidden")
        elif words := mesh_trouble(item):
            operator.report({"WARNING"}, words)
        for made in items:
            made.physgen.enabled = True
            if role is not None:
                made.physgen.role = role
        added += items
    context.view_layer.update()
    for item in added:
        # Those that take over later are hidden until then.
        if not item.select_get(view_layer=context.view_layer) and item.visible_get(view_layer=context.view_layer):
            item.select_set(True)
    if added and context.view_layer.objects.active not in added:
        context.view_layer.objects.active = added[0]
    if added:
        warm_up(context)
    return added


def _is_sunk(item: bpy.types.Object, world: bpy.types.PropertyGroup) -> bool:
    """Return whether dynamic ``item`` reaches clearly below the ground plane of ``world``."""
    if item.physgen.role != "dynamic" or not world.use_ground or world.ground_object is not None:
        return False
    corners = [item.matrix_world @ Vector(corner) - Vector(world.ground_point) for corner in item.bound_box]
    heights = [corner.dot(Vector(world.ground_normal).normalized()) for corner in corners]
    return min(heights) < -SUNK * max(item.dimensions)


def settle_ground(scene: bpy.types.Scene, added: list[bpy.types.Object]) -> str:
    """Put the ground below ``added`` if one of them is in it and it was not placed yet; return what to report.

    Blender's default cube is in it. It then has half its height to fall, so that a first bake shows a motion. Where
    the ground was placed, or something else stands on it, it stays and the report says what to do. Empty: all is well.
    """
    world = scene.physgen.world
    sunk = [item.name for item in added if _is_sunk(item, world)]
    if not sunk:
        return ""
    if world.is_property_set("ground_point") or set(bodies(scene)) - set(added):
        return f"{', '.join(sunk)}: below the ground. Lift it (G Z), or World > Ground > Put Below the Objects"
    bounds = [rest_bounds(item) for item in added if item.physgen.role == "dynamic"]
    low, high = min(low.z for low, _ in bounds), max(high.z for _, high in bounds)
    world.ground_point = (0.0, 0.0, low - (high - low) / 2)
    return f"The ground cut through {', '.join(sunk)} and is now below (World > Ground)"


class OfSelected(OperatorMixin):
    """Mixin of operators on the selected objects."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled in Object Mode with a selection."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave Edit Mode first")
        elif not selected(context):
            cls.poll_message_set("Select an object in the viewport first")
        return context.mode == "OBJECT" and bool(selected(context))


class PHYSGEN_OT_add_bodies(OfSelected, bpy.types.Operator):
    """Add the selected meshes to the simulation"""

    bl_idname = "physgen.add_bodies"
    bl_label = "Add Selected"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Enable them."""
        added = add(self, context, None)
        if not added:
            return {"CANCELLED"}
        self.report({"INFO"}, f"{count(len(added), 'object')} {'is' if len(added) == 1 else 'are'} in the simulation")
        words = settle_ground(context.scene, added)
        if words:
            self.report({"WARNING"}, words)
        return {"FINISHED"}


class PHYSGEN_OT_add_colliders(OfSelected, bpy.types.Operator):
    """Add the selected meshes as colliders: obstacles that are not affected by collisions"""

    bl_idname = "physgen.add_colliders"
    bl_label = "Add Selected as Colliders"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Enable them with that role."""
        return {"FINISHED"} if add(self, context, "collider") else {"CANCELLED"}


class PHYSGEN_OT_remove_body(bpy.types.Operator):
    """Remove the object from the simulation. It stays in the scene and keeps its settings; a stand-in is deleted and
    its original shown again
    """

    bl_idname = "physgen.remove_body"
    bl_label = "Remove from Simulation"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    name: bpy.props.StringProperty(name="Object", description="Empty: the active object", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if there is anything to remove."""
        if not bodies(context.scene):
            cls.poll_message_set("Nothing is in the simulation yet")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Disable it."""
        item = context.scene.objects.get(self.name) if self.name else active(context)
        if not is_body(item):
            self.report({"WARNING"}, "The active object is not in the simulation: choose one in the list")
            return {"CANCELLED"}
        if item.physgen.original is not None:
            stand_ins.discard(item)
        else:
            item.physgen.enabled = False
        return {"FINISHED"}


class PHYSGEN_OT_select_bodies(bpy.types.Operator):
    """Select all objects of the simulation"""

    bl_idname = "physgen.select_bodies"
    bl_label = "Select All of the Simulation"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled in Object Mode."""
        return context.mode == "OBJECT"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Select only them."""
        layer = context.view_layer
        for item in layer.objects.selected:
            item.select_set(False)
        found = [item for item in bodies(context.scene) if layer.objects.get(item.name) == item]
        for item in found:
            item.select_set(True)
        if found and layer.objects.active not in found:
            layer.objects.active = found[0]
        return {"FINISHED"}


class OfBody(OperatorMixin):
    """Mixin of operators on the active body."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if the active object is simulated."""
        if not is_body(active(context)):
            cls.poll_message_set("The active object is not in the simulation")
            return False
        return True


class PHYSGEN_OT_clear_motion(OfBody, bpy.types.Operator):
    """Reset the motion: no velocity, no spin, no start frame, no later pushes"""

    bl_idname = "physgen.clear_motion"
    bl_label = "Clear"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Restore the defaults."""
        for name in ("velocity", "spin", "start_frame"):
            active(context).physgen.property_unset(name)
        active(context).physgen.pushes.clear()
        return {"FINISHED"}


class PHYSGEN_OT_add_push(OfBody, bpy.types.Operator):
    """Push the object once more, at the current frame, or a second of the clip after its last push if that is later"""

    bl_idname = "physgen.add_push"
    bl_label = "Add Push"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add a push with the velocity of the last one; upwards where nothing has been pushed yet."""
        body, scene = active(context).physgen, context.scene
        last = max(body.pushes, key=lambda push: push.frame, default=None)
        start = max(body.start_frame, scene.physgen.simulation.frame_start)
        after = (start if last is None else last.frame) + max(1, round(scene.render.fps / scene.render.fps_base))
        velocity = tuple((last or body).velocity)
        push = body.pushes.add()
        push.frame = scene.frame_current if scene.frame_current > (last.frame if last else start) else after
        push.velocity = velocity if any(velocity) else (0.0, 0.0, UPWARDS / metres_per_unit(scene))
        body.push_index = len(body.pushes) - 1
        return {"FINISHED"}


class PHYSGEN_OT_remove_push(OfBody, bpy.types.Operator):
    """Remove the active push"""

    bl_idname = "physgen.remove_push"
    bl_label = "Remove Push"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove the entry."""
        body = active(context).physgen
        if not 0 <= body.push_index < len(body.pushes):
            self.report({"WARNING"}, "There is no push to remove")
            return {"CANCELLED"}
        body.push_index = remove_entry(body.pushes, body.push_index)
        return {"FINISHED"}


class PHYSGEN_OT_add_pin(OfBody, bpy.types.Operator):
    """Hold the upper part of the object: adds a box around it that you can move, scale and animate"""

    bl_idname = "physgen.add_pin"
    bl_label = "Add Pin"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add a cube empty, parented to the object so that it follows the object's placement."""
        item = active(context)
        low, high = rest_bounds(item)
        margin = _MARGIN * max(high - low)
        box_low = Vector((low.x, low.y, high.z - UPPER_PART * (high.z - low.z))) - Vector((margin, margin, 0))
        box_high = high + Vector((margin, margin, margin))
        empty = bpy.data.objects.new(f"{item.name} pin", None)
        empty.empty_display_type, empty.empty_display_size = "CUBE", 1.0
        empty[PIN_MARK] = True
        (item.users_collection or (context.scene.collection,))[0].objects.link(empty)
        empty.parent = item
        empty.matrix_parent_inverse = item.matrix_world.inverted_safe()
        half = (box_high - box_low) / 2
        empty.matrix_basis = Matrix.LocRotScale((box_low + box_high) / 2, None, half)
        pins = item.physgen.pins
        pins.add().box = empty
        item.physgen.pin_index = len(pins) - 1
        return {"FINISHED"}


class PHYSGEN_OT_remove_pin(OfBody, bpy.types.Operator):
    """Remove the active pin; its box is deleted if "Add Pin" made it and nothing else uses it"""

    bl_idname = "physgen.remove_pin"
    bl_label = "Remove Pin"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove the entry, and the box if it was made here."""
        body = active(context).physgen
        if not 0 <= body.pin_index < len(body.pins):
            self.report({"WARNING"}, "There is no pin to remove")
            return {"CANCELLED"}
        box = body.pins[body.pin_index].box
        body.pin_index = remove_entry(body.pins, body.pin_index)
        in_use = any(pin.box == box for item in bpy.data.objects for pin in item.physgen.pins)
        if box is not None and PIN_MARK in box and not in_use:
            bpy.data.objects.remove(box)
        return {"FINISHED"}


class PHYSGEN_OT_save_preset(OfBody, bpy.types.Operator):
    """Save these values as a preset, for all your files"""

    bl_idname = "physgen.save_preset"
    bl_label = "Save as Preset"

    name: bpy.props.StringProperty(
        name="Name", description="Letters, digits, spaces, _ and -", maxlen=48, options={"SKIP_SAVE"}
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the name; that of a user preset is suggested, so that it can be replaced."""
        chosen = active(context).physgen.material.preset_name
        self.name = self.name or (chosen if chosen in material_props.own_presets().good else active(context).name)
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the name, and whether it is taken."""
        self.layout.prop(self, "name")
        if self.name.strip() in material_props.own_presets().good:
            self.layout.label(text="Replaces your preset of that name", icon="INFO")

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Write the preset and assign it."""
        material, name = active(context).physgen.material, self.name.strip()
        path = save_preset(material_props.own_folder(create=True), name, get_material(material))
        material_props.forget_presets()
        material.preset_name = path.stem
        self.report({"INFO"}, f"Material preset {path.stem!r} is saved")
        return {"FINISHED"}


class PHYSGEN_OT_delete_preset(bpy.types.Operator):
    """Delete this user preset from the disk; objects keep their values"""

    bl_idname = "physgen.delete_preset"
    bl_label = "Delete Preset"

    name: bpy.props.StringProperty(name="Name", options={"SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for confirmation, because undo does not restore files."""
        return context.window_manager.invoke_confirm(self, event)

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Delete the file; materials that used it become custom."""
        delete_preset(material_props.own_folder(), self.name)
        material_props.forget_presets()
        for item in bpy.data.objects:
            if item.physgen.material.preset_name == self.name and item.is_editable:
                item.physgen.material.preset_name = CUSTOM
        self.report({"INFO"}, f"Material preset {self.name!r} is deleted")
        return {"FINISHED"}


class PHYSGEN_OT_reset_preset(OfBody, bpy.types.Operator):
    """Reset all values to the preset's"""

    bl_idname = "physgen.reset_preset"
    bl_label = "Reset to Preset"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set all values."""
        material = active(context).physgen.material
        preset = material_props.find_preset(material.preset_name)
        if preset is None:
            self.report({"WARNING"}, f"There is no preset {material.preset_name!r} here: choose another")
            return {"CANCELLED"}
        set_material(material, preset)
        return {"FINISHED"}


class PHYSGEN_OT_copy_material(OfBody, bpy.types.Operator):
    """Copy the active object's material to all selected objects of the simulation"""

    bl_idname = "physgen.copy_material"
    bl_label = "Copy to Selected"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with another body selected."""
        if not super().poll(context):
            return False
        if not any(is_body(o) and o != active(context) for o in selected(context)):
            cls.poll_message_set("Select more objects of the simulation; the active one's material is copied")
            return False
        return True

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Copy values and the preset's name."""
        source = active(context).physgen.material
        others = [o for o in selected(context) if is_body(o) and o != active(context) and o.is_editable]
        material = get_material(source)
        for item in others:
            set_material(item.physgen.material, material)
            item.physgen.material.preset_name = source.preset_name
            item.physgen.material.likeness = source.likeness
        self.report({"INFO"}, f"Material copied to {count(len(others), 'object')}")
        return {"FINISHED"}
