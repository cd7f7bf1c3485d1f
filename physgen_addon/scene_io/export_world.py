# SPDX-License-Identifier: GPL-3.0-or-later
"""Surroundings of the objects: pins, colliders, ground, gravity, effects, and a pinhole camera."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.atomic import replacing
from ...sim.errors import InputError
from ...sim.scene.meshes import MAX_TRACK_BYTES
from ...sim.scene.model import Box, Camera, Effect, Ground, Keys, Motion
from ..props.scene_props import effect_values, known_effect
from ..text import decimal
from .export_animation import (
    STILL,
    Clock,
    Vector,
    channels,
    keys,
    matrix_rows,
    placed,
    rigid_motion,
    scaled,
    why_it_moves,
)
from .export_meshes import Triangles, read_corners, read_points, read_triangles
from .export_objects import foreign_modifiers, require_evaluated, require_placed


class PinBoxes:
    """Pin boxes of one object, read frame by frame. moves: whether any of them may move."""

    def __init__(self, item: bpy.types.Object, scene: bpy.types.Scene, unit: float, clock: Clock) -> None:
        self._item, self._unit, self._clock = item, unit, clock
        self._boxes = [pin.box for pin in item.physgen.pins]
        for number, box in enumerate(self._boxes, start=1):
            if box is None or scene.objects.get(box.name) != box:
                raise InputError(
                    f"object {item.name!r}: pin {number} has no box in this scene: choose an empty for it, or remove it"
                )
        self.moves = any(why_it_moves(box) is not None for box in self._boxes)
        self._corners: list[NDArray[np.float64]] = []

    def read(self, graph: bpy.types.Depsgraph) -> None:
        """Read the evaluated frame ``graph``."""
        self._corners.append(np.stack([_corners(box.evaluated_get(graph), self._unit) for box in self._boxes]))

    def boxes(self) -> tuple[Box, ...]:
        """Return the pinned boxes at the first frame: world axis-aligned bounds of the empties' boxes."""
        result = []
        for box, corners in zip(self._boxes, self._corners[0], strict=True):
            low, high = corners.min(axis=0), corners.max(axis=0)
            if not (np.isfinite(corners).all() and (low < high).all()):
                raise InputError(f"object {self._item.name!r}: its pin {box.name!r} is flat: scale it up on every axis")
            result.append(Box(low=scaled(low), high=scaled(high)))
        return tuple(result)

    def motion(self) -> Keys:
        """Return the translations of the pins, m. Raises InputError if they differ or rotate."""
        corners = np.stack(self._corners)
        steps = corners - corners[0]
        size = max(float(np.ptp(corners[0], axis=1).max()), float(np.abs(steps).max()))
        first = steps[:, :1, :1]
        if np.abs(steps - first).max() > 10 * STILL * size:
            raise InputError(
                f"object {self._item.name!r}: its pins turn, grow or move differently, and what they hold is moved "
                "along as a whole: animate the location alone, the same for all of them (parent them to one empty)"
            )
        way = first[:, 0, 0]
        return keys(self._clock, way) if np.abs(way).max() > STILL * size else ()


def _corners(box: bpy.types.Object, unit: float) -> NDArray[np.float64]:
    """Return the corners (8, 3) of ``box`` in world metres; for objects other than empties, of the bounding box."""
    if box.type == "EMPTY":
        own = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * box.empty_display_size
    else:
        own = np.array(box.bound_box)
    matrix = placed(box.matrix_world, unit)
    return own @ matrix[:3, :3].T + matrix[:3, 3]


STILL_MODIFIERS = {
    "ARRAY",
    "BEVEL",
    "COLLISION",
    "DATA_TRANSFER",
    "DECIMATE",
    "EDGE_SPLIT",
    "LAPLACIANSMOOTH",
    "MASK",
    "MIRROR",
    "MULTIRES",
    "NORMAL_EDIT",
    "REMESH",
    "SCREW",
    "SIMPLE_DEFORM",
    "SKIN",
    "SMOOTH",
    "SOLIDIFY",
    "SUBSURF",
    "TRIANGULATE",
    "UV_PROJECT",
    "UV_WARP",
    "VERTEX_WEIGHT_EDIT",
    "VERTEX_WEIGHT_MIX",
    "WEIGHTED_NORMAL",
    "WELD",
    "WIREFRAME",
}
"""Modifier types with a constant result unless they are animated or use another object."""


