# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender properties generated from fields of the scene's dataclasses: type, default, range and unit are theirs."""

import dataclasses
import math
import types
import typing
from collections.abc import Callable
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty, IntProperty, StringProperty

from ..text import Units, quantity, typed_quantity

UNITS = {
    "metres": {"unit": "LENGTH"},
    "radians": {"subtype": "ANGLE"},
    "degrees": {"subtype": "ANGLE"},
    "seconds": {"unit": "TIME_ABSOLUTE"},
}
"""Unit of a field → arguments of its property. Blender has no units for the others, and stores angles in radians."""

TYPES = {bool: BoolProperty, float: FloatProperty, int: IntProperty, str: EnumProperty, tuple: FloatVectorProperty}


def from_field(kind: type, field: str, name: str, description: str = "", **arguments: Any) -> Any:
    """Return the Blender property of the field ``field`` of the dataclass ``kind``, labelled ``name``.

    description: tooltip; by default the field's ``--help`` text. arguments: of the property; they override those that
    follow from the field, such as a default for None. A text field needs ``items``.
    """
    spec: dataclasses.Field[Any] = kind.__dataclass_fields__[field]  # type: ignore[attr-defined]
    low, high = spec.metadata.get("range", (-math.inf, math.inf))
    own: dict[str, Any] = {"name": name, "description": description or help_text(kind, field)}
    own |= UNITS.get(spec.metadata.get("unit", ""), {})
    scale: Callable[[Any], Any] = math.radians if spec.metadata.get("unit") == "degrees" else _unscaled
    own |= {key: scale(limit) for key, limit in (("min", low), ("max", high)) if math.isfinite(limit)}
    if spec.default is not None:
        own["default"] = scale(spec.default)
    return TYPES[_type(kind, field)](**(own | arguments))


def switch(field: str, name: str, description: str, on: float) -> Any:
    """Return a checkbox that is off where the number ``field`` of its group is 0, and sets it to ``on``.

    Nothing is stored besides the number, of which 0 means "automatic" or "none".
    """

    def get(self: Any) -> bool:
        return bool(getattr(self, field))

    def put(self: Any, wanted: bool) -> None:
        if wanted != get(self):
            setattr(self, field, on if wanted else 0)

    return BoolProperty(name=name, description=description, get=get, set=put)


def with_unit(field: str, name: str, description: str, units: Units) -> Any:
    """Return a field that shows the number ``field`` of its group with its unit, and takes one with any of ``units``.

    Nothing is stored besides the number, which is clamped to its own range; words that name no number change nothing.
    """

    def get(self: Any) -> str:
        scene = getattr(bpy.context, "scene", None)
        return quantity(getattr(self, field), units, scene.unit_settings.system if scene is not None else "METRIC")

    def put(self: Any, words: str) -> None:
        shown = get(self)
        # Four digits are shown: what was only looked at keeps the others.
        value = None if words == shown else typed_quantity(words, units, shown)
        if value is not None:
            setattr(self, field, value)

    return StringProperty(name=name, description=description, get=get, set=put)


def percentage(field: str, name: str, description: str, *, low: float = 0.0, high: float = 100.0) -> Any:
    """Return a slider in per cent, ``low`` to ``high``, of the number ``field`` of its group, which alone is stored."""

    def get(self: Any) -> float:
        return 100.0 * float(getattr(self, field))

    def put(self: Any, shown: float) -> None:
        setattr(self, field, shown / 100.0)

    return FloatProperty(
        name=name,
        description=description,
        subtype="PERCENTAGE",
        min=low,
        max=high,
        soft_max=min(high, 100.0),
        precision=0,
        get=get,
        set=put,
    )


def _unscaled(value: Any) -> Any:
    return value


def help_text(kind: type, field: str) -> str:
    """Return the ``--help`` text of a field as a tooltip."""
    text: str = kind.__dataclass_fields__[field].metadata.get("help", "")  # type: ignore[attr-defined]
    return text[:1].upper() + text[1:]


def _type(kind: type, field: str) -> type:
    """Return the type of a field; of ``float | None``, float; of ``tuple[float, ...]``, tuple."""
    hint = typing.get_type_hints(kind)[field]
    if isinstance(hint, types.UnionType):
        hint = next(part for part in typing.get_args(hint) if part is not type(None))
    return typing.get_origin(hint) or hint
