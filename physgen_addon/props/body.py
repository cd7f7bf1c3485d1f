# SPDX-License-Identifier: GPL-3.0-or-later
"""What PhysGen knows of an object: its part in the simulation, its matter, and how it begins.

Every field stands for one of ``sim.scene.object.SceneObject`` or ``sim.scene.matter.Material`` of the same name.
Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

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

from ...sim.scene.materials import load_preset, preset_names
from ...sim.scene.matter import Material

CUSTOM = "custom"
LAW_ITEMS = [
    ("fixed_corotated", "Elastic", "Returns to its shape: rubber, jelly, foam, most things"),
    ("neo_hookean", "Elastic, Large Strain", "For matter that is squashed or stretched far beyond its shape"),
    ("von_mises", "Plastic", "Keeps a dent once it is pressed hard enough: clay, metal"),
    ("snow", "Snow", "Packs, crumbles and breaks"),
    ("sand", "Sand", "Dry grains that flow and pile up"),
    ("fluid", "Fluid", "Water, honey"),
    ("rigid", "Rigid", "Moves as one and never changes shape: wood, stone"),
]
NUMBERS = (
    "density",
    "youngs_modulus",
    "poisson_ratio",
    "law",
    "damping_time",
    "yield_stress",
    "friction_angle",
    "critical_compression",
    "critical_stretch",
    "hardening",
    "bulk_modulus",
    "viscosity",
    "fibre_modulus",
    "fibre_axis",
)
"""The fields of ``sim.scene.matter.Material`` that the user may set."""


def _on_preset(self: "PHYSGEN_PG_material", context: bpy.types.Context) -> None:
    if self.preset != CUSTOM:
        set_material(self, load_preset(self.preset))


def _preset_items() -> list[tuple[str, str, str]]:
    items = [(name, name.capitalize(), f"The preset {name}") for name in preset_names()]
    return [*items, (CUSTOM, "Custom", "Numbers of your own")]


def set_material(target: "PHYSGEN_PG_material", material: Material) -> None:
    """Take the numbers of ``material``; its preset's name is not touched."""
    for name in NUMBERS:
        setattr(target, name, getattr(material, name))


def get_material(source: "PHYSGEN_PG_material") -> Material:
    """The matter as the simulation takes it. Raises InputError for a number out of range."""
    values = {name: _number(getattr(source, name)) for name in NUMBERS if name != "fibre_axis"}
    values["fibre_axis"] = tuple(_number(number) for number in source.fibre_axis)
    return Material(preset=source.preset, **values)


def _number(value: float | str) -> float | str:
    """Blender keeps 32 bits: 0.4 comes back as 0.4000000059604645."""
    return float(f"{value:.7g}") if isinstance(value, float) else value


class PHYSGEN_PG_material(bpy.types.PropertyGroup):
    """What an object is made of."""

    preset: EnumProperty(
        name="Material",
        description="Where the numbers come from",
        items=_preset_items(),
        default="medium",
        update=_on_preset,
    )
    law: EnumProperty(name="Behaviour", description="How the matter responds", items=LAW_ITEMS)
    density: FloatProperty(
        name="Density",
        description="Mass per volume in kg/m³: water 1000, wood 500, steel 7800",
        default=1000.0,
        min=1e-3,
        max=3e4,
        soft_min=10.0,
        soft_max=8000.0,
        precision=1,
    )
    youngs_modulus: FloatProperty(
        name="Young's Modulus",
        description="Stiffness in Pa: jelly 2.5e4, soft rubber 1e6. Ten times as stiff takes three times as long",
        default=5e5,
        min=1e2,
        max=1e12,
        soft_max=1e8,
        precision=0,
    )
    poisson_ratio: FloatProperty(
        name="Poisson's Ratio",
        description="How much it bulges sideways when pressed: cork 0, most things 0.3, rubber 0.45",
        default=0.3,
        min=0.0,
        max=0.49,
        precision=3,
    )
    damping_time: FloatProperty(
        name="Damping",
        description="How fast vibrations die away, in seconds: viscosity over stiffness (Kelvin-Voigt). 0 is none",
        min=0.0,
        max=10.0,
        soft_max=0.1,
        precision=4,
        unit="TIME_ABSOLUTE",
    )
    yield_stress: FloatProperty(
        name="Yield Stress",
        description="Tension in Pa above which it keeps its new shape",
        default=1e4,
        min=1.0,
        max=1e12,
        soft_max=1e8,
        precision=0,
    )
    friction_angle: FloatProperty(
        name="Friction Angle",
        description="Of the grains on each other; a heap stays about as steep as this",
        default=0.6,
        min=0.01,
        max=1.4,
        subtype="ANGLE",
    )
    critical_compression: FloatProperty(
        name="Critical Compression",
        description="Strain that snow bears before it packs for good",
        default=0.025,
        min=1e-4,
        max=0.5,
        precision=4,
    )
    critical_stretch: FloatProperty(
        name="Critical Stretch",
        description="Strain that snow bears before it tears",
        default=0.0075,
        min=1e-4,
        max=0.5,
        precision=4,
    )
    hardening: FloatProperty(
        name="Hardening", description="How much stiffer packed snow becomes", default=10.0, min=0.0, max=30.0
    )
    bulk_modulus: FloatProperty(
        name="Bulk Modulus",
        description="Resistance of a fluid to compression in Pa. Real water has 2.2e9; 2e5 is enough here, and faster",
        default=2e5,
        min=10.0,
        max=1e12,
        soft_max=1e7,
        precision=0,
    )
    viscosity: FloatProperty(
        name="Viscosity",
        description="Thickness of a fluid in Pa s: water 0.001, honey 10",
        min=0.0,
        max=1e5,
        soft_max=100.0,
        precision=3,
    )
    fibre_modulus: FloatProperty(
        name="Fibre Modulus",
        description="Stiffness in Pa that fibres add along their axis; 0 for none",
        min=0.0,
        max=1e12,
        soft_max=1e8,
        precision=0,
    )
    fibre_axis: FloatVectorProperty(
        name="Fibre Axis", description="Direction of the fibres at rest", subtype="DIRECTION", default=(0.0, 0.0, 1.0)
    )


