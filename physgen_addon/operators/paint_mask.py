# SPDX-License-Identifier: GPL-3.0-or-later
"""Paint the mask of an object over the photo, in any image editor that shows it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..chosen import scene_with
from ..mask_painting import Painting, tint
from ..photo_masks import drop_mask, first_mask, store_mask, widen
from ..photo_scene import found_mask
from ..photo_view import on_screen, place_under, region_under, shows_photo, why_not_seen, width_of_pixel
from ..views import redraw

BRUSH_PX, LEAST_BRUSH_PX, MOST_BRUSH_PX = 20.0, 1.0, 500.0
"""Radius in pixels of the screen: zooming in makes a finer brush."""
STEP = 1.2
HELP = (
    "Left: add    Ctrl or Shift + Left: remove    [ ] or Ctrl + Wheel: size    Ctrl + Z: a stroke back    "
    "Enter, Esc, right click: done"
)


@dataclass
class _Session:
    """What is painted now. region, mouse: where the brush is shown, in the window's pixels."""

    painting: Painting
    scene: int
    box: int
    brush: float = BRUSH_PX
    region: bpy.types.Region | None = None
    mouse: tuple[int, int] = (0, 0)
    texture: Any = None
    shown: int = -1


_sessions: list[_Session] = []
"""At most one; it ends with the painting and is no part of any file."""
_brush = [BRUSH_PX]
"""As it was left."""
_handlers: list[Any] = []


def chosen_box(context: bpy.types.Context) -> bpy.types.PropertyGroup | None:
    """The chosen box of the photo."""
    state = context.scene.physgen_photo
    return state.boxes[state.box_index] if 0 <= state.box_index < len(state.boxes) else None


class PHYSGEN_OT_paint_mask(bpy.types.Operator):
    """Paint over the photo where the chosen object is seen. Begins with what was found of it last"""

    bl_idname = "physgen.paint_mask"
    bl_label = "Paint Mask"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """A box is chosen, and the photo is seen."""
        why = "Choose a box first" if chosen_box(context) is None else why_not_seen(context)
        why = why or ("A mask is being painted" if _sessions else "")
        if why:
            cls.poll_message_set(why)
        return not why

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the mask and wait for strokes."""
        state, box = context.scene.physgen_photo, chosen_box(context)
        found = found_mask(state, box)
        painting = Painting(first_mask(state, box, found or Path()))
        self._session = _Session(painting, context.scene.session_uid, state.box_index, _brush[0])
        _sessions[:] = [self._session]
        context.window.cursor_modal_set("PAINT_CROSS")
        context.workspace.status_text_set(HELP)
        context.window_manager.modal_handler_add(self)
        redraw("IMAGE_EDITOR")
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Strokes, until it is done."""
        session, scene = self._session, scene_with(self._session.scene)
        # The extension was disabled, or the box is gone.
        if session not in _sessions or scene is None or session.box >= len(scene.physgen_photo.boxes):
            return self._end(context, "CANCELLED")
        state = scene.physgen_photo
        session.mouse = (event.mouse_x, event.mouse_y)
        if event.type in ("RET", "NUMPAD_ENTER", "ESC", "RIGHTMOUSE") and event.value == "PRESS":
            return self._done(context, state)
        if event.type == "LEFTMOUSE":
            return self._button(context, state, event)
        if event.type == "Z" and event.ctrl:
            if event.value == "PRESS":
                session.painting.undo()
        elif factor := _size_change(event):
            session.brush = _brush[0] = min(max(session.brush * factor, LEAST_BRUSH_PX), MOST_BRUSH_PX)
        elif event.type not in ("MOUSEMOVE", "INBETWEEN_MOUSEMOVE"):
            # Zooming and panning go on.
            return {"PASS_THROUGH"}
        elif session.painting.is_in_stroke:
            session.painting.move(*self._place(event))
        else:
            session.region = region_under(context, state.image, event)
        redraw("IMAGE_EDITOR", "WINDOW")
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator itself: another file is loaded, or it quits."""
        self._end(context, "CANCELLED")

    def _button(self, context: bpy.types.Context, state: bpy.types.PropertyGroup, event: bpy.types.Event) -> set[str]:
        session = self._session
        if event.value == "PRESS":
            session.region = region_under(context, state.image, event)
            if session.region is None:
                # Whoever clicks elsewhere wants to do something else.
                return self._done(context, state)
            place, radius = self._place(event)
            session.painting.press(place, radius, adds=not (event.ctrl or event.shift))
        elif event.value == "RELEASE":
            session.painting.release()
        redraw("IMAGE_EDITOR", "WINDOW")
        return {"RUNNING_MODAL"}

    def _place(self, event: bpy.types.Event) -> tuple[tuple[float, float], float]:
        """Where the brush is in pixels of the mask, and its radius there."""
        session = self._session
        height, width = session.painting.mask.shape
        u, v = place_under(session.region, event)
        return (u * width, v * height), session.brush * width_of_pixel(session.region) * width

    def _done(self, context: bpy.types.Context, state: bpy.types.PropertyGroup) -> set[str]:
        painting, box = self._session.painting, state.boxes[self._session.box]
        if not painting.changed:
            return self._end(context, "CANCELLED")
        if store_mask(box, painting.mask) is None:
            self.report({"INFO"}, f"the mask of {box.name} is empty: the object is cut out of its box")
        widen(state, box, painting.mask)
        return self._end(context, "FINISHED")

    def _end(self, context: bpy.types.Context, how: str) -> set[str]:
        _sessions.clear()
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        redraw("IMAGE_EDITOR")
        return {how}


def _size_change(event: bpy.types.Event) -> float:
    """By what the brush's size is to be multiplied; 0 for another event."""
    if event.value != "PRESS":
        return 0.0
    if event.type == "RIGHT_BRACKET" or (event.type == "WHEELUPMOUSE" and event.ctrl):
        return STEP
    return 1 / STEP if event.type == "LEFT_BRACKET" or (event.type == "WHEELDOWNMOUSE" and event.ctrl) else 0.0


