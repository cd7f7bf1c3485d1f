# SPDX-License-Identifier: GPL-3.0-or-later
"""What the artist says of an object, in the terms of the scene format."""

from __future__ import annotations

from typing import Any

import bpy

from ...sim.errors import InputError
from ...sim.scene.model import Effect, Material
from ..props.material import get_material
from ..typed import decimal
from .export_units import Clock, scaled

CANNOT_CRUMBLE = ("rigid", "fluid")
"""Laws of matter that no sand comes of."""


def physics(item: bpy.types.Object, unit: float, clock: Clock) -> dict[str, Any]:
    """Fields of ``sim.scene.model.SceneObject`` by name: all but name, mesh, place, motion and pins.

    unit: a Blender unit in metres. Raises InputError, with the object's name, for numbers that cannot be.
    """
    body = item.physgen
    fields: dict[str, Any] = {"role": body.role, **_surface(body)}
    if body.role != "dynamic":
        return fields
    fields["material"] = _material(item)
    fields["fill"] = body.fill
    if not body.fill and body.shell_thickness > 0:
        fields["shell_thickness"] = decimal(body.shell_thickness * unit)
    fields["velocity"] = scaled(body.velocity, unit)
    fields["spin"] = scaled(body.spin)
    fields["start_time"] = clock.from_frame(body.start_frame)
    fields["goal_stiffness"] = decimal(body.goal_stiffness)
    fields["goal_damping"] = decimal(body.goal_damping)
    return fields


def sand(item: bpy.types.Object, name: str, clock: Clock) -> list[Effect]:
    """The effect that lets ``item``, called ``name`` in the folder, collapse; none where it does not."""
    body = item.physgen
    if body.role != "dynamic" or not body.sandy:
        return []
    if body.material.law in CANNOT_CRUMBLE:
        raise InputError(
            f"object {item.name!r}: turns to sand, which {body.material.law} matter cannot: give it an elastic or "
            "plastic behaviour, or switch Turns to Sand off"
        )
    start = clock.from_frame(body.sandy_frame)
    angle = decimal(body.material.friction_angle)
    return [Effect(name="sandy", parameters=(("friction_angle", angle), ("start", start)), objects=(name,))]


def _surface(body: Any) -> dict[str, Any]:
    """Its own numbers; without them the ground's hold."""
    if not body.own_surface:
        return {}
    friction = decimal(body.friction)
    return {
        "friction": friction,
        "static_friction": max(friction, decimal(body.static_friction)),
        "restitution": decimal(body.restitution),
        "contact_mode": body.contact_mode,
    }


def _material(item: bpy.types.Object) -> Material:
    body = item.physgen
    try:
        material = get_material(body.material)
    except InputError as error:
        raise InputError(f"object {item.name!r}: {error}") from None
    if material.law == "rigid" and (len(body.pins) or body.goal_stiffness > 0):
        raise InputError(
            f"object {item.name!r}: is rigid, and rigid objects are neither pinned nor held in shape: choose another "
            "behaviour, remove its pins and Hold Shape, or let it be a collider"
        )
    return material
