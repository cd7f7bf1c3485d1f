# SPDX-License-Identifier: GPL-3.0-or-later
"""What an artist has changed of an imported scene's physics, carried over to the next import of the same photo.

What was imported is remembered beside the objects. What differs from it later was changed by hand and stays; the rest
becomes what the new reconstruction says. Objects are known by their names in the scene folder.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bpy

from .props.body import bodies
from .props.material import NUMBERS

Fields = dict[str, Any]

_KEY = "physgen_imported"
"""Custom property of the import's collection."""
_SURFACE = ("friction", "static_friction", "restitution")
"""In this order: a new friction sets the static one as well."""
OF_BODY = (
    ("role",),
    ("fill", "shell_thickness"),
    ("sandy", "sandy_frame"),
    ("own_surface", "contact_mode", *_SURFACE),
    ("velocity",),
    ("spin",),
    ("start_frame",),
    ("goal_stiffness", "goal_damping"),
    ("splats_as",),
)
"""Fields of a body; those that say one thing together stay together."""
OF_MATERIAL = (("preset_name", *NUMBERS),)
OF_WORLD = (("use_ground",), _SURFACE)
OF_SCENE = (("use_gravity", "gravity"),)


def remember(scene: bpy.types.Scene, photo: Path) -> None:
    """Note what was imported just now, which was made of ``photo``."""
    scene.physgen.photo_root[_KEY] = json.dumps({"photo": str(photo), "fields": _all(scene)})


def changes(scene: bpy.types.Scene, photo: Path) -> Fields:
    """What is not as it was imported, for ``restore``; empty unless the import is remembered to be of ``photo``."""
    root = scene.physgen.photo_root
    if root is None or _KEY not in root:
        return {}
    noted = json.loads(root[_KEY])
    if noted["photo"] != str(photo):
        return {}
    before, now = noted["fields"], _all(scene)
    return {what: value for what, value in now.items() if what in before and before[what] != value}


def restore(scene: bpy.types.Scene, changed: Fields) -> None:
    """Put ``changed`` into the objects of the same names; what is about others is gone with them."""
    for what, value in changed.items():
        owner, _, field = what.partition("/")
        target = _owner(scene, owner)
        if target is None:
            continue
        if field == "pins":
            _set_pins(scene, target, value)
        elif field == "effects":
            _set_effects(scene, target, value)
        else:
            for name, one in zip(field.split(","), value, strict=True):
                setattr(target, name, one)


def _all(scene: bpy.types.Scene) -> Fields:
    """Everything that can be kept, by ``OWNER/FIELDS``."""
    found: Fields = {}
    world = scene.physgen.world
    for item in bodies(scene):
        if item.physgen.source:
            name = item.physgen.source
            found |= _read(f"body:{name}", item.physgen, OF_BODY)
            found |= _read(f"material:{name}", item.physgen.material, OF_MATERIAL)
            found[f"body:{name}/pins"] = [pin.box.name for pin in item.physgen.pins if pin.box is not None]
    found |= _read("world", world, OF_WORLD) | _read("scene", scene, OF_SCENE)
    found["world/effects"] = [_effect(entry) for entry in world.effects]
    return found


def _read(owner: str, data: Any, units: tuple[tuple[str, ...], ...]) -> Fields:
    return {f"{owner}/{','.join(names)}": [_plain(getattr(data, name)) for name in names] for names in units}


def _plain(value: Any) -> Any:
    return value if isinstance(value, bool | int | float | str) else list(value)


def _effect(entry: Any) -> Fields:
    return {
        "effect": entry.effect,
        "enabled": entry.enabled,
        "parameters": {number.name: number.value for number in entry.parameters},
        "targets": [_reference(target.item) for target in entry.targets if target.item is not None],
    }


def _reference(item: bpy.types.Object) -> list[str]:
    """How to find ``item`` again after the next import, which makes objects anew."""
    return ["source", item.physgen.source] if item.physgen.source else ["object", item.name]


def _owner(scene: bpy.types.Scene, owner: str) -> Any:
    kind, _, name = owner.partition(":")
    if kind in ("world", "scene"):
        return scene.physgen.world if kind == "world" else scene
    item = _of_source(scene, name)
    if item is None:
        return None
    return item.physgen if kind == "body" else item.physgen.material


def _of_source(scene: bpy.types.Scene, name: str) -> bpy.types.Object | None:
    return next((item for item in bodies(scene) if item.physgen.source == name), None)


def _set_pins(scene: bpy.types.Scene, body: Any, names: list[str]) -> None:
    body.pins.clear()
    for name in names:
        if name in scene.objects:
            body.pins.add().box = scene.objects[name]


def _set_effects(scene: bpy.types.Scene, world: Any, entries: list[Fields]) -> None:
    world.effects.clear()
    for told in entries:
        targets = [
            _of_source(scene, name) if kind == "source" else scene.objects.get(name) for kind, name in told["targets"]
        ]
        if told["targets"] and not any(targets):
            # Without its objects it would act on all.
            continue
        entry = world.effects.add()
        entry.effect, entry.enabled = told["effect"], told["enabled"]
        entry.parameters.clear()
        for name, value in told["parameters"].items():
            number = entry.parameters.add()
            number.name, number.value = name, value
        for item in targets:
            if item is not None:
                entry.targets.add().item = item
