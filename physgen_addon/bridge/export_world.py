# SPDX-License-Identifier: GPL-3.0-or-later
"""What surrounds the objects: ground, gravity, effects; and the scene's camera as a pinhole."""

from __future__ import annotations

from collections.abc import Mapping

import bpy
import numpy as np

from ...sim.errors import InputError
from ...sim.scene.model import Camera, Effect, Ground, Keys
from ..props.scene import effect_values, known_effect
from ..typed import decimal
from .animation import channels, why_it_moves
from .export_motion import keys
from .export_refusals import require_evaluated, require_placed
from .export_units import Clock, Vector, placed, scaled

DEFAULT_FOCAL = 1.4
"""Focal length over the image's width of the camera of a scene that has none: Blender's 50 mm."""

DEFAULT_PLACE = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -5.0), (0.0, -1.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
"""5 m in front of the origin and 1 m up, looking along +Y."""


def ground(scene: bpy.types.Scene, unit: float, graph: bpy.types.Depsgraph) -> Ground | None:
    """The floor, None where there is none. Raises InputError for one that moves, is gone or has no direction."""
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
    """Gravity in m/s² as ``scene`` has it now."""
    return scaled(scene.gravity, unit) if scene.use_gravity else (0.0, 0.0, 0.0)


class GravityTrack:
    """Gravity as it is read frame by frame. moves: whether it is animated."""

    def __init__(self, scene: bpy.types.Scene, unit: float, clock: Clock) -> None:
        self.moves = bool({path for path, _ in channels(scene)} & {"gravity", "use_gravity"})
        self._unit, self._clock = unit, clock
        self._values: list[Vector] = []

    def read(self, graph: bpy.types.Depsgraph) -> None:
        """Take in the frame that ``graph`` has evaluated."""
        self._values.append(gravity(graph.scene_eval, self._unit))

    def keys(self) -> Keys:
        """Keyframes in m/s²; none where it stays what it is at the first frame."""
        return keys(self._clock, self._values) if len(set(self._values)) > 1 else ()

    @property
    def first(self) -> Vector:
        """Gravity in m/s² at the first frame that was read."""
        return self._values[0]


def effects(scene: bpy.types.Scene, names: Mapping[str, str]) -> list[Effect]:
    """The effects of the stack that are on; ``names`` has every body's name in the folder by its name in Blender.

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
    """The scene's camera; a default in front of the origin where there is none, or none with a perspective."""
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
        world_from_camera=tuple(tuple(float(number) for number in row) for row in place),
    )
