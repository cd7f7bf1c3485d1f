# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects into the simulation and out of it; how they begin; what holds them."""

import bpy
from mathutils import Matrix, Vector

from ..bridge.bounds import rest_bounds
from ..bridge.export import SUNK
from ..chosen import active, selected
from ..props.body import bodies, is_body
from ..text import count

PIN_MARK = "physgen_pin"
"""Custom property of the empties that "Add Pin" made, so that only those are deleted with their pin."""
UPPER_PART = 0.25
"""Share of the object's height that a new pin holds."""
_MARGIN = 0.02
"""Of the object's size; a pin reaches so far beyond its surface."""


def _unfit(item: bpy.types.Object) -> str | None:
    """Why ``item`` cannot be simulated, None if it can."""
    if item.type != "MESH":
        return f"{item.name!r} is no mesh: convert it first (Object > Convert > Mesh)"
    if not item.data.polygons and not item.modifiers:
        return f"{item.name!r} has no faces"
    if not item.is_editable:
        return f"{item.name!r} is linked from another file: make it local first"
    return None


def _add(operator: bpy.types.Operator, context: bpy.types.Context, role: str | None) -> list[bpy.types.Object]:
    """Make what is selected a body; what cannot be is reported. ``role`` None leaves that of the object."""
    added = []
    for item in selected(context):
        trouble = _unfit(item)
        if trouble is not None:
            operator.report({"WARNING"}, trouble)
            continue
        item.physgen.enabled = True
        if role is not None:
            item.physgen.role = role
        added.append(item)
    if added and context.view_layer.objects.active not in added:
        context.view_layer.objects.active = added[0]
    return added


def _is_sunk(item: bpy.types.Object, world: bpy.types.PropertyGroup) -> bool:
    """Whether dynamic ``item`` reaches clearly below the plane that the fields of ``world`` give."""
    if item.physgen.role != "dynamic" or not world.use_ground or world.ground_object is not None:
        return False
    corners = [item.matrix_world @ Vector(corner) - Vector(world.ground_point) for corner in item.bound_box]
    heights = [corner.dot(Vector(world.ground_normal).normalized()) for corner in corners]
    return min(heights) < -SUNK * max(item.dimensions)


class _OfSelected:
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Something is selected, in Object Mode."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave Edit Mode first")
        elif not selected(context):
            cls.poll_message_set("Select an object in the viewport first")
        return context.mode == "OBJECT" and bool(selected(context))


class PHYSGEN_OT_add_bodies(_OfSelected, bpy.types.Operator):
    """Let the selected meshes take part in the simulation"""

    bl_idname = "physgen.add_bodies"
    bl_label = "Add Selected"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Enable them."""
        added = _add(self, context, None)
        if not added:
            return {"CANCELLED"}
        self.report({"INFO"}, f"{count(len(added), 'object')} {'is' if len(added) == 1 else 'are'} in the simulation")
        sunk = [item.name for item in added if _is_sunk(item, context.scene.physgen.world)]
        if sunk:
            # Blender's own first cube is one of them; said now rather than when it is to be baked.
            words = f"{', '.join(sunk)}: below the ground. Lift it (G Z), or World > Ground > Put Below the Objects"
            self.report({"WARNING"}, words)
        return {"FINISHED"}


class PHYSGEN_OT_add_colliders(_OfSelected, bpy.types.Operator):
    """Let the selected meshes be obstacles: others hit them, and they yield to nobody"""

    bl_idname = "physgen.add_colliders"
    bl_label = "Add Selected as Colliders"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Enable them with that role."""
        return {"FINISHED"} if _add(self, context, "collider") else {"CANCELLED"}


class PHYSGEN_OT_remove_body(bpy.types.Operator):
    """Take the object out of the simulation. It stays in the scene and keeps its settings"""

    bl_idname = "physgen.remove_body"
    bl_label = "Remove from Simulation"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    name: bpy.props.StringProperty(name="Object", description="Empty: the active object", options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Disable it."""
        item = context.scene.objects.get(self.name) if self.name else active(context)
        if not is_body(item):
            self.report({"WARNING"}, "The active object is not in the simulation: choose one in the list")
            return {"CANCELLED"}
        item.physgen.enabled = False
        return {"FINISHED"}


class PHYSGEN_OT_select_bodies(bpy.types.Operator):
    """Select all objects of the simulation"""

    bl_idname = "physgen.select_bodies"
    bl_label = "Select All of the Simulation"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Object Mode."""
        return context.mode == "OBJECT"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Select them and nothing else."""
        layer = context.view_layer
        for item in layer.objects.selected:
            item.select_set(False)
        found = [item for item in bodies(context.scene) if layer.objects.get(item.name) == item]
        for item in found:
            item.select_set(True)
        if found and layer.objects.active not in found:
            layer.objects.active = found[0]
        return {"FINISHED"}


class OfBody:
    """Mixin: an operator on the active object, which takes part."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The active object takes part."""
        if not is_body(active(context)):
            cls.poll_message_set("The active object is not in the simulation")
            return False
        return True


class PHYSGEN_OT_clear_motion(OfBody, bpy.types.Operator):
    """Let the object begin at rest with the simulation: no velocity, no spin, no start frame"""

    bl_idname = "physgen.clear_motion"
    bl_label = "Clear"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Back to the defaults."""
        for name in ("velocity", "spin", "start_frame"):
            active(context).physgen.property_unset(name)
        return {"FINISHED"}


class PHYSGEN_OT_add_pin(OfBody, bpy.types.Operator):
    """Hold the upper part of the object: adds a box around it that you can move, scale and animate"""

    bl_idname = "physgen.add_pin"
    bl_label = "Add Pin"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """A cube empty, parented to the object so that it goes where the object is put."""
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
    """Let go of what the chosen pin holds; its box is deleted if "Add Pin" made it and nobody else uses it"""

    bl_idname = "physgen.remove_pin"
    bl_label = "Remove Pin"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove the entry, and the box where it is ours."""
        body = active(context).physgen
        if not 0 <= body.pin_index < len(body.pins):
            self.report({"WARNING"}, "There is no pin to remove")
            return {"CANCELLED"}
        box = body.pins[body.pin_index].box
        body.pins.remove(body.pin_index)
        body.pin_index = max(min(body.pin_index, len(body.pins) - 1), 0)
        in_use = any(pin.box == box for item in bpy.data.objects for pin in item.physgen.pins)
        if box is not None and PIN_MARK in box and not in_use:
            bpy.data.objects.remove(box)
        return {"FINISHED"}


CLASSES = (
    PHYSGEN_OT_add_bodies,
    PHYSGEN_OT_add_colliders,
    PHYSGEN_OT_remove_body,
    PHYSGEN_OT_select_bodies,
    PHYSGEN_OT_clear_motion,
    PHYSGEN_OT_add_pin,
    PHYSGEN_OT_remove_pin,
)