class PHYSGEN_OT_clear_mask(bpy.types.Operator):
    """Forget the mask of the chosen box: the object is cut out of the box again"""

    bl_idname = "physgen.clear_mask"
    bl_label = "Clear Mask"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The chosen box has one."""
        box = chosen_box(context)
        if box is None or box.mask is None:
            cls.poll_message_set("The chosen box has no mask")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Clear it."""
        drop_mask(chosen_box(context))
        return {"FINISHED"}


def draw_tint(place: Callable[[float, float], Any], texture: Any) -> None:
    """Lay ``texture``, rows from the top, over the photo. place: pixels of the region by fractions of the photo."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("IMAGE")
    corners = ((0, 0), (1, 0), (1, 1), (0, 1))
    places = [(*place(u, v), 0.0) for u, v in corners]
    batch = batch_for_shader(shader, "TRI_FAN", {"pos": places, "texCoord": corners})
    gpu.state.blend_set("ALPHA")
    shader.bind()
    shader.uniform_sampler("image", texture)
    batch.draw(shader)
    gpu.state.blend_set("NONE")


def draw_brush(centre: tuple[float, float], radius: float) -> None:
    """A white circle beside a black one, to be seen on every photo; in pixels of the region."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    turns = [math.tau * step / 64 for step in range(64)]
    for size, colour in ((radius, (1.0, 1.0, 1.0, 1.0)), (radius + 1.5, (0.0, 0.0, 0.0, 1.0))):
        ring = [(centre[0] + size * math.cos(turn), centre[1] + size * math.sin(turn), 0.0) for turn in turns]
        shader.uniform_float("color", colour)
        batch_for_shader(shader, "LINE_LOOP", {"pos": ring}).draw(shader)


def tint_texture(painting: Painting) -> Any:
    """The tint on the graphics card."""
    import gpu

    picture = tint(painting.mask)
    height, width = picture.shape[:2]
    values = gpu.types.Buffer("FLOAT", picture.size, picture.ravel())
    return gpu.types.GPUTexture((width, height), format="RGBA16F", data=values)


def _draw() -> None:
    """Called by Blender when an image editor draws; in pixels of its region."""
    context = bpy.context
    if not _sessions or not shows_photo(context) or context.scene.session_uid != _sessions[0].scene:
        return
    session, region = _sessions[0], context.region
    if session.shown != session.painting.revision:
        session.texture, session.shown = tint_texture(session.painting), session.painting.revision
    draw_tint(lambda u, v: on_screen(region, u, v), session.texture)
    if region == session.region:
        draw_brush((session.mouse[0] - region.x, session.mouse[1] - region.y), session.brush)


CLASSES = (PHYSGEN_OT_paint_mask, PHYSGEN_OT_clear_mask)


def register() -> None:
    """Draw what is painted over the photo from now on."""
    _handlers.append(bpy.types.SpaceImageEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    """Draw it no more."""
    for handler in _handlers:
        bpy.types.SpaceImageEditor.draw_handler_remove(handler, "WINDOW")
    _handlers.clear()
    _sessions.clear()