class PHYSGEN_PG_pin(bpy.types.PropertyGroup):
    """A box that holds what of the object is inside it."""

    box: PointerProperty(
        name="Box",
        description=(
            "An empty of the kind Cube: what of the object is inside it at the start is held. "
            "Animate the empty to move what it holds"
        ),
        type=bpy.types.Object,
    )


class PHYSGEN_PG_body(bpy.types.PropertyGroup):
    """An object's part in the simulation; ``Object.physgen``."""

    enabled: BoolProperty(name="In Simulation", description="Let the object take part in the simulation")
    source: StringProperty(description="Name of the object in the scene folder that it was imported from")
    cache: StringProperty(description="Name of the object in its bakes, so that it can be renamed")
    role: EnumProperty(
        name="Role",
        description="What the object does",
        items=[
            ("dynamic", "Moves", "Falls, bounces, deforms: it is simulated"),
            ("collider", "Collider", "Stays where it is, or goes where its animation takes it, and others hit it"),
        ],
    )
    material: PointerProperty(type=PHYSGEN_PG_material)
    fill: BoolProperty(
        name="Solid", description="Matter all through the inside; off: a hollow shell that weighs less", default=True
    )
    shell_thickness: FloatProperty(
        name="Wall",
        description="Thickness of a hollow object's wall; 0 chooses the thinnest that the quality resolves",
        min=0.0,
        max=1e3,
        soft_max=0.1,
        unit="LENGTH",
    )
    sandy: BoolProperty(name="Turns to Sand", description="Let the object collapse into sand")
    sandy_frame: IntProperty(
        name="From Frame", description="First frame in which it is sand", default=1, min=0, soft_max=250
    )

    own_surface: BoolProperty(
        name="Own Surface", description="Friction and bounce of its own; off: the same as the ground's"
    )
    friction: FloatProperty(
        name="Friction",
        description="Coulomb's coefficient while sliding: ice 0.03, wood on wood 0.4, rubber 1",
        default=0.4,
        min=0.0,
        max=10.0,
        soft_max=1.5,
    )
    static_friction: FloatProperty(
        name="Static Friction",
        description="Coulomb's coefficient before it slides; never below the sliding one",
        default=0.4,
        min=0.0,
        max=10.0,
        soft_max=1.5,
    )
    restitution: FloatProperty(
        name="Bounce",
        description="Speed after over speed before an impact of rigid objects",
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    contact_mode: EnumProperty(
        name="Contact",
        description="How it meets others",
        items=[
            ("separate", "Rub", "Slides with friction, is free to leave"),
            ("slip", "Slip", "Slides without friction and does not leave"),
            ("sticky", "Stick", "Neither slides nor leaves"),
        ],
    )

    velocity: FloatVectorProperty(
        name="Velocity",
        description="Velocity at the start. Drag the arrow in the viewport",
        subtype="VELOCITY",
        unit="VELOCITY",
        soft_min=-10.0,
        soft_max=10.0,
    )
    spin: FloatVectorProperty(
        name="Spin",
        description="Turning at the start in radians a second about the centre of mass; one turn a second is 6.28",
        subtype="XYZ",
        soft_min=-50.0,
        soft_max=50.0,
    )
    start_frame: IntProperty(
        name="Starts at Frame",
        description="Until then it stays where it is and touches nothing. 0: with the simulation",
        default=0,
        min=0,
        soft_max=250,
    )
    pins: CollectionProperty(type=PHYSGEN_PG_pin)
    pin_index: IntProperty(name="Pin", description="The chosen pin")
    goal_stiffness: FloatProperty(
        name="Hold Shape",
        description="Pull of all its matter back to its place, acceleration over distance in 1/s²; 0 is none",
        min=0.0,
        max=1e6,
        soft_max=1000.0,
    )
    goal_damping: FloatProperty(
        name="Hold Damping",
        description="Share of critical damping of that pull",
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )


CLASSES = (PHYSGEN_PG_material, PHYSGEN_PG_pin, PHYSGEN_PG_body)


def register() -> None:
    """Let every object have a ``physgen``."""
    bpy.types.Object.physgen = PointerProperty(type=PHYSGEN_PG_body)


def unregister() -> None:
    """Take it away again; what a file has stored stays stored."""
    del bpy.types.Object.physgen


def bodies(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The objects of ``scene`` that take part, in the order of their names."""
    found = [item for item in scene.objects if item.type == "MESH" and item.physgen.enabled]
    return sorted(found, key=lambda item: item.name)
