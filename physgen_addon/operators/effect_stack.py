# SPDX-License-Identifier: GPL-3.0-or-later
"""The effect stack of the world: add, remove, order, explain, and what an effect acts on."""

import bpy

from ...sim.effects.registry import Parameter, effect
from ..chosen import selected
from ..props.body import is_body
from ..props.scene import EFFECT_ITEMS
from ..text import paragraph, readable

SECTIONS = (("Equation", "Equation"), ("Bodies", "Acts on"), ("Twice", "Several"), ("Source", "Source"))
"""Of what the registry says of an effect: the section, and what it is called here."""


def chosen_effect(scene: bpy.types.Scene) -> bpy.types.PropertyGroup | None:
    """The chosen entry of the stack."""
    world = scene.physgen.world
    return world.effects[world.effect_index] if 0 <= world.effect_index < len(world.effects) else None


def explain(parameter: Parameter) -> str:
    """What it is and its range, such as ``velocity of the air, from -100 to 100 m/s``."""
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
        """What the registry says of it."""
        return effect(properties.effect).summary.rstrip(".")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """At the end of the stack, with the registry's defaults."""
        world = context.scene.physgen.world
        world.effects.add().effect = self.effect
        world.effect_index = len(world.effects) - 1
        return {"FINISHED"}


class _OfStack:
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """An entry is chosen."""
        if chosen_effect(context.scene) is None:
            cls.poll_message_set("Add an effect first")
            return False
        return True


class PHYSGEN_OT_remove_stack_effect(_OfStack, bpy.types.Operator):
    """Take the chosen effect out of the stack"""

    bl_idname = "physgen.remove_stack_effect"
    bl_label = "Remove Effect"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove it; its neighbour is chosen."""
        world = context.scene.physgen.world
        world.effects.remove(world.effect_index)
        world.effect_index = max(min(world.effect_index, len(world.effects) - 1), 0)
        return {"FINISHED"}


class PHYSGEN_OT_move_stack_effect(_OfStack, bpy.types.Operator):
    """Move the chosen effect; they act in this order"""

    bl_idname = "physgen.move_stack_effect"
    bl_label = "Move Effect"

    direction: bpy.props.EnumProperty(name="Direction", items=[("UP", "Up", "Earlier"), ("DOWN", "Down", "Later")])

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Swap with its neighbour, where there is one."""
        world = context.scene.physgen.world
        target = world.effect_index + (-1 if self.direction == "UP" else 1)
        if not 0 <= target < len(world.effects):
            return {"CANCELLED"}
        world.effects.move(world.effect_index, target)
        world.effect_index = target
        return {"FINISHED"}


class PHYSGEN_OT_add_effect_targets(_OfStack, bpy.types.Operator):
    """Let the effect act on the selected objects only"""

    bl_idname = "physgen.add_effect_targets"
    bl_label = "Limit to Selected"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """An entry is chosen, and so is an object that moves."""
        if not super().poll(context):
            return False
        if not any(is_body(item) and item.physgen.role == "dynamic" for item in selected(context)):
            cls.poll_message_set("Select an object of the simulation that moves")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add those that are not there yet."""
        entry = chosen_effect(context.scene)
        known = {target.item for target in entry.targets}
        for item in selected(context):
            if is_body(item) and item.physgen.role == "dynamic" and item not in known:
                entry.targets.add().item = item
        return {"FINISHED"}


class PHYSGEN_OT_remove_effect_target(_OfStack, bpy.types.Operator):
    """Let the effect no longer act on this object; with none left it acts on all"""

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
    """What the effect or its parameter is"""

    bl_idname = "physgen.explain_effect"
    bl_label = "About the Effect"
    bl_options = {"INTERNAL"}  # noqa: RUF012

    effect: bpy.props.EnumProperty(name="Effect", items=EFFECT_ITEMS, options={"SKIP_SAVE"})
    parameter: bpy.props.StringProperty(name="Parameter", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """The parameter's range, or what the effect is."""
        item = effect(properties.effect)
        found = next((p for p in item.parameters if p.name == properties.parameter), None)
        return explain(found) if found is not None else f"{item.summary.rstrip('.')}. Click for its equation"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Nothing to do without a window."""
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """The effect's equation, what it applies to, its source."""
        return context.window_manager.invoke_popup(self, width=420)

    def draw(self, context: bpy.types.Context) -> None:
        """One paragraph a section."""
        item = effect(self.effect)
        self.layout.label(text=readable(item.name), icon="INFO")
        paragraph(self.layout, item.summary, 66)
        for title, heading in SECTIONS:
            paragraph(self.layout, f"{heading}: {item.section(title)}", 66)
        for parameter in item.parameters:
            paragraph(self.layout, f"{readable(parameter.name)}: {explain(parameter)}", 66)


CLASSES = (
    PHYSGEN_OT_add_stack_effect,
    PHYSGEN_OT_remove_stack_effect,
    PHYSGEN_OT_move_stack_effect,
    PHYSGEN_OT_add_effect_targets,
    PHYSGEN_OT_remove_effect_target,
    PHYSGEN_OT_explain_effect,
)
