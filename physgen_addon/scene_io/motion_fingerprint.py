# SPDX-License-Identifier: GPL-3.0-or-later
"""Hash of all inputs of a scene's motion, without evaluating the scene; tells whether a bake is out of date.

Animation enters by its keyframes and settings, not by stepping through frames; so the hash is the same at every frame,
during playback, and for every selection. It may change where the motion does not (a keyframe before the first frame),
but never the reverse.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...sim.errors import InputError
from ..playback import splat_clouds
from ..props.body_props import bodies
from .export_animation import (
    PLACING,
    TRANSFORM,
    Channel,
    channels,
    clock,
    curves,
    drivers,
    export_names,
    metres_per_unit,
)
from .export_meshes import read_corners, read_points
from .export_objects import (
    PAINTED,
    animated_numbers,
    foreign_modifiers,
    is_smoothing,
    painted_weights,
    physics,
    sand,
)
from .export_world import effects

UNSEEN = {
    "rna_type",
    "name",
    "execution_time",
    "is_active",
    "persistent_uid",
    "select",
    "active",
    "lock",
    "is_override_data",
    "location_absolute",
    "dimensions",
    "width",
    "height",
    "error_location",
    "error_rotation",
    "is_valid",
}
"""Properties that do not affect the motion, or change by reading."""

UNSEEN_BEGINNINGS = ("show_", "open_")


def fingerprint(scene: bpy.types.Scene) -> str:
    """Return the SHA-256 in hexadecimal. Objects that cannot be simulated enter with the reason, so this never raises.

    Mesh edits count when edit mode is left.
    """
    digest = _Digest(scene)
    digest.scene()
    for item in bodies(scene):
        digest.body(item)
    return digest.hash.hexdigest()


class _Digest:
    """The hash and the owners already in it: objects may refer to each other in cycles."""

    def __init__(self, scene: bpy.types.Scene) -> None:
        self.hash = hashlib.sha256()
        self._scene = scene
        self._unit = metres_per_unit(scene)
        self._seen: set[tuple[int, bool]] = set()

    def _add(self, *values: Any) -> None:
        self.hash.update(repr(values).encode())

    def _add_checked(self, *values: Callable[[], Any]) -> None:
        for value in values:
            try:
                self._add(value())
            except InputError as error:
                self._add(str(error))

    def scene(self) -> None:
        """Add frames, quality, gravity, ground and effects."""
        scene, settings = self._scene, self._scene.physgen.simulation
        world = scene.physgen.world
        self._add(self._unit, settings.frame_start, settings.frame_end, settings.quality, settings.seed)
        self._add(scene.render.fps, scene.render.fps_base)
        if settings.slow != 1.0:
            self._add(settings.slow)
        animated = channels(scene)
        if not {path for path, _ in animated} & {"gravity", "use_gravity"}:
            self._add(scene.use_gravity, *(scene.gravity if scene.use_gravity else ()))
        else:
            self._animation(scene, ("gravity", "use_gravity"))
            self._channels(scene, ("gravity", "use_gravity"), animated)
        self._add(world.use_ground)
        if world.use_ground:
            self._add(*world.ground_point, *world.ground_normal)
            self._add(world.friction, world.static_friction, world.restitution)
            self._object(world.ground_object, shape=False)
        self._add_checked(lambda: effects(scene, export_names(scene)))

    def body(self, item: bpy.types.Object) -> None:
        """Add one body with everything that moves it."""
        scene = self._scene
        self._add(item.name)
        self._add_checked(lambda: _plain(item, physics(item, self._unit, clock(scene))))
        self._add_checked(lambda: sand(item, "", clock(scene)))
        for field, group, factor in PAINTED if item.physgen.role == "dynamic" else ():
            name = getattr(item.physgen, group)
            if name:
                self._add(field, getattr(item.physgen, factor))
                self._add_checked(partial(_weights_hash, item, name))
        self._seen.discard((item.as_pointer(), True))
        dynamic = item.physgen.role == "dynamic"
        self._object(item, shape=True, as_seen=not dynamic)
        seen = splat_clouds.find(item)
        if seen is not None:
            # These do not affect the motion, but the bake depends on them.
            self.hash.update(read_points(seen.data))
        if dynamic:
            for pin in item.physgen.pins:
                self._object(pin.box, shape=True)

    def _object(self, item: bpy.types.Object | None, shape: bool, as_seen: bool = True) -> None:
        """Add pose and animation of ``item``, and with ``shape`` its shape, by its settings.

        as_seen: include modifiers that leave the shape about unchanged, which a simulated mesh excludes.
        """
        if item is None or (item.as_pointer(), as_seen) in self._seen:
            self._add(None if item is None else item.name)
            return
        self._seen.add((item.as_pointer(), as_seen))
        animated = channels(item)
        self._add(item.type, item.rotation_mode, item.empty_display_size, item.parent_type, item.parent_bone)
        self._channels(item, PLACING, animated)
        self._animation(item)
        for constraint in item.constraints:
            self._struct(constraint, animated, f'constraints["{constraint.name}"]')
        if item.parent is not None:
            self._add(tuple(map(tuple, item.matrix_parent_inverse)))
            self._object(item.parent, shape=item.parent_type != "OBJECT")
        if shape:
            self._shape(item, as_seen)

    def _shape(self, item: bpy.types.Object, as_seen: bool) -> None:
        data = item.data
        if data is not None and (data.as_pointer(), True) not in self._seen:
            self._seen.add((data.as_pointer(), True))
            self._animation(data)
            if item.type == "MESH":
                self._mesh(data)
            elif item.type == "LATTICE":
                self._add([tuple(point.co_deform) for point in data.points])
            elif item.type in ("CURVE", "SURFACE"):
                self._add([tuple(p.co) for s in data.splines for p in (*s.points, *s.bezier_points)])
            elif item.type == "ARMATURE":
                self._add([(bone.name, *bone.head_local, *bone.tail_local) for bone in data.bones])
        else:
            self._add(None if data is None else data.name)
        animated = channels(item)
        for bone in item.pose.bones if item.pose is not None else ():
            path = f'pose.bones["{bone.name}"].'
            self._add(bone.name)
            self._channels(bone, TRANSFORM, animated, path)
            for constraint in bone.constraints:
                self._struct(constraint, animated, f'{path}constraints["{constraint.name}"]')
        for modifier in foreign_modifiers(item) if item.type in ("MESH", "CURVE", "LATTICE") else ():
            if not as_seen and is_smoothing(modifier):
                continue
            path = f'modifiers["{modifier.name}"]'
            self._add(modifier.name)
            self._struct(modifier, animated, path)
            if modifier.type == "NODES":
                self._nodes(modifier, {name for name, _ in animated if name.startswith(path)})

    def _mesh(self, mesh: bpy.types.Mesh) -> None:
        starts = np.empty(len(mesh.polygons), dtype=np.int32)
        mesh.polygons.foreach_get("loop_start", starts)
        self._add(len(mesh.vertices), len(mesh.loops), len(starts))
        for array in (read_points(mesh), read_corners(mesh), starts):
            self.hash.update(array)
        if mesh.shape_keys is not None:
            animated = channels(mesh.shape_keys)
            self._animation(mesh.shape_keys)
            for key in mesh.shape_keys.key_blocks:
                self._add(key.name, key.mute, key.slider_min, key.slider_max, key.vertex_group)
                self._channels(key, ("value",), animated, f'key_blocks["{key.name}"].')
                points = np.empty(3 * len(key.data), dtype=np.float32)
                key.data.foreach_get("co", points)
                self.hash.update(points)

    def _channels(self, owner: Any, names: tuple[str, ...], animated: set[Channel], path: str = "") -> None:
        """Add those of the properties ``names`` that are not animated."""
        for name in names:
            value = getattr(owner, name)
            numbers = (value,) if isinstance(value, bool | int | float) else tuple(value)
            self._add(name, [None if (path + name, i) in animated else n for i, n in enumerate(numbers)])

    def _animation(self, owner: bpy.types.ID, only: tuple[str, ...] | None = None) -> None:
        """Add keyframes, drivers and NLA strips on ``owner``; with ``only``, of these properties."""
        for curve in curves(owner):
            if only is not None and curve.data_path not in only:
                continue
            self._add(curve.data_path, curve.array_index, curve.extrapolation)
            for name in ("co", "handle_left", "handle_right"):
                points = np.empty(2 * len(curve.keyframe_points), dtype=np.float32)
                curve.keyframe_points.foreach_get(name, points)
                self.hash.update(points)
            self._add([(p.interpolation, p.easing, p.back, p.amplitude, p.period) for p in curve.keyframe_points])
            for modifier in curve.modifiers:
                self._struct(modifier)
        for curve in drivers(owner):
            if only is not None and curve.data_path not in only:
                continue
            self._add(curve.data_path, curve.array_index, curve.driver.type, curve.driver.expression)
            for variable in curve.driver.variables:
                for target in variable.targets:
                    self._add(variable.name, variable.type, target.data_path, target.transform_type, target.bone_target)
                    self._reference(target.id)
                    self._driving(target)
        data = owner.animation_data
        for track in data.nla_tracks if data is not None else ():
            self._add(track.mute)
            for strip in track.strips:
                self._struct(strip)

    def _driving(self, target: bpy.types.DriverTarget) -> None:
        """Add the value that a driver reads, unless it is animated in turn."""
        owner, path = target.id, target.data_path
        if owner is None or not path or path.startswith("frame_"):
            return
        if path.partition("[")[0] in {name.partition("[")[0] for name, _ in channels(owner)}:
            return
        with contextlib.suppress(ValueError):
            self._value(owner.path_resolve(path))

    def _nodes(self, modifier: bpy.types.NodesModifier, animated: set[str]) -> None:
        """Add the inputs of a geometry nodes modifier outside ``animated`` paths, and the nodes of its group."""
        inputs = modifier.properties.inputs if hasattr(modifier, "properties") else None
        if inputs is not None:
            for item in inputs.bl_rna.properties:
                if item.identifier != "rna_type" and not any(item.identifier in path for path in animated):
                    self._add(item.identifier)
                    self._value(getattr(getattr(inputs, item.identifier), "value", None))
        else:
            for key in sorted(modifier.keys()):
                self._add(key)
                if not any(key in path for path in animated):
                    self._value(modifier[key])
        tree = modifier.node_group
        if tree is not None and (tree.as_pointer(), True) not in self._seen:
            self._seen.add((tree.as_pointer(), True))
            self._add([(link.from_socket.path_from_id(), link.to_socket.path_from_id()) for link in tree.links])
            for node in tree.nodes:
                self._struct(node)
                for socket in node.inputs:
                    self._value(getattr(socket, "default_value", None))

    def _struct(self, owner: Any, animated: Collection[Channel] = (), path: str = "") -> None:
        """Add all plain properties of ``owner``, at ``path``, that are not animated, and the objects it refers to."""
        names = {name for name, _ in animated}
        for prop in owner.bl_rna.properties:
            name = prop.identifier
            if name not in UNSEEN and not name.startswith(UNSEEN_BEGINNINGS) and f"{path}.{name}" not in names:
                self._add(name)
                self._value(getattr(owner, name))

    def _value(self, value: Any) -> None:
        if isinstance(value, bpy.types.ID):
            self._reference(value)
        elif isinstance(value, bool | int | float | str):
            self._add(value)
        elif isinstance(value, Matrix):
            self._add([tuple(row) for row in value])
        elif hasattr(value, "__len__"):
            # Vectors, rotations, colours and arrays, each a type of its own; non-numeric ones are skipped.
            with contextlib.suppress(TypeError, ValueError):
                self._add([float(number) for number in value])

    def _reference(self, value: bpy.types.ID | None) -> None:
        if isinstance(value, bpy.types.Object):
            self._object(value, shape=True)
        else:
            self._add(None if value is None else value.name)


def _plain(item: bpy.types.Object, fields: dict[str, Any]) -> dict[str, Any]:
    """Return ``fields`` without the name of the material preset and the numbers of it that are animated."""
    if "material" not in fields:
        return fields
    left = {"preset", *animated_numbers(item)}
    return {**fields, "material": {name: n for name, n in vars(fields["material"]).items() if name not in left}}


def _weights_hash(item: bpy.types.Object, name: str) -> str:
    return hashlib.sha256(painted_weights(item, name).tobytes()).hexdigest()
