# SPDX-License-Identifier: GPL-3.0-or-later
"""The window's 3D viewports; there are none in background mode."""

from __future__ import annotations

import bpy
from mathutils import Vector


def viewports(context: bpy.types.Context) -> list[bpy.types.SpaceView3D]:
    """The 3D viewports of the window."""
    areas = context.window.screen.areas if context.window is not None else ()
    return [area.spaces.active for area in areas if area.type == "VIEW_3D"]


def turn_to(context: bpy.types.Context, low: Vector, high: Vector) -> None:
    """Bring what lies between the corners ``low`` and ``high`` into view, in colours that show discrepancies."""
    reach = (high - low).length
    for space in viewports(context):
        space.shading.color_type = "VERTEX"
        space.shading.show_object_outline = False  # it would paint thin trails black
        space.clip_start = min(space.clip_start, max(reach, 1e-3) / 1000)
        if space.region_3d is not None and reach > 0:
            space.lock_object = None
            space.region_3d.view_location = (low + high) / 2
            space.region_3d.view_distance = reach


def look_through_camera(context: bpy.types.Context) -> None:
    """Let the window's viewports look through the scene's camera."""
    for space in viewports(context):
        if space.region_3d is not None:
            space.region_3d.view_perspective = "CAMERA"
