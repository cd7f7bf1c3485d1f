# SPDX-License-Identifier: GPL-3.0-or-later
"""What a preview depends on: numbers, which the worker is told as they change, and shapes, which are exported anew."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import bpy

from ...sim.errors import InputError
from ...sim.scene.json_fields import to_json
from ..bridge.animation import channels
from ..bridge.export_meshes import read_points
from ..bridge.export_names import export_names
from ..bridge.export_objects import physics
from ..bridge.export_units import clock, metres_per_unit
from ..bridge.export_world import effects, gravity
from ..props.body import bodies
from ..typed import decimal

UNSET = ("friction", "static_friction", "restitution", "contact_mode", "shell_thickness")
"""Fields of an object that are left out where the artist has not set them."""


def numbers(scene: bpy.types.Scene) -> tuple[str, ...]:
    """All numbers that the worker can be told without a new export, as overrides of the exported scene.

    Raises InputError where one of them cannot be.
    """
    unit, times, names = metres_per_unit(scene), clock(scene), export_names(scene)
    found = []
    for item in bodies(scene):
        fields: dict[str, Any] = {**dict.fromkeys(UNSET), **physics(item, unit, times)}
        fields.pop("role")
        material = fields.pop("material", None)
        if material is not None:
            fields |= {name: value for name, value in to_json(material).items() if name != "preset"}
        found += [f"{names[item.name]}.{name}={json.dumps(to_json(value))}" for name, value in fields.items()]
    world = scene.physgen.world
    if world.use_ground:
        friction = decimal(world.friction)
        static = max(friction, decimal(world.static_friction))
        found += [f"ground.friction={friction}", f"ground.static_friction={static}"]
        found.append(f"ground.restitution={decimal(world.restitution)}")
    if not {path for path, _ in channels(scene)} & {"gravity", "use_gravity"}:
        found.append(f"scene.gravity={json.dumps(gravity(scene, unit))}")
    return tuple(found)


def shapes(scene: bpy.types.Scene) -> str:
    """A hash of the rest that people change while they look at a preview: meshes, places, roles, pins, effects.

    What only an animation moves does not count; switching the preview off and on exports everything anew.
    """
    digest = hashlib.sha256()
    world = scene.physgen.world
    known: list[Any] = [metres_per_unit(scene), world.use_ground, tuple(world.ground_point), tuple(world.ground_normal)]
    known += _place(world.ground_object)
    try:
        known.append(to_json(effects(scene, export_names(scene))))
    except InputError as error:
        known.append(str(error))
    for item in bodies(scene):
        body = item.physgen
        known += [item.name, body.role, body.sandy, body.sandy_frame, *_place(item)]
        for pin in body.pins:
            known += _place(pin.box)
        if not item.data.is_editmode:
            known += [len(item.data.vertices), len(item.data.loops)]
            digest.update(read_points(item.data))
        known += [(modifier.name, modifier.show_viewport) for modifier in item.modifiers]
    digest.update(repr(known).encode())
    return digest.hexdigest()


def _place(item: bpy.types.Object | None) -> list[Any]:
    if item is None:
        return [None]
    moving = {path for path, _ in channels(item)}
    own = [name for name in ("location", "rotation_euler", "rotation_quaternion", "scale") if name not in moving]
    return [item.name, item.parent.name if item.parent else "", *(tuple(getattr(item, name)) for name in own)]
