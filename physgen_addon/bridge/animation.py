# SPDX-License-Identifier: GPL-3.0-or-later
"""What moves by itself in Blender: keyframes, NLA strips, drivers, constraints, parents. Nothing is evaluated here."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

TRANSFORM = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")
"""Properties of an object or bone that place it."""

PLACING = (*TRANSFORM, "delta_location", "delta_rotation_euler", "delta_rotation_quaternion", "delta_scale")
"""Properties of an object whose animation moves it."""

Channel = tuple[str, int]
"""A property's path and index, as of an animation curve."""


def curves(owner: bpy.types.ID) -> Iterator[bpy.types.FCurve]:
    """The animation curves that act on ``owner``: of its action and of its NLA strips; muted ones do not."""
    data = owner.animation_data
    if data is None:
        return
    yield from _curves(data.action, data.action_slot)
    for track in data.nla_tracks:
        if not track.mute:
            for strip in track.strips:
                if not strip.mute:
                    yield from _curves(strip.action, strip.action_slot)


def _curves(action: bpy.types.Action | None, slot: bpy.types.ActionSlot | None) -> Iterator[bpy.types.FCurve]:
    if action is None or slot is None:
        return
    for layer in action.layers:
        for strip in layer.strips:
            bag = strip.channelbag(slot)
            if bag is not None:
                yield from (curve for curve in bag.fcurves if not curve.mute)


def drivers(owner: bpy.types.ID) -> list[bpy.types.FCurve]:
    """The drivers on properties of ``owner``."""
    data = owner.animation_data
    return [] if data is None else [curve for curve in data.drivers if not curve.mute]


def channels(owner: bpy.types.ID) -> set[Channel]:
    """Which properties of ``owner`` are animated or driven."""
    return {(curve.data_path, curve.array_index) for curve in (*curves(owner), *drivers(owner))}


def why_it_moves(item: bpy.types.Object) -> str | None:
    """What could move ``item``, as the end of a sentence about it; None when it stands still.

    Constraints count even where they hold still: what they do is not looked at.
    """
    animated = sorted({curve.data_path for curve in curves(item) if curve.data_path in PLACING})
    if animated:
        return f"is animated ({', '.join(animated)})"
    driven = sorted({curve.data_path for curve in drivers(item) if curve.data_path in PLACING})
    if driven:
        return f"is driven ({', '.join(driven)})"
    for constraint in item.constraints:
        if constraint.enabled and not constraint.mute:
            return f"has the constraint {constraint.name!r}"
    if item.rigid_body is not None and item.rigid_body.type == "ACTIVE":
        return "is an active part of Blender's rigid body simulation"
    parent = item.parent
    if parent is None:
        return None
    if item.parent_type != "OBJECT":
        return f"hangs on a part of {parent.name!r} ({item.parent_type.lower()})"
    reason = why_it_moves(parent)
    return None if reason is None else f"is parented to {parent.name!r}, which {reason}"
