# SPDX-License-Identifier: GPL-3.0-or-later
"""Material properties of an object, and the presets they come from."""

import dataclasses
import math
import zlib
from pathlib import Path
from typing import Any

import bpy
from bpy.props import EnumProperty, StringProperty

from ...sim.constitutive import models
from ...sim.errors import InputError
from ...sim.scene.material import PRESET_FOLDER, Material, PresetFolder, read_presets
from .. import paths
from ..text import DENSITY, PRESSURE, VISCOSITY, Units, decimal, readable
from .generated_properties import from_field, switch, with_unit

CUSTOM = "custom"
_SHIPPED = read_presets(PRESET_FOLDER)

_own = PresetFolder()
_read_at: list[tuple[str, int]] = []
_items: dict[tuple[str, str], tuple[str, str, str, str, int]] = {}
"""Keeps the strings of a dynamic enum alive, which Blender does not."""


def own_folder(*, create: bool = False) -> Path:
    """Return the folder of user presets. Raises InputError if it cannot be created."""
    return paths.user_folder("materials", create=create)


def own_presets() -> PresetFolder:
    """Return the user presets, reread when a file was added or removed."""
    global _own
    try:
        folder = own_folder()
        stamp = [(str(folder), folder.stat().st_mtime_ns)]
    except (OSError, InputError):
        _own, _read_at[:] = PresetFolder(), []
        return _own
    if stamp != _read_at:
        _own, _read_at[:] = _without_shipped(read_presets(folder)), stamp
    return _own


def _without_shipped(found: PresetFolder) -> PresetFolder:
    for name in set(found.good) & set(_SHIPPED.good):
        del found.good[name]
        found.broken[name] = "PhysGen brings a preset of the same name; rename the file"
    return found


def forget_presets() -> None:
    """Reread the files at the next access."""
    _read_at.clear()


def find_preset(name: str) -> Material | None:
    """Return the preset ``name``; None for "custom", a broken one and one missing on this computer."""
    return _SHIPPED.good.get(name) or own_presets().good.get(name)


def preset_items(chosen: str, likeness: str = "") -> list[tuple[str, str, str, str, int]]:
    """Return the menu's entries, numbered by position; ``chosen`` is included even if missing.

    likeness: preset that recognised numbers come from, which then names the entry for numbers of no preset.
    """
    own = own_presets()
    rows = [(*item, "NONE") for item in shipped_items()]
    rows += [(name, name, own.descriptions[name] or "User preset", "USER") for name in own.good]
    # The colon is in no valid name, so that a broken file never stands in for a preset.
    rows += [(f"broken:{name}", f"{name} (broken)", f"Unusable: {why}", "ERROR") for name, why in own.broken.items()]
    rows.append((CUSTOM, own_title(likeness), "Numbers of no preset, such as those that a photo's object got", "NONE"))
    if chosen not in (row[0] for row in rows):
        rows.append((chosen, f"{chosen} (missing)", "Not on this computer; the object keeps its values", "ERROR"))
    return [_items.setdefault((row[0], repr((row, index))), (*row, index)) for index, row in enumerate(rows)]


TITLES = {
    "hard": "Plastic (hard)",
    "medium": "Rubber (medium)",
    "soft": "Fabric (soft)",
    CUSTOM: "Own Values",
}
"""Display names of presets whose own name says no material."""


def preset_title(name: str) -> str:
    """Return the display name of the preset ``name``."""
    return TITLES.get(name) or (name.capitalize() if name in _SHIPPED.good else name)


def shipped_items() -> list[tuple[str, str, str]]:
    """Return the shipped presets as entries of a menu, in the order of their titles."""
    names = sorted(_SHIPPED.good, key=preset_title)
    return [(name, preset_title(name), _SHIPPED.descriptions[name]) for name in names]


def own_title(likeness: str) -> str:
    """Return the display name of numbers of no preset, such as ``Like Plastic (hard)`` where they were recognised."""
    return f"Like {preset_title(likeness)}" if likeness else preset_title(CUSTOM)


def _summary(model: type) -> str:
    return (model.__doc__ or "").splitlines()[0].rstrip(".")


_STORED_NUMBERS = ("fixed_corotated", "neo_hookean", "von_mises", "snow", "sand", "fluid", "rigid")
"""Laws by their number in .blend files; any other law is stored by the CRC of its name."""


