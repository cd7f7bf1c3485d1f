# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: the effect stack, the ground, and the frame range."""

from typing import Any

import bpy

from ...sim.effects.registry import Parameter, effect
from ..compat import OperatorMixin
from ..context import remove_entry, selected
from ..props.body_props import bodies, is_body
from ..props.scene_props import EFFECT_ITEMS
from ..scene_io.export_meshes import rest_bounds
from ..text import paragraph, readable

SECTIONS = (("Equation", "Equation"), ("Bodies", "Acts on"), ("Twice", "Several"), ("Source", "Source"))
"""Sections of an effect's description in the registry, and their headings here."""


def chosen_effect(scene: bpy.types.Scene) -> Any:
    """Return the active entry of the stack."""
    world = scene.physgen.world
    return world.effects[world.effect_index] if 0 <= world.effect_index < len(world.effects) else None


def explain(parameter: Parameter) -> str:
    """Return name and range, such as ``velocity of the air, from -100 to 100 m/s``."""
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return f"{parameter.description}, from {parameter.low:g} to {parameter.high:g}{unit}"


class PHYSGEN_OT_add_stack_effect(bpy.types.Operator):
    """Add an effect to the stack"""

    bl_idname = "physgen.add_stack_effect"
    bl_label = "Add Effect"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    effect: bpy.props.EnumProperty(name="Effect", items=EFFECT_ITEMS, options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """Return the registry's description."""
        return effect(properties.effect).summary.rstrip(".")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Append it with the registry's defaults."""
        world = context.scene.physgen.world
        world.effects.add().effect = self.effect
        world.effect_index = len(world.effects) - 1
        return {"FINISHED"}


class _OfStack(OperatorMixin):
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with an active entry."""
        if chosen_effect(context.scene) is None:
            cls.poll_message_set("Add an effect first")
            return False
        return True


class PHYSGEN_OT_remove_stack_effect(_OfStack, bpy.types.Operator):
    """Remove the active effect from the stack"""

    bl_idname = "physgen.remove_stack_effect"
    bl_label = "Remove Effect"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove it; its neighbour becomes active."""
        world = context.scene.physgen.world
        world.effect_index = remove_entry(world.effects, world.effect_index)
        return {"FINISHED"}


class PHYSGEN_OT_move_stack_effect(_OfStack, bpy.types.Operator):
    """Move the active effect; effects act in this order"""

    bl_idname = "physgen.move_stack_effect"
    bl_label = "Move Effect"

    direction: bpy.props.EnumProperty(name="Direction", items=[("UP", "Up", "Earlier"), ("DOWN", "Down", "Later")])

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Swap with the neighbour, if there is one."""
        world = context.scene.physgen.world
        target = world.effect_index + (-1 if self.direction == "UP" else 1)
        if not 0 <= target < len(world.effects):
            return {"CANCELLED"}
        world.effects.move(world.effect_index, target)
        world.effect_index = target
        return {"FINISHED"}


class PHYSGEN_OT_add_effect_targets(_OfStack, bpy.types.Operator):
    """Limit the effect to the selected objects"""

    bl_idname = "physgen.add_effect_targets"
    bl_label = "Limit to Selected"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with an active entry and a selected dynamic object."""
        if not super().poll(context):
            return False
        if not any(is_body(item) and item.physgen.role == "dynamic" for item in selected(context)):
            cls.poll_message_set("Select an object of the simulation that moves")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add missing ones."""
        entry = chosen_effect(context.scene)
        known = {target.item for target in entry.targets}
        for item in selected(context):
            if is_body(item) and item.physgen.role == "dynamic" and item not in known:
                entry.targets.add().item = item
        return {"FINISHED"}


class PHYSGEN_OT_remove_effect_target(_OfStack, bpy.types.Operator):
    """Remove this object from the effect; without any it acts on all objects"""

    bl_idname = "physgen.remove_effect_target"
    bl_label = "Remove Object"

    index: bpy.props.IntProperty(name="Index", min=0, options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove it from the list."""
        targets = chosen_effect(context.scene).targets
        if not self.index < len(targets):
            return {"CANCELLED"}
        targets.remove(self.index)
        return {"FINISHED"}


class PHYSGEN_OT_explain_effect(bpy.types.Operator):
    """Description of the effect or its parameter"""

    bl_idname = "physgen.explain_effect"
    bl_label = "About the Effect"
    bl_options = {"INTERNAL"}  # noqa: RUF012

    effect: bpy.props.EnumProperty(name="Effect", items=EFFECT_ITEMS, options={"SKIP_SAVE"})
    parameter: bpy.props.StringProperty(name="Parameter", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """Return the parameter's range, or the effect's summary."""
        item = effect(properties.effect)
        found = next((p for p in item.parameters if p.name == properties.parameter), None)
        return explain(found) if found is not None else f"{item.summary.rstrip('.')}. Click for its equation"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """No effect without a window."""
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the effect's equation, scope and source."""
        return context.window_manager.invoke_popup(self, width=420)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw one paragraph a section."""
        item = effect(self.effect)
        self.layout.label(text=readable(item.name), icon="INFO")
        paragraph(self.layout, item.summary, 66)
        for title, heading in SECTIONS:
            paragraph(self.layout, f"{heading}: {item.section(title)}", 66)
        for parameter in item.parameters:
            paragraph(self.layout, f"{readable(parameter.name)}: {explain(parameter)}", 66)


class PHYSGEN_OT_ground_below(bpy.types.Operator):
    """Place the ground at the lowest point of all dynamic objects"""

    bl_idname = "physgen.ground_below"
    bl_label = "Put Below the Objects"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with a dynamic object."""
        if not any(item.physgen.role == "dynamic" for item in bodies(context.scene)):
            cls.poll_message_set("Add an object to the simulation first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Set a level plane at the height of the lowest corner."""
        moving = [item for item in bodies(context.scene) if item.physgen.role == "dynamic"]
        lowest = min(rest_bounds(item)[0].z for item in moving)
        world = context.scene.physgen.world
        world.use_ground, world.ground_object = True, None
        world.ground_point, world.ground_normal = (0.0, 0.0, lowest), (0.0, 0.0, 1.0)
        return {"FINISHED"}


class PHYSGEN_OT_frames_from_scene(bpy.types.Operator):
    """Use the scene's frame range for the simulation"""

    bl_idname = "physgen.frames_from_scene"
    bl_label = "From Scene"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Copy the scene's start and end."""
        scene = context.scene
        simulation = scene.physgen.simulation
        simulation.frame_start, simulation.frame_end = scene.frame_start, scene.frame_end
        return {"FINISHED"}


class PHYSGEN_OT_play_bake_only(bpy.types.Operator):
    """Set the scene's frame range to that of the simulation, so that playback loops over the bake"""

    bl_idname = "physgen.play_bake_only"
    bl_label = "Play Only the Bake"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Copy the simulation's start and end."""
        scene = context.scene
        simulation = scene.physgen.simulation
        scene.frame_start, scene.frame_end = simulation.frame_start, simulation.frame_end
        return {"FINISHED"}
