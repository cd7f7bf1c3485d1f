# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's context, also without a window: active and selected objects, and editors on screen."""

from __future__ import annotations

import contextlib
import functools
import math
from typing import Any

import bpy
from mathutils import Vector


def active(context: bpy.types.Context) -> Any:
    """Return the active object, or None."""
    return context.active_object if hasattr(context, "active_object") else context.view_layer.objects.active


def selected(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected objects."""
    found = context.selected_objects if hasattr(context, "selected_objects") else context.view_layer.objects.selected
    return list(found)


def scene_with(uid: int) -> bpy.types.Scene | None:
    """Return the scene with the given ``session_uid``, which survives undo and renaming; None if it is gone."""
    return next((scene for scene in bpy.data.scenes if scene.session_uid == uid), None)


TAB = "PhysGen"
"""Category of the sidebar tab."""
WIDE_PX = 800
"""Minimum width of an image editor that has room for its sidebar."""


def viewports(context: bpy.types.Context) -> list[bpy.types.SpaceView3D]:
    """Return the 3D viewports of the window."""
    areas = context.window.screen.areas if context.window is not None else ()
    return [area.spaces.active for area in areas if area.type == "VIEW_3D"]


def redraw(area_type: str, *region_types: str) -> None:
    """Redraw all editors of the given type in all windows, or only the given ``region_types``."""
    for manager in bpy.data.window_managers:
        for window in manager.windows:
            for area in window.screen.areas:
                if area.type != area_type:
                    continue
                if not region_types:
                    area.tag_redraw()
                for region in area.regions:
                    if region.type in region_types:
                        region.tag_redraw()


def turn_to(context: bpy.types.Context, low: Vector, high: Vector) -> None:
    """Frame the box between ``low`` and ``high`` in the viewports, with colours that show discrepancies."""
    reach = (high - low).length
    for space in viewports(context):
        space.shading.color_type = "VERTEX"
        space.shading.show_object_outline = False  # Cavity shading would paint thin trails black.
        space.clip_start = min(space.clip_start, max(reach, 1e-3) / 1000)
        if space.region_3d is not None and reach > 0:
            space.lock_object = None
            space.region_3d.view_location = (low + high) / 2
            space.region_3d.view_distance = reach


def look_through_camera(context: bpy.types.Context) -> None:
    """Make the window's viewports look through the scene's camera."""
    for space in viewports(context):
        if space.region_3d is not None:
            space.region_3d.view_perspective = "CAMERA"


def show_photo(context: bpy.types.Context, scene: bpy.types.Scene) -> None:
    """Make the viewports show ``scene`` through its camera, with plain textures and the whole image in view."""
    show_whole(context, scene, colours="TEXTURE", light="FLAT")


def show_whole(context: bpy.types.Context, scene: bpy.types.Scene, *, colours: str, light: str) -> None:
    """Make the viewports show ``scene`` through its camera, the whole image in view, in these colours and light."""
    if context.window is None or context.window.scene != scene:
        return
    look_through_camera(context)
    for area in context.window.screen.areas:
        space = area.spaces.active
        if area.type != "VIEW_3D" or space.region_3d is None:
            continue
        space.use_local_camera = False
        space.shading.color_type, space.shading.light = colours, light
        region = next((region for region in area.regions if region.type == "WINDOW"), None)
        with context.temp_override(window=context.window, area=area, region=region):
            if bpy.ops.view3d.view_center_camera.poll():
                bpy.ops.view3d.view_center_camera()
                if region is not None and context.preferences.system.use_region_overlap:
                    _leave_sidebar_free(space.region_3d, region.width, area)


def _leave_sidebar_free(view: bpy.types.RegionView3D, width: int, area: bpy.types.Area) -> None:
    """Shrink and shift the camera's frame, which fills a region of ``width`` pixels, to where neither sidebar nor
    toolbar covers it."""
    widths = {other.type: other.width for other in area.regions if other.width > 1}
    sidebar, tools = widths.get("UI", 0), widths.get("TOOLS", 0)
    if not 0 < sidebar + tools < width / 2:
        return
    free = (width - sidebar - tools) / width
    # As in Blender's BKE_screen_view3d_zoom_to_fac and BKE_camera_params_from_view3d.
    size = (math.sqrt(2) + view.view_camera_zoom / 50) ** 2 / 4 * free
    view.view_camera_zoom = (math.sqrt(4 * size) - math.sqrt(2)) * 50
    view.view_camera_offset[0] += (sidebar - tools) / width / (4 * size)


def zoom_of_whole(width: int, height: int, picture: tuple[float, float], *, fit: str) -> float:
    """Return a viewport's zoom at which the camera's whole picture fits a region, as *Frame Camera Bounds* finds it.

    width, height: of the region, pixels; also of one that has this size only later. picture: width and height of what
    the camera sees, in any unit. fit: the camera's ``sensor_fit``.
    """
    # Without zoom, the picture's width, its height or the longer of both is as long as the region's.
    longer = max(picture) if fit == "AUTO" else picture[fit == "VERTICAL"]
    scale = {"AUTO": max(width, height), "HORIZONTAL": width, "VERTICAL": height}[fit] / longer
    size = min(width / (scale * picture[0] + 4), height / (scale * picture[1] + 4))
    return (math.sqrt(4 * size) - math.sqrt(2)) * 50


def show_beside(context: bpy.types.Context, image: bpy.types.Image, tab: str) -> None:
    """Show ``image`` and the sidebar's ``tab`` in an image editor, or beside the 3D viewport if there is none.

    Nothing in the background: areas have no size there, and Blender does not come back from closing a split one.
    """
    if bpy.app.background or context.window is None:
        return
    areas = context.window.screen.areas
    area = next((area for area in areas if area.type == "IMAGE_EDITOR"), None) or _beside_viewport(context)
    if area is None:
        return
    area.spaces.active.image = image
    # In a narrow editor a sidebar would cover the image; the viewport's sidebar has the same panel.
    if area.width < WIDE_PX * context.preferences.system.ui_scale:
        area = next((area for area in areas if area.type == "VIEW_3D"), area)
    area.spaces.active.show_region_ui = True
    # After the editor has its size and the sidebar its tabs.
    bpy.app.timers.register(functools.partial(_settle, image.name, tab), first_interval=0.5)


def show_result(context: bpy.types.Context, image: bpy.types.Image) -> None:
    """Show ``image`` in an image editor, or in a new window if none is open.

    No window is opened if the preferences keep renders in the interface (Render In: Keep User Interface).
    """
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
    bpy.app.timers.register(functools.partial(_fit, image.name), first_interval=0.2)


def replace_shown(old: bpy.types.Image, new: bpy.types.Image) -> bool:
    """Let the image editors that show ``old`` show ``new``, and remove ``old``; return whether any did."""
    areas = [area for window in bpy.context.window_manager.windows for area in window.screen.areas]
    showing = [area for area in areas if area.type == "IMAGE_EDITOR" and area.spaces.active.image == old]
    for area in showing:
        area.spaces.active.image = new
        area.tag_redraw()
    bpy.data.images.remove(old)
    if showing:
        bpy.app.timers.register(functools.partial(_fit, new.name), first_interval=0.2)
    return bool(showing)


def _settle(name: str, tab: str) -> None:
    """Switch open sidebars to ``tab``, and fit the image ``name`` in the image editors that show it."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if region.type == "UI" and getattr(area.spaces.active, "show_region_ui", False):
                    # A sidebar without this tab rejects the name.
                    with contextlib.suppress(TypeError, AttributeError):
                        region.active_panel_category = tab
                        area.tag_redraw()
    _fit(name)


def _fit(name: str) -> None:
    """Fit the image ``name`` in the image editors that show it."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            shown = area.spaces.active.image if area.type == "IMAGE_EDITOR" else None
            if shown is not None and shown.name == name:
                region = next(region for region in area.regions if region.type == "WINDOW")
                with bpy.context.temp_override(window=window, area=area, region=region):
                    bpy.ops.image.view_all(fit_view=True)


def _beside_viewport(context: bpy.types.Context) -> bpy.types.Area | None:
    """Split an image editor off the left half of the largest 3D viewport; return None without a viewport."""
    views = [area for area in context.window.screen.areas if area.type == "VIEW_3D"]
    if not views:
        return None
    before = set(context.window.screen.areas)
    view = max(views, key=lambda area: area.width * area.height)
    region = next(region for region in view.regions if region.type == "WINDOW")
    with context.temp_override(window=context.window, area=view, region=region):
        bpy.ops.screen.area_split(direction="VERTICAL", factor=0.5)
    new = next((area for area in context.window.screen.areas if area not in before), None)
    if new is not None:
        new.type = "IMAGE_EDITOR"
        _split_off[:] = [new.as_pointer()]
    return new


_split_off: list[int] = []
"""The image editor that ``show_beside`` has split off, by its address, which is compared and never followed."""


def close_beside(scene: bpy.types.Scene) -> None:
    """Close the image editor that ``show_beside`` has opened, if it is still one; the viewport takes its place.

    In a moment: an operator that closes an editor loses what it reports. The photo of ``scene`` is fitted to the
    size that the viewport gets, before it is drawn with that.
    """
    if not bpy.app.background:
        bpy.app.timers.register(functools.partial(_close_split_off, scene.session_uid), first_interval=0.1)


def _close_split_off(uid: int) -> None:
    for window in bpy.context.window_manager.windows:
        areas = window.screen.areas
        area = next((a for a in areas if a.as_pointer() in _split_off and a.type == "IMAGE_EDITOR"), None)
        if area is None or len(areas) < 2:
            continue
        beside = [a for a in areas if a.type == "VIEW_3D" and (a.y, a.height) == (area.y, area.height)]
        view = min(beside, key=lambda a: max(area.x - a.x - a.width, a.x - area.x - area.width), default=None)
        width = 0 if view is None else max(area.x + area.width, view.x + view.width) - min(area.x, view.x)
        with bpy.context.temp_override(window=window, area=area):
            bpy.ops.screen.area_close()
        if view is not None and window.scene.session_uid == uid:
            _fit_photo(window.scene, view, width)
        bpy.app.timers.register(functools.partial(_fit_again, uid, width), first_interval=0.2)
    _split_off.clear()


def _fit_photo(scene: bpy.types.Scene, area: bpy.types.Area, width: int) -> None:
    """Fit the photo of ``scene`` to the viewport ``area`` as it is once it is ``width`` pixels wide."""
    view, camera = area.spaces.active.region_3d, scene.camera
    if view is None or view.view_perspective != "CAMERA" or camera is None or camera.type != "CAMERA":
        return
    region = next(region for region in area.regions if region.type == "WINDOW")
    wide = region.width + width - area.width
    render = scene.render
    size = render.resolution_x * render.pixel_aspect_x, render.resolution_y * render.pixel_aspect_y
    view.view_camera_offset = 0.0, 0.0
    view.view_camera_zoom = zoom_of_whole(wide, region.height, size, fit=camera.data.sensor_fit)
    if bpy.context.preferences.system.use_region_overlap:
        _leave_sidebar_free(view, wide, area)


def _fit_again(uid: int, width: int) -> None:
    """Fit the photo where the viewport is not as wide as foreseen: another editor took the place."""
    # A timer has no window of its own.
    for window in bpy.context.window_manager.windows:
        views = [area for area in window.screen.areas if area.type == "VIEW_3D"]
        if window.scene.session_uid == uid and all(area.width != width for area in views):
            with bpy.context.temp_override(window=window):
                show_photo(bpy.context, window.scene)


def remove_entry(entries: bpy.types.bpy_prop_collection, index: int) -> int:
    """Remove entry ``index`` of a list and return the index of the one that is active then."""
    entries.remove(index)
    return max(min(index, len(entries) - 1), 0)
