# SPDX-License-Identifier: GPL-3.0-or-later
"""What PhysGen knows of a scene: where it comes from, its world, how it is simulated.

Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

import math
import zlib

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ...sim.effects.registry import Effect, Parameter, effect, effects
from ..paths import RELATIVE
from ..text import readable
from ..typed import decimal
from .body import is_body
from .rendering import PHYSGEN_PG_rendering
from .surface import Surface

EFFECT_ITEMS = [
    # Blender stores the number: it must stay that effect's when the registry grows.
    (name, readable(name), item.summary, zlib.crc32(name.encode()) & 0x7FFFFFFF)
    for name, item in effects().items()
    if item.kind != "observation"
]
"""What can act on a scene; effects of the kind "observation" concern who looks."""


def known_effect(entry: "PHYSGEN_PG_effect_entry") -> Effect | None:
    """The effect of ``entry``; None where the file is of a version that had another one."""
    return effects().get(entry.effect)


def _on_effect(self: "PHYSGEN_PG_effect_entry", context: bpy.types.Context) -> None:
    self.parameters.clear()
    kind = known_effect(self)
    for parameter in kind.parameters if kind is not None else ():
        item = self.parameters.add()
        item.name, item.value = parameter.name, parameter.default


def parameter_of(number: "PHYSGEN_PG_number") -> Parameter | None:
    """What the registry says of ``number``; None while it has no name, or one of an older registry."""
    # A property group does not know its owner, but where it is.
    owner = number.id_data.path_resolve(number.path_from_id().rpartition(".parameters")[0])
    kind = known_effect(owner)
    return None if kind is None else next((p for p in kind.parameters if p.name == number.name), None)


def _clamped(value: float, parameter: Parameter) -> float:
    value = min(max(value, parameter.low), parameter.high)
    return float(round(value)) if parameter.whole else value


def _on_number(self: "PHYSGEN_PG_number", context: bpy.types.Context) -> None:
    parameter = parameter_of(self)
    if parameter is None:
        return
    value = _clamped(self.value, parameter)
    # Blender keeps 32 bits, in which a bound may lie just beyond itself.
    if not math.isclose(value, self.value, rel_tol=1e-6, abs_tol=1e-9):
        self.value = value


def _get_value(self: "PHYSGEN_PG_number") -> float:
    return self.value


def _set_value(self: "PHYSGEN_PG_number", value: float) -> None:
    self.value = value


def _get_switch(self: "PHYSGEN_PG_number") -> bool:
    return self.value >= 0.5


class PHYSGEN_PG_number(bpy.types.PropertyGroup):
    """A parameter of an effect; ``name`` is the registry's, which knows its unit and range.

    ``value`` is what is kept, in the registry's unit; the others show the same as an angle and as yes or no.
    """

    value: FloatProperty(name="Value", description="Kept within the effect's range", precision=4, update=_on_number)
    angle: FloatProperty(
        name="Angle",
        description="Kept within the effect's range",
        subtype="ANGLE",
        get=_get_value,
        set=_set_value,
    )
    switch: BoolProperty(name="On", get=_get_switch, set=_set_value)


def effect_values(entry: "PHYSGEN_PG_effect_entry") -> dict[str, float]:
    """The parameters of ``entry`` as the registry takes them: complete, in range, 0.4 as 0.4."""
    given = {number.name: decimal(number.value) for number in entry.parameters}
    return {p.name: _clamped(given.get(p.name, p.default), p) for p in effect(entry.effect).parameters}


class PHYSGEN_PG_target(bpy.types.PropertyGroup):
    """An object that an effect acts on."""

    item: PointerProperty(name="Object", description="Object that the effect acts on", type=bpy.types.Object)


class PHYSGEN_PG_effect_entry(bpy.types.PropertyGroup):
    """An entry of the effect stack."""

    enabled: BoolProperty(name="On", description="Let the effect act", default=True)
    effect: EnumProperty(name="Effect", description="What acts", items=EFFECT_ITEMS, update=_on_effect)
    parameters: CollectionProperty(type=PHYSGEN_PG_number)
    targets: CollectionProperty(type=PHYSGEN_PG_target)
    """Empty: all that it can act on."""


class PHYSGEN_PG_world(Surface, bpy.types.PropertyGroup):
    """Ground and effects. Gravity is Blender's own (``Scene.gravity``)."""

    use_ground: BoolProperty(name="Ground", description="A floor without end", default=True)
    ground_object: PointerProperty(
        name="Plane",
        description="Object through whose origin the ground goes, across its own Z axis. None: the plane below",
        type=bpy.types.Object,
    )
    ground_point: FloatVectorProperty(
        name="Point", description="A point of the ground", subtype="TRANSLATION", unit="LENGTH"
    )
    ground_normal: FloatVectorProperty(
        name="Up", description="The side on which objects stand", subtype="DIRECTION", default=(0.0, 0.0, 1.0)
    )
    effects: CollectionProperty(type=PHYSGEN_PG_effect_entry)
    effect_index: IntProperty(name="Effect")