class Collider:
    """A collider, read frame by frame.

    item: the object. moves: whether its pose or shape may change. unit: in metres.
    """

    def __init__(self, item: bpy.types.Object, unit: float, clock: Clock) -> None:
        self.item = item
        self._unit, self._clock = unit, clock
        self._shown = bool(foreign_modifiers(item)) or item.data.shape_keys is not None
        self._deforms = _may_deform(item)
        self.moves = self._deforms or why_it_moves(item) is not None
        self._mesh: Triangles | None = None
        self._corners: NDArray[np.int32] | None = None
        self._matrices: list[NDArray[np.float64]] = []
        self._points: list[NDArray[np.float32]] = []

    def read(self, graph: bpy.types.Depsgraph) -> None:
        """Read the evaluated frame ``graph``."""
        evaluated = self.item.evaluated_get(graph)
        self._matrices.append(placed(evaluated.matrix_world, self._unit))
        if self._mesh is not None and not self._deforms:
            return
        if not self._shown:
            self._read_mesh(self.item.data)
            return
        mesh = evaluated.to_mesh()
        try:
            self._read_mesh(mesh)
        finally:
            evaluated.to_mesh_clear()

    def _has_same_faces(self, mesh: bpy.types.Mesh) -> bool:
        return self._corners is not None and np.array_equal(read_corners(mesh), self._corners)

    def _read_mesh(self, mesh: bpy.types.Mesh) -> None:
        if self._mesh is None:
            self._mesh = read_triangles(mesh)
            self._corners = read_corners(mesh)
            self._require_room(len(mesh.vertices))
        elif len(mesh.vertices) != len(self._mesh.points) or not self._has_same_faces(mesh):
            raise InputError(
                f"object {self.item.name!r}: has other vertices or faces at frame {self._frame} than at frame "
                f"{self._clock.start}, but a collider must keep them: hide that modifier in the viewport"
            )
        points = read_points(mesh)
        if len(self._matrices) > 1 and not np.isfinite(points).all():
            raise InputError(f"object {self.item.name!r}: has non-finite vertices at frame {self._frame}")
        self._points.append(points)

    @property
    def _frame(self) -> int:
        return self._clock.start + len(self._matrices) - 1

    def _require_room(self, vertices: int) -> None:
        if self._deforms and vertices * len(self._clock.frames) * 24 > MAX_TRACK_BYTES:
            raise InputError(
                f"object {self.item.name!r}: deforms, and {vertices} vertices over {len(self._clock.frames)} frames "
                f"are more than {MAX_TRACK_BYTES >> 20} MiB: simplify it (Decimate modifier), or simulate fewer frames"
            )

    @property
    def mesh(self) -> Triangles:
        """Return the surface at the first frame, in object space."""
        assert self._mesh is not None
        return self._mesh

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Matrix (4, 4) from object space to world metres, at the first frame."""
        return self._matrices[0]

    def motion(self, root: Path, name: str) -> Motion | None:
        """Return the motion, None if static; a deformation is written to ``name`` in the folder ``root``."""
        if len(self._matrices) < 2:
            return None
        matrices = np.stack(self._matrices)
        size = float(np.ptp(self._placed(0), axis=0).max())
        shapes = self._points if len(self._points) > 1 else []
        if all(np.array_equal(points, self.mesh.points) for points in shapes):
            whole = rigid_motion(self._clock, matrices, size)
            if whole is not None:
                return whole if whole.translations or whole.rotations else None
        vertices = np.stack([self._placed(i) for i in range(len(matrices))])
        self._require_room(vertices.shape[1])
        times = np.array([self._clock.seconds(frame) for frame in self._clock.frames])
        with replacing(root / name) as partial, partial.open("wb") as file:
            np.savez(file, times=times, vertices=vertices)
        return Motion(vertices_file=name)

    def _placed(self, index: int) -> NDArray[np.float64]:
        """Return vertices (V, 3) in world metres at the frame of that index."""
        points = self._points[index if len(self._points) > 1 else 0].astype(np.float64)
        matrix = self._matrices[index]
        return points @ matrix[:3, :3].T + matrix[:3, 3]


def _may_deform(item: bpy.types.Object) -> bool:
    """Return whether the shape of ``item``, in object space, may change over time."""
    data = item.data
    shape_keys = data.shape_keys
    if channels(data) or (shape_keys is not None and channels(shape_keys)):
        return True
    modifiers = foreign_modifiers(item)
    animated = any(path.startswith("modifiers[") for path, _ in channels(item))
    return bool(modifiers) and (animated or any(_looks_around(modifier) for modifier in modifiers))


def _looks_around(modifier: bpy.types.Modifier) -> bool:
    """Return whether ``modifier`` depends on time or other objects."""
    if modifier.type not in STILL_MODIFIERS:
        return True
    pointers = [p.identifier for p in modifier.bl_rna.properties if p.type == "POINTER"]
    return any(isinstance(getattr(modifier, name), bpy.types.Object) for name in pointers)


DEFAULT_FOCAL = 1.4
"""Focal length over image width of the default camera: Blender's 50 mm."""