def _law_item(law: str, label: str, hint: str) -> tuple[str, str, str, str, int]:
    number = _STORED_NUMBERS.index(law) if law in _STORED_NUMBERS else zlib.crc32(law.encode()) >> 1
    return law, label, hint, "NONE", number


LAW_ITEMS = [
    *(_law_item(model.law, model.label or readable(model.law), model.hint or _summary(model)) for model in models()),
    _law_item("rigid", "Rigid", "Never deforms: wood, stone"),
]
"""Menu of constitutive models."""

STARTS_AS = "medium"
"""Preset of a new object; its numbers are the defaults of the properties."""


def _from_medium(field: str, name: str, description: str = "", **arguments: Any) -> Any:
    """Return the property of a field of ``Material`` with the number of the preset that a new object has."""
    start = {"default": getattr(_SHIPPED.good[STARTS_AS], field)}
    return from_field(Material, field, name, description, **{**start, **arguments})


NUMBERS = tuple(field.name for field in dataclasses.fields(Material) if field.name != "preset")
"""Fields of ``sim.scene.material.Material`` that the user can set."""

ADVANCED = ("relaxing_share", "relaxation_time", "fibre_modulus", "fibre_axis")
"""Fields that few change."""

LAW_FIELDS = {
    "rigid": ("rigid_restitution",),
    **{model.law: tuple(name for name in model.reads if name not in model.hidden) for model in models()},
}
"""Fields besides the density that a constitutive model uses; the others are stored without effect."""


def _preset_items(
    self: "PHYSGEN_PG_material", context: bpy.types.Context | None
) -> list[tuple[str, str, str, str, int]]:
    return preset_items(self.preset_name, self.likeness)


def _get_preset(self: "PHYSGEN_PG_material") -> int:
    return next(item[4] for item in preset_items(self.preset_name) if item[0] == self.preset_name)


def _set_preset(self: "PHYSGEN_PG_material", number: int) -> None:
    """Store the name, because positions in the menu differ between computers; a broken preset changes nothing."""
    name = preset_items(self.preset_name)[number][0]
    preset = find_preset(name)
    if preset is not None:
        set_material(self, preset)
    if preset is not None or name == CUSTOM:
        self.preset_name = name


def set_material(target: "PHYSGEN_PG_material", material: Material) -> None:
    """Set the values of ``material``; the preset's name is unchanged."""
    for name in NUMBERS:
        setattr(target, name, getattr(material, name))


def get_material(source: "PHYSGEN_PG_material") -> Material:
    """Return the material as simulated. Raises InputError for a value out of range."""
    values = {name: decimal(getattr(source, name)) for name in NUMBERS if name not in ("law", "fibre_axis")}
    x, y, z = (decimal(number) for number in source.fibre_axis)
    return Material(preset=source.preset, law=source.law, fibre_axis=(x, y, z), **values)


def is_modified(source: "PHYSGEN_PG_material") -> bool:
    """Return whether a value differs from the preset's; False for "custom" and missing presets."""
    preset = find_preset(source.preset_name)
    return preset is not None and any(not _same(getattr(source, n), getattr(preset, n)) for n in NUMBERS)


def _same(mine: object, theirs: object) -> bool:
    if isinstance(theirs, tuple):
        return all(_same(a, b) for a, b in zip(mine, theirs, strict=True))  # type: ignore[call-overload]
    # Blender stores 32 bits.
    return math.isclose(mine, theirs, rel_tol=1e-6) if isinstance(theirs, float) else mine == theirs  # type: ignore[arg-type]


