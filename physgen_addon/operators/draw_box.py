# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw boxes around the objects of the photo, in any image editor that shows it."""

from __future__ import annotations

from typing import Any

import bpy
from mathutils import Vector

CHOSEN, OTHER, DRAGGED = (1.0, 0.55, 0.1, 1.0), (1.0, 1.0, 1.0, 0.8), (1.0, 0.8, 0.2, 1.0)
LEAST_PX = 8
"""A smaller rectangle is a slip of the hand, not an object."""

_dragged: list[tuple[int, int, int, int]] = []
"""The rectangle under the mouse, at most one; it ends with the drag and is no part of any file."""
_handlers: list[Any] = []


def add_box(scene: bpy.types.Scene, corners: tuple[int, int, int, int], name: str = "") -> bpy.types.PropertyGroup:
    """Add a box x0, y0, x1, y1 in pixels of the upright photo, cut to it, and choose it."""
    state = scene.physgen_photo
    box = state.boxes.add()
    box.x0, box.x1 = (max(0, min(x, state.width)) for x in sorted(corners[0::2]))
    box.y0, box.y1 = (max(0, min(y, state.height)) for y in sorted(corners[1::2]))
    taken = {other.name for other in state.boxes}
    box.name = name or next(f"object {n}" for n in range(1, len(state.boxes) + 1) if f"object {n}" not in taken)
    state.box_index = len(state.boxes) - 1
    return box


class PHYSGEN_OT_draw_box(bpy.types.Operator):
    """Drag a box around an object of the photo in the image editor; loose is fine"""

    bl_idname = "physgen.draw_box"
    bl_label = "Draw Box"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is a photo to draw on, and it is seen."""
        image = context.scene.physgen_photo.image
        if image is None:
            cls.poll_message_set("Open a photo first")
            return False
        if context.window is None or not _regions(context, image):
            cls.poll_message_set("No image editor shows the photo")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Wait for the drag."""
        self._start: tuple[int, int] | None = None
        self._region: bpy.types.Region | None = None
        context.window.cursor_modal_set("CROSSHAIR")
        context.workspace.status_text_set("Drag a box around an object    Esc, right click: stop")
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """From press to release."""
        image = context.scene.physgen_photo.image
        if image is None or event.type in ("ESC", "RIGHTMOUSE"):
            return self._end(context, "CANCELLED")
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            region = _region_under(context, image, event)
            if region is None:
                self.report({"INFO"}, "drag inside the picture in the image editor")
                return self._end(context, "CANCELLED")
            self._region, self._start = region, _pixel(context.scene, region, event)
        elif self._start is None or self._region is None:
            # Zooming and panning go on.
            return {"PASS_THROUGH"}
        elif event.type == "MOUSEMOVE":
            _dragged[:] = [(*self._start, *_pixel(context.scene, self._region, event))]
            self._region.tag_redraw()
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            corners = (*self._start, *_pixel(context.scene, self._region, event))
            if min(abs(corners[2] - corners[0]), abs(corners[3] - corners[1])) < LEAST_PX:
                return self._end(context, "CANCELLED")
            add_box(context.scene, corners)
            return self._end(context, "FINISHED")
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator itself: another file is loaded, or it quits."""
        self._end(context, "CANCELLED")

    def _end(self, context: bpy.types.Context, how: str) -> set[str]:
        _dragged.clear()
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        for area in context.window.screen.areas:
            area.tag_redraw()
        return {how}


def _regions(context: bpy.types.Context, image: bpy.types.Image) -> list[bpy.types.Region]:
    """The regions of the window in which the photo is seen."""
    return [
        region
        for area in context.window.screen.areas
        if area.type == "IMAGE_EDITOR" and area.spaces.active.image == image
        for region in area.regions
        if region.type == "WINDOW"
    ]


def _region_under(
    context: bpy.types.Context, image: bpy.types.Image, event: bpy.types.Event
) -> bpy.types.Region | None:
    """The one under the mouse, unless a sidebar lies over it there."""
    x, y = event.mouse_x, event.mouse_y
    for region in _regions(context, image):
        area = next(area for area in context.window.screen.areas if region in area.regions.values())
        covers = [r for r in area.regions if r.type != "WINDOW" and r.width > 1 and r.height > 1]
        if _inside(region, x, y) and not any(_inside(cover, x, y) for cover in covers):
            return region
    return None


def _inside(region: bpy.types.Region, x: int, y: int) -> bool:
    return 0 <= x - region.x < region.width and 0 <= y - region.y < region.height


def _pixel(scene: bpy.types.Scene, region: bpy.types.Region, event: bpy.types.Event) -> tuple[int, int]:
    """The upright photo's pixel under the mouse, from its top left corner; may lie outside."""
    u, v = region.view2d.region_to_view(event.mouse_x - region.x, event.mouse_y - region.y)
    state = scene.physgen_photo
    return round(u * state.width), round((1 - v) * state.height)


def _draw_boxes() -> None:
    """Called by Blender when an image editor draws; in pixels of its region."""
    import blf
    import gpu
    from gpu_extras.batch import batch_for_shader

    context = bpy.context
    state = context.scene.physgen_photo
    if state.image is None or not state.width or context.space_data.image != state.image:
        return
    view, shader = context.region.view2d, gpu.shader.from_builtin("UNIFORM_COLOR")
    scale = context.preferences.system.ui_scale
    lines = [
        ((box.x0, box.y0, box.x1, box.y1), CHOSEN if index == state.box_index else OTHER, box.name)
        for index, box in enumerate(state.boxes)
    ]
    lines += [(corners, DRAGGED, "") for corners in _dragged]
    gpu.state.blend_set("ALPHA")
    gpu.state.line_width_set(2.0 * scale)
    for (x0, y0, x1, y1), colour, name in lines:
        places = [
            Vector(view.view_to_region(x / state.width, 1 - y / state.height, clip=False))
            for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
        ]
        shader.uniform_float("color", colour)
        batch_for_shader(shader, "LINE_LOOP", {"pos": [(*place, 0.0) for place in places]}).draw(shader)
        if name:
            top = max(place.y for place in places)
            blf.size(0, 12.0 * scale)
            blf.color(0, *colour)
            blf.position(0, min(place.x for place in places), top + 4 * scale, 0)
            blf.draw(0, name)
    gpu.state.line_width_set(1.0)
    gpu.state.blend_set("NONE")


CLASSES = (PHYSGEN_OT_draw_box,)


def register() -> None:
    """Draw the boxes over the photo from now on."""
    _handlers.append(bpy.types.SpaceImageEditor.draw_handler_add(_draw_boxes, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    """Draw them no more."""
    for handler in _handlers:
        bpy.types.SpaceImageEditor.draw_handler_remove(handler, "WINDOW")
    _handlers.clear()
    _dragged.clear()
