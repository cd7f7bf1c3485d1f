# SPDX-License-Identifier: GPL-3.0-or-later
"""What an object is made of, and where the numbers come from.

Every field stands for one of ``sim.scene.matter.Material`` of the same name.
Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

import math

import bpy
from bpy.props import EnumProperty, FloatProperty, FloatVectorProperty, StringProperty

from ...sim.scene.matter import Material
from ..typed import decimal
from . import presets
from .presets import CUSTOM

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

_SOLID = ("youngs_modulus", "poisson_ratio")
LAW_FIELDS = {
    "fixed_corotated": (*_SOLID, "damping_time", "fibre_modulus", "fibre_axis"),
    "neo_hookean": (*_SOLID, "damping_time", "fibre_modulus", "fibre_axis"),
    "von_mises": (*_SOLID, "yield_stress", "damping_time"),
    "snow": (*_SOLID, "critical_compression", "critical_stretch", "hardening", "damping_time"),
    "sand": (*_SOLID, "friction_angle"),
    "fluid": ("bulk_modulus", "viscosity"),
    "rigid": (),
}
"""Which numbers besides the density count for a law; the others are kept and do nothing."""


def _preset_items(
    self: "PHYSGEN_PG_material", context: bpy.types.Context | None
) -> list[tuple[str, str, str, str, int]]:
    return presets.items(self.preset_name)


def _get_preset(self: "PHYSGEN_PG_material") -> int:
    return next(item[4] for item in presets.items(self.preset_name) if item[0] == self.preset_name)


def _set_preset(self: "PHYSGEN_PG_material", number: int) -> None:
    """Kept by name, because the place in the menu differs between computers; a broken one changes nothing."""
    name = presets.items(self.preset_name)[number][0]
    preset = presets.find(name)
    if preset is not None:
        set_material(self, preset)
    if preset is not None or name == CUSTOM:
        self.preset_name = name


def set_material(target: "PHYSGEN_PG_material", material: Material) -> None:
    """Take the numbers of ``material``; its preset's name is not touched."""
    for name in NUMBERS:
        setattr(target, name, getattr(material, name))


def get_material(source: "PHYSGEN_PG_material") -> Material:
    """The matter as the simulation takes it. Raises InputError for a number out of range."""
    values = {name: decimal(getattr(source, name)) for name in NUMBERS if name not in ("law", "fibre_axis")}
    axis = tuple(decimal(number) for number in source.fibre_axis)
    return Material(preset=source.preset, law=source.law, fibre_axis=axis, **values)


def is_modified(source: "PHYSGEN_PG_material") -> bool:
    """Whether a number differs from those of the preset; not of "custom" and of presets that are not here."""
    preset = presets.find(source.preset_name)
    return preset is not None and any(not _same(getattr(source, n), getattr(preset, n)) for n in NUMBERS)


def _same(mine: object, theirs: object) -> bool:
    if isinstance(theirs, tuple):
        return all(_same(a, b) for a, b in zip(mine, theirs, strict=True))  # type: ignore[call-overload]
    # Blender keeps 32 bits.
    return math.isclose(mine, theirs, rel_tol=1e-6) if isinstance(theirs, float) else mine == theirs  # type: ignore[arg-type]


class PHYSGEN_PG_material(bpy.types.PropertyGroup):
    """What an object is made of."""

    preset: EnumProperty(
        name="Material",
        description="Where the numbers come from. Choosing one sets them all",
        items=_preset_items,
        get=_get_preset,
        set=_set_preset,
    )
    preset_name: StringProperty(default="medium")
    """What ``preset`` shows; also when there is no such preset on this computer."""
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
        name="Stiffness",
        description="Young's modulus in Pa: jelly 2.5e4, soft rubber 1e6. Ten times as stiff takes three times as long",
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
        name="Compression",
        description="Strain that snow bears before it packs for good",
        default=0.025,
        min=1e-4,
        max=0.5,
        precision=4,
    )
    critical_stretch: FloatProperty(
        name="Stretch",
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
