# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether PhysGen's own settings have changed: Blender tells of changes to its own data, and not of an add-on's."""

from __future__ import annotations

import functools
from typing import Any

import bpy

from .props.body import bodies

IGNORED = {"rna_type", "name", "bake", "cache", "unsaved", "estimate", "estimate_of", "body_index", "effect_index"}
"""Properties that say nothing of a motion; the bake is looked at by other means."""


def settings(scene: bpy.types.Scene) -> int:
    """A number that changes with the settings of ``scene`` and its bodies; about 0.1 ms a body."""
    world, simulation = _values(scene.physgen.world), _values(scene.physgen.simulation)
    return hash((world, simulation, *((item.name, _values(item.physgen)) for item in bodies(scene))))


def _values(group: bpy.types.PropertyGroup) -> tuple[Any, ...]:
    return tuple(_value(getattr(group, name), kind) for name, kind in _properties(type(group)))


def _value(value: Any, kind: str) -> Any:
    if kind == "COLLECTION":
        return tuple(_values(item) for item in value)
    if kind == "ARRAY":
        return tuple(value)
    if kind == "POINTER":
        return _values(value) if isinstance(value, bpy.types.PropertyGroup) else getattr(value, "name", None)
    return value


@functools.cache
def _properties(group: type[bpy.types.PropertyGroup]) -> list[tuple[str, str]]:
    return [
        (prop.identifier, "ARRAY" if getattr(prop, "is_array", False) else prop.type)
        for prop in group.bl_rna.properties
        if prop.identifier not in IGNORED
    ]
