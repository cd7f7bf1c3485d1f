# SPDX-License-Identifier: GPL-3.0-or-later
"""Import of a scene folder's physics into Blender's properties and keyframes; user edits survive a new import."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Quaternion, Vector

from ...sim.effects.registry import effect
from ...sim.scene.material import Material
from ...sim.scene.model import Ground, SceneModel, SceneObject
from ...sim.scene.scene_object import Box, Keys, Motion
from .. import compat
from ..props import material_props
from ..props.body_props import bodies
from ..props.material_props import NUMBERS, is_modified, set_material
from .export_meshes import box_corners

MAX_GRAVITY = 200.0
"""Maximum gravity that Blender stores, along each axis, m/s²."""


def apply_physics(
    scene: bpy.types.Scene,
    collection: bpy.types.Collection,
    source: SceneModel,
    items: list[bpy.types.Object],
    ground: bpy.types.Object,
) -> list[str]:
    """Set all properties; pins become empties in ``collection``. Return notes about what could not be imported."""
    notes: list[str] = []
    _fill_world(scene, source, ground, notes)
    for item, body in zip(items, source.objects, strict=True):
        fill_body(scene, collection, item, body, source.ground_plane, notes)
    _fill_effects(scene, source, items, notes)
    if source.contacts:
        pairs = ", ".join(" and ".join(contact.between) for contact in source.contacts)
        notes.append(f"the contact of {pairs} has numbers of its own in the folder; Blender has a surface an object")
    return notes


def _fill_world(scene: bpy.types.Scene, source: SceneModel, ground: bpy.types.Object, notes: list[str]) -> None:
    world = scene.physgen.world
    scene.use_gravity, scene.gravity = True, source.gravity
    if max(map(abs, source.gravity)) > MAX_GRAVITY:
        notes.append(f"gravity is {math.hypot(*source.gravity):g} m/s² in the folder; Blender keeps {MAX_GRAVITY:g}")
    if source.gravity_track:
        notes.append("gravity changes over time in the folder; here it is steady")
    world.use_ground, world.ground_object = True, ground
    world.ground_point, world.ground_normal = source.ground_plane.point, source.ground_plane.normal
    world.friction, world.restitution = source.ground_plane.friction, source.ground_plane.restitution
    static = source.ground_plane.static_friction
    world.static_friction = source.ground_plane.friction if static is None else static


def _fill_effects(scene: bpy.types.Scene, source: SceneModel, items: list[bpy.types.Object], notes: list[str]) -> None:
    world = scene.physgen.world
    world.effects.clear()
    world.effect_index = 0
    by_name = {item.physgen.source: item for item in items}
    for entry in source.effects:
        if effect(entry.name).kind == "observation":
            notes.append(f"the effect {entry.name} concerns a recording; here it is left out")
            continue
        line = world.effects.add()
        # Setting the effect to the first item does not trigger the update that fills the parameters.
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
    """Set the properties of ``item``; pins become empties in ``collection``. What has no property is added to
    ``notes``.
    """
    body = item.physgen
    settings = scene.physgen.simulation
    rate, first = settings.slow * scene.render.fps / scene.render.fps_base, settings.frame_start
    body.enabled, body.source, body.role = True, source.name, source.role
    fill_material(body.material, source.material)
    body.fill, body.shell_thickness = source.fill, source.shell_thickness or 0.0
    body.velocity, body.spin = source.velocity, source.spin
    body.asleep, body.held = source.asleep, source.held
    body.start_frame = first + round(source.start_time * rate) if source.start_time > 0 else 0
    _fill_pushes(body, source.velocity_keys, first, rate)
    body.goal_stiffness, body.goal_damping = source.goal_stiffness, source.goal_damping
    _fill_surface(body, source, ground)
    for number, box in enumerate(source.pins, start=1):
        pin = _pin(collection, f"{source.name} pin {number}", box)
        body.pins.add().box = pin
        if source.pin_motion:
            _animate_places(pin, source.pin_motion, first, rate)
    if source.pin_motion and not source.pins:
        notes.append(f"{source.name} is held along a path in the folder; here it is held in place")
    if source.acceleration:
        notes.append(f"{source.name} has an acceleration over time in the folder; here it has none")
    if source.material_tracks:
        changing = ", ".join(track.field for track in source.material_tracks)
        notes.append(f"{source.name} has {changing} over time in the folder; here they stay")
    for field, what in (("stiffness_map", "a stiffness"), ("density_map", "a density")):
        if getattr(source, field) is not None:
            notes.append(f"{source.name} has {what} that differs from place to place in the folder; here it is one")
    if source.motion is not None and source.motion.vertices_file is not None:
        notes.append(f"{source.name} deforms by {source.motion.vertices_file} in the folder; here it stands still")
    elif source.motion is not None:
        _animate_collider(item, source.motion, first, rate)


def _fill_pushes(body: bpy.types.PropertyGroup, keys: Keys, first: int, rate: float) -> None:
    """Turn ``keys`` into pushes at whole frames, one a frame; one at the object's first frame is its velocity."""
    start = max(first, body.start_frame)
    by_frame = {first + round(key.time_s * rate): key.value for key in keys}
    body.velocity = by_frame.get(start, body.velocity)
    _set_pushes(body, [[frame, *velocity] for frame, velocity in by_frame.items() if frame > start])


