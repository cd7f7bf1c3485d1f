# SPDX-License-Identifier: GPL-3.0-or-later
"""The ground in 3D viewports: a piece of the plane below the objects, as lines.

The plane is no object, so nothing else shows where things will land. A photo has its own table, and a plane that is an
object is seen by itself. Lines are hidden with all overlays, and are in no render.
"""

from __future__ import annotations

import math
from typing import Any

import bpy
from mathutils import Vector

from .props.body_props import bodies
from .scene_io.export_meshes import rest_bounds

COLOUR = (0.30, 0.62, 0.95, 0.45)
MARGIN = 1.0
"""The piece reaches beyond the objects by this share of their extent, on every side."""
LIFT = 2e-3
"""Height of the lines above the plane, as a share of half a side."""
CELLS = 8
"""Lines are between this many cells a side."""

Lines = list[tuple[float, float, float]]
_known: list[tuple[Any, Lines]] = []
"""What it was made for, and the ends of the lines; at most one, since only the shown scene is drawn."""


def lines(scene: bpy.types.Scene) -> Lines:
    """Return the ends of the lines in world coordinates, two a line; empty where no ground is drawn."""
    world = scene.physgen.world
    if not world.use_ground or world.ground_object is not None or scene.physgen.folder:
        return []
    moving = [item for item in bodies(scene) if item.physgen.role == "dynamic" and item.type == "MESH"]
    if not moving:
        return []
    places = [(item.session_uid, len(item.data.vertices), *map(tuple, item.matrix_world)) for item in moving]
    key = (tuple(world.ground_point), tuple(world.ground_normal), places)
    if not _known or _known[0][0] != key:
        bounds = [rest_bounds(item) for item in moving]
        _known[:] = [(key, _lines(world, [corner for pair in bounds for corner in pair]))]
    return _known[0][1]


def _lines(world: bpy.types.PropertyGroup, corners: list[Vector]) -> Lines:
    point, normal = Vector(world.ground_point), Vector(world.ground_normal).normalized()
    if not normal.length:
        return []
    # As the axes of the grid where the plane is level.
    right = Vector((1.0, 0.0, 0.0)) if abs(normal.x) < math.sqrt(0.5) else Vector((0.0, 1.0, 0.0))
    right = (right - right.dot(normal) * normal).normalized()
    ahead = normal.cross(right)
    low, high = (Vector(pick(corner[axis] for corner in corners) for axis in range(3)) for pick in (min, max))
    middle = (low + high) / 2
    half = (0.5 + MARGIN) * max((high - low).length, 1e-6)
    # A little above, so that they are seen on a floor that lies on the plane.
    middle = middle + (LIFT * half - (middle - point).dot(normal)) * normal
    steps = [half * (2 * step / CELLS - 1) for step in range(CELLS + 1)]
    ends = [(a, -half, a, half) for a in steps] + [(-half, a, half, a) for a in steps]
    found = (middle + u * right + v * ahead for a, b, c, d in ends for u, v in ((a, b), (c, d)))
    return [(place.x, place.y, place.z) for place in found]


def _draw() -> None:
    """Draw callback of 3D viewports."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    context = bpy.context
    if not context.space_data.overlay.show_overlays:
        return
    found = lines(context.scene)
    if not found:
        return
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    depth, blend = gpu.state.depth_test_get(), gpu.state.blend_get()
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.blend_set("ALPHA")
    shader.uniform_float("color", COLOUR)
    batch_for_shader(shader, "LINES", {"pos": found}).draw(shader)
    gpu.state.depth_test_set(depth)
    gpu.state.blend_set(blend)


_handlers: list[Any] = []


def register_ground_outline() -> None:
    """Add the draw callback."""
    _handlers.append(bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW"))


def unregister_ground_outline() -> None:
    """Remove the draw callback."""
    for handler in _handlers:
        bpy.types.SpaceView3D.draw_handler_remove(handler, "WINDOW")
    _handlers.clear()
    _known.clear()
