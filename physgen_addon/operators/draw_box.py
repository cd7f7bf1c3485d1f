# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw boxes around the objects of the photo, in any image editor that shows it."""

from __future__ import annotations

from typing import Any

import bpy

from ..photo_request import LEAST_PX
from ..photo_view import on_screen, place_under, region_under, shows_photo, why_not_seen

CHOSEN, OTHER, DRAGGED = (1.0, 0.55, 0.1, 1.0), (1.0, 1.0, 1.0, 0.8), (1.0, 0.8, 0.2, 1.0)
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
        why = why_not_seen(context)
        if why:
            cls.poll_message_set(why)
        return not why

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
            region = region_under(context, image, event)
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


def _pixel(scene: bpy.types.Scene, region: bpy.types.Region, event: bpy.types.Event) -> tuple[int, int]:
    """The upright photo's pixel under the mouse, from its top left corner; may lie outside."""
    u, v = place_under(region, event)
    return round(u * scene.physgen_photo.width), round(v * scene.physgen_photo.height)


def _label(box: bpy.types.PropertyGroup) -> str:
    return box.name if box.mask is None else f"{box.name} (mask)"


def _draw_boxes() -> None:
    """Called by Blender when an image editor draws; in pixels of its region."""
    import blf
    import gpu
    from gpu_extras.batch import batch_for_shader

    context = bpy.context
    state = context.scene.physgen_photo
    if not shows_photo(context):
        return
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    scale = context.preferences.system.ui_scale
    lines = [
        ((box.x0, box.y0, box.x1, box.y1), CHOSEN if index == state.box_index else OTHER, _label(box))
        for index, box in enumerate(state.boxes)
    ]
    lines += [(corners, DRAGGED, "") for corners in _dragged]
    gpu.state.blend_set("ALPHA")
    gpu.state.line_width_set(2.0 * scale)
    for (x0, y0, x1, y1), colour, name in lines:
        places = [
            on_screen(context.region, x / state.width, y / state.height)
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