def fill_material(target: bpy.types.PropertyGroup, material: Material) -> None:
    """Set ``target`` to ``material``: its preset, or its own numbers and the preset that they were derived from."""
    set_material(target, material)
    target.preset_name, target.likeness = material.preset, ""
    if material_props.find_preset(material.preset) is None or is_modified(target):
        target.preset_name = material_props.CUSTOM
        target.likeness = material.preset if material_props.find_preset(material.preset) is not None else ""


def _fill_surface(body: bpy.types.PropertyGroup, source: SceneObject, ground: Ground) -> None:
    given = (source.roughness, source.friction, source.static_friction, source.restitution, source.contact_mode)
    body.own_surface = any(value is not None for value in given)
    friction = source.friction
    if friction is None and source.roughness is not None:
        friction = 0.05 + 0.9 * source.roughness  # See docs/file-formats.md.
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
    """Insert the keyframes of ``motion``; for rotations about a pivot off its origin also one at every frame
    between.
    """
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
    """Return the rotation at ``time``; between keyframes it rotates uniformly."""
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
    """Insert keyframes with linear interpolation; return the curves, for the object's next property."""
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


Fields = dict[str, Any]

_KEY = "physgen_imported"
"""Custom property of the import's collection."""
_SURFACE = ("friction", "static_friction", "restitution")
"""In this order: setting the friction also raises the static one."""
OF_BODY = (
    ("role",),
    ("fill", "shell_thickness"),
    ("stiffness_group", "stiffness_factor"),
    ("density_group", "density_factor"),
    ("sandy", "sandy_frame"),
    ("own_surface", "contact_mode", *_SURFACE),
    ("velocity",),
    ("spin",),
    ("asleep", "held"),
    ("start_frame",),
    ("goal_stiffness", "goal_damping"),
    ("splats_as",),
)
"""Properties of a body; groups that belong together are kept together."""
OF_MATERIAL = (("preset_name", *NUMBERS),)
OF_WORLD = (("use_ground",), _SURFACE)
OF_SCENE = (("use_gravity", "gravity"),)


def remember_imported(scene: bpy.types.Scene, photo: Path) -> None:
    """Store the imported properties, with a reference to ``photo``."""
    scene.physgen.photo_root[_KEY] = json.dumps({"photo": str(photo), "fields": _all(scene)})


def find_edits(scene: bpy.types.Scene, photo: Path) -> Fields:
    """Return properties changed since the import, for ``restore_edits``; empty unless the import was made from
    ``photo``.
    """
    root = scene.physgen.photo_root
    if root is None or _KEY not in root:
        return {}
    noted = json.loads(root[_KEY])
    if noted["photo"] != str(photo):
        return {}
    before, now = noted["fields"], _all(scene)
    return {what: value for what, value in now.items() if what in before and before[what] != value}


def restore_edits(scene: bpy.types.Scene, changed: Fields) -> None:
    """Apply ``changed`` to objects of the same names; edits of other objects are dropped."""
    for what, value in changed.items():
        owner, _, field = what.partition("/")
        target = _owner(scene, owner)
        if target is None:
            continue
        if field == "pushes":
            _set_pushes(target, value)
        elif field == "pins":
            _set_pins(scene, target, value)
        elif field == "effects":
            _set_effects(scene, target, value)
        else:
            for name, one in zip(field.split(","), value, strict=True):
                setattr(target, name, one)


def _all(scene: bpy.types.Scene) -> Fields:
    """Return all editable properties, by ``OWNER/FIELDS``."""
    found: Fields = {}
    world = scene.physgen.world
    for item in bodies(scene):
        if item.physgen.source:
            name = item.physgen.source
            found |= _read(f"body:{name}", item.physgen, OF_BODY)
            found |= _read(f"material:{name}", item.physgen.material, OF_MATERIAL)
            found[f"body:{name}/pushes"] = [[push.frame, *push.velocity] for push in item.physgen.pushes]
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
    """Return a reference that finds ``item`` after the next import, which creates new objects."""
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


def _set_pushes(body: Any, rows: Sequence[Sequence[float]]) -> None:
    """Replace the pushes of ``body`` by one for each of ``rows`` (4): the frame, and the velocity."""
    body.pushes.clear()
    for frame, *velocity in rows:
        push = body.pushes.add()
        push.frame, push.velocity = int(frame), velocity


def _set_pins(scene: bpy.types.Scene, body: Any, names: list[str]) -> None:
    body.pins.clear()
    for name in names:
        if name in scene.objects:
            body.pins.add().box = scene.objects[name]


def _set_effects(scene: bpy.types.Scene, world: Any, entries: list[Fields]) -> None:
    world.effects.clear()
    for given in entries:
        targets = [
            _of_source(scene, name) if kind == "source" else scene.objects.get(name) for kind, name in given["targets"]
        ]
        if given["targets"] and not any(targets):
            # Without targets it would act on all objects.
            continue
        entry = world.effects.add()
        entry.effect, entry.enabled = given["effect"], given["enabled"]
        entry.parameters.clear()
        for name, value in given["parameters"].items():
            number = entry.parameters.add()
            number.name, number.value = name, value
        for item in targets:
            if item is not None:
                entry.targets.add().item = item
