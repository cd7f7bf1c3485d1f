# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties of a scene: its folder, world, simulation settings, and composition of objects."""

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

from ...sim.app.bake_options import BakeOptions
from ...sim.effects.registry import Effect, Parameter, effect, effects
from ...sim.gaussians.compose.compose_options import ComposeOptions
from ..paths import RELATIVE
from ..text import decimal, readable
from .body_props import Surface, is_body
from .generated_properties import from_field
from .render_props import PHYSGEN_PG_rendering

EFFECT_ITEMS = [
    # Blender stores the number: it must stay that effect's when the registry grows.
    (name, readable(name), item.summary, zlib.crc32(name.encode()) & 0x7FFFFFFF)
    for name, item in effects().items()
    if item.kind != "observation"
]
"""Effects on a scene; those of the kind "observation" concern the recording."""


def known_effect(entry: "PHYSGEN_PG_effect_entry") -> Effect | None:
    """Return the effect of ``entry``; None if this version does not know it."""
    return effects().get(entry.effect)


def _on_effect(self: "PHYSGEN_PG_effect_entry", context: bpy.types.Context) -> None:
    self.parameters.clear()
    kind = known_effect(self)
    for parameter in kind.parameters if kind is not None else ():
        item = self.parameters.add()
        item.name, item.value = parameter.name, parameter.default


def parameter_of(number: "PHYSGEN_PG_number") -> Parameter | None:
    """Return the registry's parameter of ``number``; None before it has a name, or if unknown."""
    # A property group does not know its owner, but its path.
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
    # Blender stores 32 bits, in which a bound may lie just beyond itself.
    if not math.isclose(value, self.value, rel_tol=1e-6, abs_tol=1e-9):
        self.value = value


def _get_value(self: "PHYSGEN_PG_number") -> float:
    return self.value


def _set_value(self: "PHYSGEN_PG_number", value: float) -> None:
    self.value = value


def _get_switch(self: "PHYSGEN_PG_number") -> bool:
    return self.value >= 0.5


class PHYSGEN_PG_number(bpy.types.PropertyGroup):
    """A parameter of an effect; ``name`` is the registry's, which defines unit and range.

    ``value`` is stored, in the registry's unit; the others show it as an angle and as a toggle.
    """

    value: FloatProperty(name="Value", description="Clamped to the effect's range", precision=4, update=_on_number)
    angle: FloatProperty(
        name="Angle",
        description="Clamped to the effect's range",
        subtype="ANGLE",
        get=_get_value,
        set=_set_value,
    )
    switch: BoolProperty(name="On", get=_get_switch, set=_set_value)


def effect_values(entry: "PHYSGEN_PG_effect_entry") -> dict[str, float]:
    """Return the parameters of ``entry`` for the registry: complete, in range, 0.4 as 0.4."""
    given = {number.name: decimal(number.value) for number in entry.parameters}
    return {p.name: _clamped(given.get(p.name, p.default), p) for p in effect(entry.effect).parameters}


class PHYSGEN_PG_target(bpy.types.PropertyGroup):
    """An object that an effect acts on."""

    item: PointerProperty(name="Object", description="Object that the effect acts on", type=bpy.types.Object)


class PHYSGEN_PG_effect_entry(bpy.types.PropertyGroup):
    """An entry of the effect stack."""

    enabled: BoolProperty(name="On", description="Enable the effect", default=True)
    effect: EnumProperty(name="Effect", description="Kind of effect", items=EFFECT_ITEMS, update=_on_effect)
    parameters: CollectionProperty(type=PHYSGEN_PG_number)
    targets: CollectionProperty(type=PHYSGEN_PG_target)
    """Empty: all objects that it can act on."""


class PHYSGEN_PG_world(Surface, bpy.types.PropertyGroup):
    """Ground and effects. Gravity is Blender's own (``Scene.gravity``)."""

    use_ground: BoolProperty(name="Ground", description="Infinite ground plane", default=True)
    ground_object: PointerProperty(
        name="Plane",
        description="Object whose local XY plane is the ground. None: the plane below",
        type=bpy.types.Object,
    )
    ground_point: FloatVectorProperty(
        name="Point", description="A point of the ground", subtype="TRANSLATION", unit="LENGTH"
    )
    ground_normal: FloatVectorProperty(
        name="Up", description="Upward direction of the ground", subtype="DIRECTION", default=(0.0, 0.0, 1.0)
    )
    effects: CollectionProperty(type=PHYSGEN_PG_effect_entry)
    effect_index: IntProperty(name="Effect")


