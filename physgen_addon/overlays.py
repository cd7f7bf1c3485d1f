# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawn over Blender's editors: the bar of cached frames in timelines, the ground in 3D viewports.

The bar is at the lower edge, as Blender draws it for its own point caches. The ground is a piece of the plane below the
objects, as lines: the plane is no object, so nothing else shows where things will land. A photo has its own table, and
a plane that is an object is seen by itself. Lines are hidden with all overlays, and are in no render.
"""

from __future__ import annotations

import math
from typing import Any

import bpy
from mathutils import Vector

from . import bake_state
from .bake_state import BakeState
from .props.body_props import bodies
from .scene_io.export_meshes import rest_bounds

BAR_HEIGHT_PX = 4.0
BAR_COLOURS = {
    "baked": (0.30, 0.62, 0.95, 0.9),
    "baking": (0.30, 0.62, 0.95, 0.9),
    "paused": (0.30, 0.62, 0.95, 0.9),
    "stale": (0.85, 0.55, 0.15, 0.9),
}
"""By the bake's state; those without frames have no bar."""
MISSING_COLOUR = (0.5, 0.5, 0.5, 0.45)
"""Of frames that the bake will have, and does not have yet."""

CachedSpan = tuple[float, float, tuple[float, float, float, float]]


def cached_spans(found: BakeState | None) -> list[CachedSpan]:
    """Return what is drawn, as first and last frame and colour: half a frame on either side belongs to a frame.

    found: the last observed state; None if the scene has not been observed yet.
    """
    if found is None or found.status not in BAR_COLOURS or found.frames < 1:
        return []
    start = found.frame_start - 0.5
    done, end = start + min(found.frames_done, found.frames), start + found.frames
    drawn: list[CachedSpan] = [(start, done, BAR_COLOURS[found.status])] if done > start else []
    return [*drawn, (done, end, MISSING_COLOUR)] if end > done else drawn


def _draw_cache_bar() -> None:
    """Draw callback of timelines and dope sheets; in pixels of the region."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    context = bpy.context
    found = cached_spans(bake_state.last_seen(context.scene))
    if not found:
        return
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    view, top = context.region.view2d, BAR_HEIGHT_PX * context.preferences.system.ui_scale
    gpu.state.blend_set("ALPHA")
    for first, last, colour in found:
        left, right = (view.view_to_region(frame, 0.0, clip=False)[0] for frame in (first, last))
        corners = [(left, 0.0, 0.0), (right, 0.0, 0.0), (right, top, 0.0), (left, top, 0.0)]
        shader.uniform_float("color", colour)
        batch_for_shader(shader, "TRIS", {"pos": corners}, indices=[(0, 1, 2), (0, 2, 3)]).draw(shader)
    gpu.state.blend_set("NONE")


_bar_handlers: list[Any] = []


def register_cache_bar() -> None:
    """Add the draw callback."""
    _bar_handlers.append(bpy.types.SpaceDopeSheetEditor.draw_handler_add(_draw_cache_bar, (), "WINDOW", "POST_PIXEL"))


def unregister_cache_bar() -> None:
    """Remove the draw callback."""
    for handler in _bar_handlers:
        bpy.types.SpaceDopeSheetEditor.draw_handler_remove(handler, "WINDOW")
    _bar_handlers.clear()


GROUND_COLOUR = (0.30, 0.62, 0.95, 0.45)
GROUND_MARGIN = 1.0
"""The piece reaches beyond the objects by this share of their extent, on every side."""
GROUND_LIFT = 2e-3
"""Height of the lines above the plane, as a share of half a side."""
GROUND_CELLS = 8
"""Lines are between this many cells a side."""

Lines = list[tuple[float, float, float]]
_known_ground: list[tuple[Any, Lines]] = []
"""Lines that show the ground, with what they were made for; at most one, since only the shown scene is drawn."""


def ground_lines(scene: bpy.types.Scene) -> Lines:
    """Return the ends of the lines in world coordinates, two a line; empty where no ground is drawn."""
    world = scene.physgen.world
    if not world.use_ground or world.ground_object is not None or scene.physgen.folder:
        return []
    moving = [item for item in bodies(scene) if item.physgen.role == "dynamic" and item.type == "MESH"]
    if not moving:
        return []
    places = [(item.session_uid, len(item.data.vertices), *map(tuple, item.matrix_world)) for item in moving]
    key = (tuple(world.ground_point), tuple(world.ground_normal), places)
    if not _known_ground or _known_ground[0][0] != key:
        bounds = [rest_bounds(item) for item in moving]
        _known_ground[:] = [(key, _lines_of(world, [corner for pair in bounds for corner in pair]))]
    return _known_ground[0][1]


def _lines_of(world: bpy.types.PropertyGroup, corners: list[Vector]) -> Lines:
    point, normal = Vector(world.ground_point), Vector(world.ground_normal).normalized()
    if not normal.length:
        return []
    # As the axes of the grid where the plane is level.
    right = Vector((1.0, 0.0, 0.0)) if abs(normal.x) < math.sqrt(0.5) else Vector((0.0, 1.0, 0.0))
    right = (right - right.dot(normal) * normal).normalized()
    ahead = normal.cross(right)
    low, high = (Vector(pick(corner[axis] for corner in corners) for axis in range(3)) for pick in (min, max))
    middle = (low + high) / 2
    half = (0.5 + GROUND_MARGIN) * max((high - low).length, 1e-6)
    # A little above, so that they are seen on a floor that lies on the plane.
    middle = middle + (GROUND_LIFT * half - (middle - point).dot(normal)) * normal
    steps = [half * (2 * step / GROUND_CELLS - 1) for step in range(GROUND_CELLS + 1)]
    ends = [(a, -half, a, half) for a in steps] + [(-half, a, half, a) for a in steps]
    found = (middle + u * right + v * ahead for a, b, c, d in ends for u, v in ((a, b), (c, d)))
    return [(place.x, place.y, place.z) for place in found]


def _draw_ground() -> None:
    """Draw callback of 3D viewports."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    context = bpy.context
    if not context.space_data.overlay.show_overlays:
        return
    found = ground_lines(context.scene)
    if not found:
        return
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    depth, blend = gpu.state.depth_test_get(), gpu.state.blend_get()
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.blend_set("ALPHA")
    shader.uniform_float("color", GROUND_COLOUR)
    batch_for_shader(shader, "LINES", {"pos": found}).draw(shader)
    gpu.state.depth_test_set(depth)
    gpu.state.blend_set(blend)


_ground_handlers: list[Any] = []


def register_ground_outline() -> None:
    """Add the draw callback."""
    _ground_handlers.append(bpy.types.SpaceView3D.draw_handler_add(_draw_ground, (), "WINDOW", "POST_VIEW"))


def unregister_ground_outline() -> None:
    """Remove the draw callback."""
    for handler in _ground_handlers:
        bpy.types.SpaceView3D.draw_handler_remove(handler, "WINDOW")
    _ground_handlers.clear()
    _known_ground.clear()