class PHYSGEN_PG_material(bpy.types.PropertyGroup):
    """Material of an object."""

    preset: EnumProperty(
        name="Material",
        description="Source of the values. Choosing a preset sets them all",
        items=_preset_items,
        get=_get_preset,
        set=_set_preset,
    )
    preset_name: StringProperty(default=STARTS_AS)
    """Shown by ``preset``; also if there is no such preset on this computer."""
    likeness: StringProperty(description="Preset from which the numbers of a recognised object were derived")
    law: _from_medium("law", "Behaviour", "Constitutive model", items=LAW_ITEMS)
    density: _from_medium(
        "density",
        "Density",
        "Mass per volume in kg/m³: water 1000, wood 500, steel 7800",
        min=1e-3,
        soft_min=10.0,
        soft_max=8000.0,
        precision=1,
    )
    youngs_modulus: _from_medium(
        "youngs_modulus",
        "Stiffness",
        "Young's modulus: jelly 25 kPa, soft rubber 1 MPa. Ten times as stiff takes three times as long",
        soft_max=1e8,
        precision=0,
    )
    poisson_ratio: _from_medium(
        "poisson_ratio",
        "Poisson's Ratio",
        "Lateral bulging under compression: cork 0, most materials 0.3, rubber 0.45",
        precision=3,
    )
    damping_time: _from_medium(
        "damping_time",
        "Damping",
        "Damping time: viscosity over stiffness (Kelvin-Voigt)",
        soft_max=0.1,
        precision=4,
    )
    relaxing_share: _from_medium(
        "relaxing_share",
        "Relaxing Share",
        "Stiffness that gives way with time, over the lasting one: rubber 0.1, plush 2",
        soft_max=5.0,
        precision=2,
    )
    relaxes: switch("relaxing_share", "Gives Way", "A part of the stiffness gives way with time: it bounces less", 0.5)
    relaxation_time: _from_medium(
        "relaxation_time",
        "Relaxation Time",
        "Seconds in which the relaxing part gives way",
        soft_max=1.0,
        precision=4,
    )
    rigid_restitution: _from_medium(
        "rigid_restitution",
        "Bounce",
        "Speed after over speed before an impact on hard things, where surfaces say none",
        precision=2,
        subtype="FACTOR",
    )
    yield_stress: _from_medium(
        "yield_stress",
        "Yield Stress",
        "Stress above which deformation is permanent",
        soft_max=1e8,
        precision=0,
    )
    friction_angle: _from_medium(
        "friction_angle", "Friction Angle", "Internal friction angle; about the slope of a heap"
    )
    critical_compression: _from_medium(
        "critical_compression",
        "Compression",
        "Compressive strain above which snow packs permanently",
        precision=4,
        subtype="FACTOR",
    )
    critical_stretch: _from_medium(
        "critical_stretch", "Stretch", "Tensile strain above which snow tears", precision=4, subtype="FACTOR"
    )
    hardening: _from_medium("hardening", "Hardening", "Stiffening of packed snow")
    bulk_modulus: _from_medium(
        "bulk_modulus",
        "Bulk Modulus",
        "Bulk modulus of a fluid. Real water has 2.2 GPa; 200 kPa is enough here, and faster",
        soft_max=1e7,
        precision=0,
    )
    viscosity: _from_medium(
        "viscosity",
        "Viscosity",
        "Dynamic viscosity: water 1 mPa s, honey 10 Pa s",
        soft_max=100.0,
        precision=3,
    )
    fibre_modulus: _from_medium(
        "fibre_modulus",
        "Fibre Modulus",
        "Stiffness that fibres add along their axis",
        soft_max=1e8,
        precision=0,
    )
    has_fibres: switch("fibre_modulus", "Fibres", "Fibres make it stiffer along their axis", 1e6)
    fibre_axis: _from_medium("fibre_axis", "Fibre Axis", "Direction of the fibres at rest", subtype="DIRECTION")


WITH_UNITS = {
    "density": DENSITY,
    "youngs_modulus": PRESSURE,
    "yield_stress": PRESSURE,
    "bulk_modulus": PRESSURE,
    "fibre_modulus": PRESSURE,
    "viscosity": VISCOSITY,
}
"""Fields of kinds that Blender's properties have no unit for → units; ``shown_as(field)`` shows one with its unit."""


def shown_as(field: str) -> str:
    """Return the name of the property that shows ``field`` with its unit."""
    return f"{field}_shown"


def _shown(field: str, units: Units) -> Any:
    # A deferred property: its arguments are those of the call.
    given = PHYSGEN_PG_material.__annotations__[field].keywords
    return with_unit(field, given["name"], f"{given['description']}. Any unit may be typed", units)


PHYSGEN_PG_material.__annotations__.update({shown_as(name): _shown(name, kind) for name, kind in WITH_UNITS.items()})

# Parameters that a constitutive model adds to the material.
PHYSGEN_PG_material.__annotations__.update(
    {p.name: _from_medium(p.name, readable(p.name)) for model in models() for p in model.parameters}
)
