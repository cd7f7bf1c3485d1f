# SPDX-License-Identifier: GPL-3.0-or-later
"""The physics of a scene folder into the fields of ``Object.physgen`` and ``Scene.physgen``, and into keyframes.

The inverse of the export. What Blender has no field for is told, never dropped without a word.
"""

from __future__ import annotations

import itertools
import math

import bpy
import numpy as np
from mathutils import Quaternion, Vector

from ...sim.effects.registry import effect
from ...sim.scene.control import Box, Keys, Motion
from ...sim.scene.matter import Material
from ...sim.scene.model import Ground, Scene, SceneObject
from ..props import presets
from ..props.material import is_modified, set_material
from . import compat
from .bounds import box_corners

MAX_GRAVITY = 200.0
"""Strongest gravity that Blender keeps, along each axis, m/s²."""


def fill(
    scene: bpy.types.Scene,
    collection: bpy.types.Collection,
    source: Scene,
    items: list[bpy.types.Object],
    ground: bpy.types.Object,
) -> list[str]:
    """Fill all fields; pins become empties in ``collection``. Sentences: what could not be taken over."""
    notes: list[str] = []
    _fill_world(scene, source, ground, notes)
    for item, body in zip(items, source.objects, strict=True):
        fill_body(scene, collection, item, body, source.ground, notes)
    _fill_effects(scene, source, items, notes)
    if source.contacts:
        pairs = ", ".join(" and ".join(contact.between) for contact in source.contacts)
        notes.append(f"the contact of {pairs} has numbers of its own in the folder; Blender has a surface an object")
    return notes


def _fill_world(scene: bpy.types.Scene, source: Scene, ground: bpy.types.Object, notes: list[str]) -> None:
    world = scene.physgen.world
    scene.use_gravity, scene.gravity = True, source.gravity
    if max(map(abs, source.gravity)) > MAX_GRAVITY:
        notes.append(f"gravity is {math.hypot(*source.gravity):g} m/s² in the folder; Blender keeps {MAX_GRAVITY:g}")
    if source.gravity_track:
        notes.append("gravity changes over time in the folder; here it is steady")
    world.use_ground, world.ground_object = True, ground
    world.ground_point, world.ground_normal = source.ground.point, source.ground.normal
    world.friction, world.restitution = source.ground.friction, source.ground.restitution
    static = source.ground.static_friction
    world.static_friction = source.ground.friction if static is None else static


def _fill_effects(scene: bpy.types.Scene, source: Scene, items: list[bpy.types.Object], notes: list[str]) -> None:
    world = scene.physgen.world
    world.effects.clear()
    world.effect_index = 0
    by_name = {item.physgen.source: item for item in items}
    for entry in source.effects:
        if effect(entry.name).kind == "observation":
            notes.append(f"the effect {entry.name} concerns a recording; here it is left out")
            continue
        line = world.effects.add()
        # The first of the list is set already: then nothing has told the parameters.
        line.effect = entry.name
        values = {**effect(entry.name).defaults, **dict(entry.parameters)}
        line.parameters.clear()
        for name, value in values.items():
            parameter = line.parameters.add()
            parameter.name, parameter.value = name, value
        for name in entry.objects:
            line.targets.add().item = by_name[name]


def fill_body(
    scene: bpy.types.Scene,
    collection: bpy.types.Collection,
    item: bpy.types.Object,
    source: SceneObject,
    ground: Ground,
    notes: list[str],
) -> None:
    """Fill the fields of ``item``; its pins become empties in ``collection``. What has none is told in ``notes``."""
    body = item.physgen
    rate, first = scene.render.fps / scene.render.fps_base, scene.physgen.simulation.frame_start
    body.enabled, body.source, body.role = True, source.name, source.role
    _fill_material(body.material, source.material)
    body.fill, body.shell_thickness = source.fill, source.shell_thickness or 0.0
    body.velocity, body.spin = source.velocity, source.spin
    body.start_frame = first + round(source.start_time * rate) if source.start_time > 0 else 0
    body.goal_stiffness, body.goal_damping = source.goal_stiffness, source.goal_damping
    _fill_surface(body, source, ground)
    for number, box in enumerate(source.pins, start=1):
        pin = _pin(collection, f"{source.name} pin {number}", box)
        body.pins.add().box = pin
        if source.pin_motion:
            _animate_places(pin, source.pin_motion, first, rate)
    if source.pin_motion and not source.pins:
        notes.append(f"{source.name} is held along a path in the folder; here it is held in place")
    for field, what in (("acceleration", "an acceleration"), ("velocity_keys", "velocities")):
        if getattr(source, field):
            notes.append(f"{source.name} has {what} over time in the folder; here it has none")
    if source.motion is not None and source.motion.vertices_file is not None:
        notes.append(f"{source.name} deforms by {source.motion.vertices_file} in the folder; here it stands still")
    elif source.motion is not None:
        _animate_collider(item, source.motion, first, rate)