class PHYSGEN_PG_simulation(bpy.types.PropertyGroup):
    """Settings of the simulation, and the shown bake."""

    quality: from_field(
        BakeOptions,
        "quality",
        "Quality",
        "Resolution of the simulation",
        # A first bake is to be seen at once; the command line's own default is for what is kept.
        default="preview",
        items=[
            ("preview", "Preview", "Takes seconds: to judge a motion"),
            ("standard", "Standard", "For most scenes on a laptop"),
            ("fine", "Fine", "Thin parts and wrinkles; several times as slow"),
            ("papers", "Papers", "256 cells along a box four times the extent of all dynamic objects"),
        ],
    )
    frame_start: IntProperty(
        name="Start", description="Frame that shows the scene at rest", default=1, min=0, soft_max=250
    )
    frame_end: IntProperty(name="End", description="Last simulated frame", default=48, min=0, soft_max=500)
    slow: from_field(
        BakeOptions,
        "slow",
        "Slow Motion",
        "How many times slower than real the frames show the motion",
        soft_min=1.0,
        soft_max=16.0,
    )
    device: from_field(
        BakeOptions,
        "arch",
        "Device",
        "Device of the simulation; falls back to the CPU",
        items=[
            ("cpu", "CPU", "CPU"),
            ("cuda", "CUDA", "An NVIDIA graphics card"),
            ("vulkan", "Vulkan", "A graphics card with Vulkan"),
            ("metal", "Metal", "Apple's graphics"),
        ],
    )
    seed: from_field(BakeOptions, "seed", "Seed", "Random seed of the particle positions")
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
    unsaved: StringProperty(description="Temporary folder of bakes until the file is saved")
    estimate: StringProperty(description="Estimated cost of the bake")
    estimate_of: StringProperty(description="Fingerprint of the scene that was estimated")


def _get_body_index(self: "PHYSGEN_PG_scene") -> int:
    """Computed, not stored, so that list and viewport stay in sync."""
    scene, layer = self.id_data, getattr(bpy.context, "view_layer", None)
    active = layer.objects.active if layer is not None and bpy.context.scene == scene else None
    return scene.objects.find(active.name) if active is not None and is_body(active) else -1


def _set_body_index(self: "PHYSGEN_PG_scene", index: int) -> None:
    scene, layer = self.id_data, getattr(bpy.context, "view_layer", None)
    if layer is None or bpy.context.scene != scene or not 0 <= index < len(scene.objects):
        return
    item = scene.objects[index]
    # Objects in an excluded collection cannot be selected.
    if layer.objects.get(item.name) != item or bpy.context.mode != "OBJECT":
        return
    for other in layer.objects.selected:
        other.select_set(False)
    item.select_set(True)
    layer.objects.active = item


class PHYSGEN_PG_scene(bpy.types.PropertyGroup):
    """Properties of a scene; ``Scene.physgen``."""

    folder: StringProperty(
        name="Scene Folder",
        description="Scene folder that this scene was imported from; empty for scenes without a photo",
        subtype="DIR_PATH",
        options=RELATIVE,
    )
    photo_root: PointerProperty(type=bpy.types.Collection)
    """Collection of the import with the photo."""
    body_index: IntProperty(name="Object", description="Active object", get=_get_body_index, set=_set_body_index)
    """Index in ``Scene.objects`` of the active object; -1 if it is not simulated."""
    world: PointerProperty(type=PHYSGEN_PG_world)
    simulation: PointerProperty(type=PHYSGEN_PG_simulation)
    rendering: PointerProperty(type=PHYSGEN_PG_rendering)


def register_scene_properties() -> None:
    """Add ``physgen`` to scenes."""
    bpy.types.Scene.physgen = PointerProperty(type=PHYSGEN_PG_scene)


def unregister_scene_properties() -> None:
    """Remove it; values stored in files are kept."""
    del bpy.types.Scene.physgen


class PHYSGEN_PG_composed_pair(bpy.types.PropertyGroup):
    """Penetration of two objects, before and after; ``name`` is the pair."""

    volume_before: FloatProperty()
    """m³ of intersection."""
    volume_after: FloatProperty()
    share_before: FloatProperty()
    """Of the volume of the yielding object, 0 to 1."""
    share_after: FloatProperty()
    deepest_before: FloatProperty()
    """m"""
    deepest_after: FloatProperty()


class PHYSGEN_PG_compose(bpy.types.PropertyGroup):
    """Settings and last result of Compose Objects; ``Scene.physgen_compose``."""

    method: from_field(
        ComposeOptions,
        "method",
        "Method",
        "What moves the objects",
        items=[
            ("pse-sds", "Picture and Physics", "Match the photo under physical constraints: PhyCAGE"),
            ("ppps", "Physics", "Resolve penetration only. Needs no photo"),
            ("sds", "Picture", "Match the photo only; penetration may remain. For comparison"),
            ("ppps+sds", "In Turns", "Alternate steps of photo and physics. For comparison"),
        ],
    )
    steps: from_field(ComposeOptions, "steps", "Steps", "Number of optimisation steps; fewer are faster", soft_max=1000)
    keep_strain: from_field(
        ComposeOptions,
        "keep_strain",
        "Keep Shape",
        "Shape memory of the yielding objects: 1 like rubber, 0 like dough",
        subtype="FACTOR",
    )
    keep_original: BoolProperty(
        name="Keep Original",
        description=(
            "Add the shape from before as the shape key 'Before Compose': raise its value to blend "
            "back, remove it when done"
        ),
        default=True,
    )
    pairs: CollectionProperty(type=PHYSGEN_PG_composed_pair)


def register_compose_properties() -> None:
    """Add ``physgen_compose`` to scenes."""
    bpy.types.Scene.physgen_compose = PointerProperty(type=PHYSGEN_PG_compose)


def unregister_compose_properties() -> None:
    """Remove it; values stored in files are kept."""
    del bpy.types.Scene.physgen_compose
