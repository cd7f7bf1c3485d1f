# SPDX-License-Identifier: GPL-3.0-or-later
"""The window's 3D viewports; there are none in background mode."""

from __future__ import annotations

from pathlib import Path

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


def show_image(context: bpy.types.Context, path: Path) -> None:
    """Show the picture at ``path`` in an image editor; in a window of its own where none is open.

    Where the preferences keep rendered pictures in the interface (Render In: Keep User Interface), none is opened.
    """
    image = bpy.data.images.load(str(path), check_existing=True)
    image.reload()
    if bpy.app.background or context.window is None:
        return
    screens = [window.screen for window in context.window_manager.windows]
    areas = [area for screen in screens for area in screen.areas if area.type == "IMAGE_EDITOR"]
    if not areas:
        if context.preferences.view.render_display_type == "NONE":
            return
        before = set(context.window_manager.windows)
        bpy.ops.wm.window_new()
        areas = [window.screen.areas[0] for window in context.window_manager.windows if window not in before]
    for area in areas[:1]:
        area.type = "IMAGE_EDITOR"
        area.spaces.active.image = image