def _fill_material(target: bpy.types.PropertyGroup, material: Material) -> None:
    set_material(target, material)
    target.preset_name = material.preset
    if presets.find(material.preset) is None or is_modified(target):
        target.preset_name = presets.CUSTOM


def _fill_surface(body: bpy.types.PropertyGroup, source: SceneObject, ground: Ground) -> None:
    given = (source.roughness, source.friction, source.static_friction, source.restitution, source.contact_mode)
    body.own_surface = any(value is not None for value in given)
    friction = source.friction
    if friction is None and source.roughness is not None:
        friction = 0.05 + 0.9 * source.roughness  # docs/file-formats.md
    grounds = ground.friction if ground.static_friction is None else ground.static_friction
    body.friction = ground.friction if friction is None else friction
    static = source.static_friction
    body.static_friction = (grounds if friction is None else friction) if static is None else static
    body.restitution = ground.restitution if source.restitution is None else source.restitution
    body.contact_mode = source.contact_mode or "separate"


def _pin(collection: bpy.types.Collection, name: str, box: Box) -> bpy.types.Object:
    low, high = np.asarray(box.low), np.asarray(box.high)
    pin = bpy.data.objects.new(name, None)
    pin.empty_display_type, pin.empty_display_size = "CUBE", 1.0
    pin.location, pin.scale = ((low + high) / 2).tolist(), ((high - low) / 2).tolist()
    collection.objects.link(pin)
    return pin


def _animate_places(item: bpy.types.Object, keys: Keys, first: int, rate: float) -> None:
    start = Vector(item.location)
    frames = [first + key.time_s * rate for key in keys]
    _insert(item, "location", frames, [tuple(start + Vector(key.value)) for key in keys])


def _animate_collider(item: bpy.types.Object, motion: Motion, first: int, rate: float) -> None:
    """Keyframes at those of ``motion``; where it turns about a point off its origin also at the frames between."""
    if motion.pivot is not None:
        pivot = Vector(motion.pivot)
    else:
        corners = box_corners(item)
        pivot = Vector(((corners.min(axis=0) + corners.max(axis=0)) / 2).tolist())
    times = {key.time_s for key in (*motion.translations, *motion.rotations)}
    if len(motion.rotations) > 1:
        low, high = motion.rotations[0].time_s, motion.rotations[-1].time_s
        times |= {frame / rate for frame in range(math.ceil(low * rate), math.floor(high * rate) + 1)}
    start, ordered = Vector(item.matrix_world.translation), sorted(times)
    turns = [_turn(motion.rotations, time) for time in ordered]
    for before, after in itertools.pairwise(turns):
        after.make_compatible(before)
    places = [
        turn @ (start - pivot) + pivot + _shift(motion.translations, time)
        for turn, time in zip(turns, ordered, strict=True)
    ]
    frames = [first + time * rate for time in ordered]
    item.rotation_mode = "QUATERNION"
    curves = _insert(item, "location", frames, [tuple(place) for place in places])
    _insert(item, "rotation_quaternion", frames, [tuple(turn) for turn in turns], curves)


def _shift(keys: Keys, time: float) -> Vector:
    if not keys:
        return Vector()
    times = [key.time_s for key in keys]
    return Vector([float(np.interp(time, times, [key.value[axis] for key in keys])) for axis in range(3)])


def _turn(keys: Keys, time: float) -> Quaternion:
    """Rotation at ``time``; the turn from one keyframe to the next is steady."""
    if not keys:
        return Quaternion()
    after = next((index for index, key in enumerate(keys) if key.time_s >= time), len(keys) - 1)
    before = max(after - 1, 0) if keys[after].time_s > time else after
    first, second = (_quaternion(keys[index].value) for index in (before, after))
    span = keys[after].time_s - keys[before].time_s
    return first.slerp(second, (time - keys[before].time_s) / span) if span > 0 else first


def _quaternion(rotation: tuple[float, float, float]) -> Quaternion:
    vector = Vector(rotation)
    return Quaternion(vector, vector.length) if vector.length > 0 else Quaternion()


def _insert(
    item: bpy.types.Object,
    path: str,
    frames: list[float],
    values: list[tuple[float, ...]],
    curves: bpy.types.bpy_prop_collection | None = None,
) -> bpy.types.bpy_prop_collection:
    """Keyframes with straight lines between them; the curves, for the next property of the same object."""
    curves = compat.new_curves(item) if curves is None else curves
    for axis in range(len(values[0])):
        curve = curves.new(path, index=axis)
        curve.keyframe_points.add(len(frames))
        points = np.column_stack([frames, [value[axis] for value in values]]).astype(np.float32)
        curve.keyframe_points.foreach_set("co", points.ravel())
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
        curve.update()
    return curves