class PHYSGEN_PG_simulation(bpy.types.PropertyGroup):
    """How the scene is simulated, and the bake that it shows."""

    quality: EnumProperty(
        name="Quality",
        description="How finely the scene is simulated",
        items=[
            ("preview", "Preview", "Seconds: to see whether a motion is the right one"),
            ("standard", "Standard", "For most scenes on a laptop"),
            ("fine", "Fine", "Thin parts and wrinkles; several times as slow"),
            ("papers", "Papers", "256 cells along a box four times as wide as all that moves"),
        ],
        default="standard",
    )
    frame_start: IntProperty(
        name="Start", description="Frame that shows the scene at rest", default=1, min=0, soft_max=250
    )
    frame_end: IntProperty(name="End", description="Last frame that is simulated", default=48, min=0, soft_max=500)
    device: EnumProperty(
        name="Device",
        description="Where the simulation runs; what is not there falls back to the processor",
        items=[
            ("cpu", "CPU", "The processor"),
            ("cuda", "CUDA", "An NVIDIA graphics card"),
            ("vulkan", "Vulkan", "A graphics card with Vulkan"),
            ("metal", "Metal", "Apple's graphics"),
        ],
    )
    seed: IntProperty(name="Seed", description="Of the particles' places", min=0)
    cache: StringProperty(
        name="Cache",
        description="Folder of the bakes; // is beside the .blend",
        subtype="DIR_PATH",
        default="//physgen_cache",
        options=RELATIVE,
    )
    bake: StringProperty(
        name="Bake", description="Folder of the bake that is shown; empty: none", subtype="DIR_PATH", options=RELATIVE
    )
    unsaved: StringProperty(description="Where bakes wait until the file is saved")
    estimate: StringProperty(description="What the bake was estimated to cost")
    estimate_of: StringProperty(description="Fingerprint of the scene that was estimated")


def _get_body_index(self: "PHYSGEN_PG_scene") -> int:
    """Nothing of its own is kept, so that list and viewport cannot come apart."""
    scene, layer = self.id_data, getattr(bpy.context, "view_layer", None)
    active = layer.objects.active if layer is not None and bpy.context.scene == scene else None
    return scene.objects.find(active.name) if is_body(active) else -1


def _set_body_index(self: "PHYSGEN_PG_scene", index: int) -> None:
    scene, layer = self.id_data, getattr(bpy.context, "view_layer", None)
    if layer is None or bpy.context.scene != scene or not 0 <= index < len(scene.objects):
        return
    item = scene.objects[index]
    # What is in an excluded collection cannot be selected.
    if layer.objects.get(item.name) != item or bpy.context.mode != "OBJECT":
        return
    for other in layer.objects.selected:
        other.select_set(False)
    item.select_set(True)
    layer.objects.active = item


class PHYSGEN_PG_scene(bpy.types.PropertyGroup):
    """All that PhysGen knows of a scene; ``Scene.physgen``."""

    folder: StringProperty(
        name="Scene Folder",
        description="Scene folder that this scene was imported from; empty for scenes without a photo",
        subtype="DIR_PATH",
        options=RELATIVE,
    )
    photo_root: PointerProperty(type=bpy.types.Collection)
    """Collection of what was imported with the photo."""
    body_index: IntProperty(
        name="Object", description="The chosen object, active in the viewport", get=_get_body_index, set=_set_body_index
    )
    """Place in ``Scene.objects`` of the active object; -1 when that is none that takes part."""
    world: PointerProperty(type=PHYSGEN_PG_world)
    simulation: PointerProperty(type=PHYSGEN_PG_simulation)
    rendering: PointerProperty(type=PHYSGEN_PG_rendering)


CLASSES = (
    PHYSGEN_PG_number,
    PHYSGEN_PG_target,
    PHYSGEN_PG_effect_entry,
    PHYSGEN_PG_world,
    PHYSGEN_PG_simulation,
    PHYSGEN_PG_scene,
)


def register() -> None:
    """Let every scene have a ``physgen``."""
    bpy.types.Scene.physgen = PointerProperty(type=PHYSGEN_PG_scene)


def unregister() -> None:
    """Take it away again; what a file has stored stays stored."""
    del bpy.types.Scene.physgen