DEFAULT_PLACE = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -5.0), (0.0, -1.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
"""5 m in front of the origin and 1 m up, looking along +Y."""


def ground(scene: bpy.types.Scene, unit: float, graph: bpy.types.Depsgraph) -> Ground | None:
    """Return the ground, or None. Raises InputError for one that moves, is missing or has a zero normal."""
    world = scene.physgen.world
    if not world.use_ground:
        return None
    friction = decimal(world.friction)
    point, normal = scaled(world.ground_point, unit), np.array(world.ground_normal, dtype=np.float64)
    item = world.ground_object
    if item is not None:
        if scene.objects.get(item.name) != item:
            raise InputError(f"ground: {item.name!r} is no longer in this scene: choose another plane, or none")
        reason = why_it_moves(item)
        if reason is not None:
            raise InputError(
                f"ground: {item.name!r} {reason}, and the ground cannot move: make it a collider with some thickness "
                "instead, or choose another plane"
            )
        require_evaluated(item, graph)
        matrix = placed(item.evaluated_get(graph).matrix_world, unit)
        require_placed(matrix, item.name)
        point, normal = scaled(matrix[:3, 3]), np.cross(matrix[:3, 0], matrix[:3, 1])
        normal *= np.sign(normal @ matrix[:3, 2])
    length = float(np.linalg.norm(normal))
    if not length > 1e-12:
        raise InputError(f"ground: its upward direction is {normal.tolist()}: give one that is not zero")
    return Ground(
        point=point,
        normal=scaled(normal / length),
        friction=friction,
        static_friction=max(friction, decimal(world.static_friction)),
        restitution=decimal(world.restitution),
    )


def gravity(scene: bpy.types.Scene, unit: float) -> Vector:
    """Return the current gravity of ``scene``, m/s²."""
    return scaled(scene.gravity, unit) if scene.use_gravity else (0.0, 0.0, 0.0)


class GravityTrack:
    """Gravity, read frame by frame. moves: whether it is animated."""

    def __init__(self, scene: bpy.types.Scene, unit: float, clock: Clock) -> None:
        self.moves = bool({path for path, _ in channels(scene)} & {"gravity", "use_gravity"})
        self._unit, self._clock = unit, clock
        self._values: list[Vector] = []

    def read(self, graph: bpy.types.Depsgraph) -> None:
        """Read the evaluated frame ``graph``."""
        self._values.append(gravity(graph.scene_eval, self._unit))

    def keys(self) -> Keys:
        """Return keyframes in m/s²; none if it is constant."""
        return keys(self._clock, self._values) if len(set(self._values)) > 1 else ()

    @property
    def first(self) -> Vector:
        """Gravity in m/s² at the first frame."""
        return self._values[0]


def effects(scene: bpy.types.Scene, names: Mapping[str, str]) -> list[Effect]:
    """Return the enabled effects; ``names`` maps bodies' names in Blender to names in the folder.

    Raises InputError for a target that is not simulated and for parameters out of range.
    """
    result = []
    for number, entry in enumerate(scene.physgen.world.effects, start=1):
        if not entry.enabled:
            continue
        where = f"effect {number} ({entry.effect})"
        kind = known_effect(entry)
        if kind is None:
            raise InputError(f"effect {number}: this version does not know it: remove it from the stack")
        try:
            checked = kind.checked(effect_values(entry))
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        targets = tuple(_target(scene, target.item, names, where) for target in entry.targets)
        if targets and kind.of_world:
            raise InputError(f"{where}: acts on the whole world: remove its objects")
        result.append(Effect(name=entry.effect, parameters=tuple(sorted(checked.items())), objects=targets))
    return result


def _target(scene: bpy.types.Scene, item: bpy.types.Object | None, names: Mapping[str, str], where: str) -> str:
    if item is None:
        raise InputError(f"{where}: one of its objects is empty: choose an object, or remove it")
    if scene.objects.get(item.name) != item or item.name not in names or item.physgen.role != "dynamic":
        raise InputError(f"{where}: {item.name!r} is not simulated in this scene: choose an object that is")
    return names[item.name]


def camera(scene: bpy.types.Scene, unit: float, graph: bpy.types.Depsgraph) -> Camera:
    """Return the scene's camera; a default in front of the origin without a perspective camera."""
    render = scene.render
    width = max(1, round(render.resolution_x * render.resolution_percentage / 100))
    height = max(1, round(render.resolution_y * render.resolution_percentage / 100))
    size = {"width": width, "height": height}
    item = scene.camera
    if item is None or item.type != "CAMERA" or item.data.type != "PERSP":
        focal = DEFAULT_FOCAL * width
        return Camera(**size, fx=focal, fy=focal, cx=width / 2, cy=height / 2, world_from_camera=DEFAULT_PLACE)
    seen = item.evaluated_get(graph)
    projection = seen.calc_matrix_camera(
        graph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    place = np.array(seen.matrix_world.normalized(), dtype=np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0])
    place[:3, 3] *= unit
    return Camera(
        **size,
        fx=projection[0][0] * width / 2,
        fy=projection[1][1] * height / 2,
        cx=(1 - projection[0][2]) * width / 2,
        cy=(1 + projection[1][2]) * height / 2,
        world_from_camera=matrix_rows(place),
    )
