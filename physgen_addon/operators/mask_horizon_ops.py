# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: paint an object's mask and move the horizon over the photo."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..photo import photo_maths
from ..photo.photo_image import (
    PhotoTool,
    drop_mask,
    first_mask,
    on_screen,
    place_under,
    region_under,
    shows_photo,
    store_mask,
    widen,
    width_of_pixel,
)
from ..photo.photo_maths import Painting, tint
from ..photo.photo_request import found_mask

BRUSH_PX, LEAST_BRUSH_PX, MOST_BRUSH_PX = 20.0, 1.0, 500.0
"""Radius in screen pixels: zooming in makes a finer brush."""
STEP = 1.2
PAINT_HELP = (
    "Left: add    Ctrl or Shift + Left: remove    [ ] or Ctrl + Wheel: size    Ctrl + Z: undo stroke    "
    "Enter, Esc, right click: done"
)


@dataclass
class _Session:
    """State of painting. region, mouse: where the brush is shown, in the window's pixels."""

    painting: Painting
    scene: int
    brush: float = BRUSH_PX
    region: bpy.types.Region | None = None
    mouse: tuple[int, int] = (0, 0)
    texture: Any = None
    shown: int = -1


_sessions: list[_Session] = []
"""The active session, at most one; not stored in any file."""
_brush = [BRUSH_PX]
"""Last used radius."""
_mask_handlers: list[Any] = []


def chosen_box(context: bpy.types.Context) -> bpy.types.PropertyGroup | None:
    """Return the active box of the photo."""
    state = context.scene.physgen_photo
    return state.boxes[state.box_index] if 0 <= state.box_index < len(state.boxes) else None


class PHYSGEN_OT_paint_mask(PhotoTool, bpy.types.Operator):
    """Paint the mask of the active object over the photo, starting from the last estimated mask"""

    bl_idname = "physgen.paint_mask"
    bl_label = "Paint Mask"
    bl_options = {"UNDO"}  # noqa: RUF012

    tool_cursor = "PAINT_CROSS"
    tool_help = PAINT_HELP

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        """Return why no mask can be painted: no active box, no visible photo, or one is being painted."""
        why = "Choose a box first" if chosen_box(context) is None else super().why_not(context)
        return why or ("A mask is being painted" if _sessions else "")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the mask and wait for strokes."""
        state, box = context.scene.physgen_photo, chosen_box(context)
        found = found_mask(state, box)
        painting = Painting(first_mask(state, box, found or Path()))
        self.tool_box = state.box_index
        self._session = _Session(painting, context.scene.session_uid, _brush[0])
        _sessions[:] = [self._session]
        return self.begin(context)

    def photo_state(self) -> bpy.types.PropertyGroup | None:
        """Return the photo's settings; None also if the extension was disabled."""
        return PhotoTool.photo_state(self) if self._session in _sessions else None

    def press(self, state: bpy.types.PropertyGroup, event: bpy.types.Event, region: bpy.types.Region) -> None:
        """Begin a stroke."""
        self._session.region, self._session.mouse = region, (event.mouse_x, event.mouse_y)
        place, radius = self._place(event)
        self._session.painting.press(place, radius, adds=not (event.ctrl or event.shift))

    def handle(self, context: bpy.types.Context, state: bpy.types.PropertyGroup, event: bpy.types.Event) -> bool:
        """Paint, end or undo a stroke, or change the brush."""
        session = self._session
        session.mouse = (event.mouse_x, event.mouse_y)
        if event.type == "LEFTMOUSE":
            if event.value == "RELEASE":
                session.painting.release()
        elif event.type == "Z" and event.ctrl:
            if event.value == "PRESS":
                session.painting.undo()
        elif factor := _size_change(event):
            session.brush = _brush[0] = min(max(session.brush * factor, LEAST_BRUSH_PX), MOST_BRUSH_PX)
        elif event.type not in ("MOUSEMOVE", "INBETWEEN_MOUSEMOVE"):
            return False
        elif session.painting.is_in_stroke:
            session.painting.move(*self._place(event))
        else:
            session.region = region_under(context, state.image, event)
        return True

    def _place(self, event: bpy.types.Event) -> tuple[tuple[float, float], float]:
        """Return the brush position in pixels of the mask, and its radius there."""
        session = self._session
        height, width = session.painting.mask.shape
        u, v = place_under(session.region, event)
        return (u * width, v * height), session.brush * width_of_pixel(session.region) * width

    def done(self, context: bpy.types.Context, state: bpy.types.PropertyGroup) -> set[str]:
        """Store the mask; without strokes nothing has changed."""
        painting, box = self._session.painting, state.boxes[self.tool_box]
        if not painting.changed:
            return self.end(context, "CANCELLED")
        if store_mask(box, painting.mask) is None:
            self.report({"INFO"}, f"the mask of {box.name} is empty: the object is segmented from its box")
        widen(state, box, painting.mask)
        return self.end(context, "FINISHED")

    def forget(self) -> None:
        """End the session."""
        _sessions.clear()


def _size_change(event: bpy.types.Event) -> float:
    """Return the factor for the brush's size; 0 for other events."""
    if event.value != "PRESS":
        return 0.0
    if event.type == "RIGHT_BRACKET" or (event.type == "WHEELUPMOUSE" and event.ctrl):
        return STEP
    return 1 / STEP if event.type == "LEFT_BRACKET" or (event.type == "WHEELDOWNMOUSE" and event.ctrl) else 0.0


class PHYSGEN_OT_clear_mask(bpy.types.Operator):
    """Remove the mask of the active box: the object is segmented from the box again"""

    bl_idname = "physgen.clear_mask"
    bl_label = "Clear Mask"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if the active box has a mask."""
        box = chosen_box(context)
        if box is None or box.mask is None:
            cls.poll_message_set("Active box has no mask")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Clear it."""
        drop_mask(chosen_box(context))
        return {"FINISHED"}


def draw_tint(place: Callable[[float, float], Any], texture: Any) -> None:
    """Draw ``texture``, top row first, over the photo. place: photo fractions → pixels of the region."""
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
    """Draw a white circle beside a black one, visible on every photo; in pixels of the region."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    turns = [math.tau * step / 64 for step in range(64)]
    for size, colour in ((radius, (1.0, 1.0, 1.0, 1.0)), (radius + 1.5, (0.0, 0.0, 0.0, 1.0))):
        ring = [(centre[0] + size * math.cos(turn), centre[1] + size * math.sin(turn), 0.0) for turn in turns]
        shader.uniform_float("color", colour)
        batch_for_shader(shader, "LINE_LOOP", {"pos": ring}).draw(shader)


def tint_texture(painting: Painting) -> Any:
    """Return the tint as a GPU texture."""
    import gpu

    picture = tint(painting.mask)
    height, width = picture.shape[:2]
    values = gpu.types.Buffer("FLOAT", picture.size, picture.ravel())
    return gpu.types.GPUTexture((width, height), format="RGBA16F", data=values)


def _draw_mask() -> None:
    """Draw callback of image editors; in pixels of the region."""
    context = bpy.context
    if not _sessions or not shows_photo(context) or context.scene.session_uid != _sessions[0].scene:
        return
    session, region = _sessions[0], context.region
    if session.shown != session.painting.revision:
        session.texture, session.shown = tint_texture(session.painting), session.painting.revision
    draw_tint(lambda u, v: on_screen(region, u, v), session.texture)
    if region == session.region:
        draw_brush((session.mouse[0] - region.x, session.mouse[1] - region.y), session.brush)


def register_mask_drawing() -> None:
    """Add the draw callback of the mask."""
    _mask_handlers.append(bpy.types.SpaceImageEditor.draw_handler_add(_draw_mask, (), "WINDOW", "POST_PIXEL"))


def unregister_mask_drawing() -> None:
    """Remove the draw callback of the mask."""
    for handler in _mask_handlers:
        bpy.types.SpaceImageEditor.draw_handler_remove(handler, "WINDOW")
    _mask_handlers.clear()
    _sessions.clear()


Colour = tuple[float, float, float, float]
USER_COLOUR, ESTIMATE_COLOUR = (0.2, 0.9, 1.0, 1.0), (1.0, 1.0, 1.0, 0.8)
"""Of the horizon that the user sets, and of the estimated one."""
HORIZON_HELP = (
    "Drag the horizon: the middle third moves it, the outer thirds rotate it    Enter, Esc, right click: done    "
    "It may lie outside the photo"
)

_horizon_handlers: list[Any] = []


def aspect(state: bpy.types.PropertyGroup) -> float:
    """Return width over height of the photo."""
    return state.width / max(state.height, 1)


def take_over(state: bpy.types.PropertyGroup) -> None:
    """Set the horizon manually from now on, starting with the last estimate."""
    if state.camera == "HORIZON":
        return
    found = (state.found_horizon, state.found_roll)
    state.horizon, state.roll = found if state.has_found else (photo_maths.usual(aspect(state)), 0.0)
    state.camera = "HORIZON"


def drag(state: bpy.types.PropertyGroup, start: tuple[float, float], at: float, by: float) -> None:
    """Set horizon and roll, which were ``start``, for a drag by the fraction ``by`` of the height from ``at``."""
    left, right = photo_maths.dragged(*photo_maths.ends(*start, aspect(state)), at, by)
    state.horizon, state.roll = photo_maths.of_ends(left, right, aspect(state))


class PHYSGEN_OT_set_horizon(PhotoTool, bpy.types.Operator):
    """Drag the horizon over the photo, starting with the last estimate"""

    bl_idname = "physgen.set_horizon"
    bl_label = "Set Horizon"
    bl_options = {"UNDO"}  # noqa: RUF012

    tool_cursor = "MOVE_Y"
    tool_help = HORIZON_HELP

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the horizon and wait for drags."""
        take_over(context.scene.physgen_photo)
        self._grip: tuple[bpy.types.Region, tuple[float, float], tuple[float, float]] | None = None
        return self.begin(context)

    def press(self, state: bpy.types.PropertyGroup, event: bpy.types.Event, region: bpy.types.Region) -> None:
        """Begin a drag."""
        self._grip = (region, place_under(region, event), (state.horizon, state.roll))

    def handle(self, context: bpy.types.Context, state: bpy.types.PropertyGroup, event: bpy.types.Event) -> bool:
        """Drag the horizon while the button is held."""
        if self._grip is None:
            return False
        if event.type == "MOUSEMOVE":
            region, begun, start = self._grip
            drag(state, start, begun[0], place_under(region, event)[1] - begun[1])
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._grip = None
        return True


def draw_horizon(
    place: Callable[[float, float], Any],
    ends: tuple[float, float],
    colour: tuple[float, float, float, float],
    label: str,
    top: float,
    scale: float,
) -> None:
    """Draw the line across the photo, its label above it, and handles if it is set by the user rather than estimated.

    place: photo fractions → pixels of the region. top: of the region; a line above it is labelled at its border.
    """
    import blf
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    left, right = ends
    points = [place(u, left + u * (right - left)) for u in (0.0, 1 / 6, 0.5, 5 / 6, 1.0)]
    gpu.state.blend_set("ALPHA")
    # Dark below bright, visible on every photo.
    for width, tone in ((4.0, (0.0, 0.0, 0.0, 0.6 * colour[3])), (2.0, colour)):
        gpu.state.line_width_set(width * scale)
        shader.uniform_float("color", tone)
        batch_for_shader(shader, "LINES", {"pos": [(*points[0], 0.0), (*points[-1], 0.0)]}).draw(shader)
        size = (3 + width) * scale
        for x, y in points[1:-1] if colour == USER_COLOUR else ():
            square = [(x - size, y - size, 0.0), (x + size, y - size, 0.0), (x + size, y + size, 0.0)]
            square.append((x - size, y + size, 0.0))
            batch_for_shader(shader, "TRI_FAN", {"pos": square}).draw(shader)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 3, 0.0, 0.0, 0.0, 0.9)
    blf.size(0, 12.0 * scale)
    blf.color(0, *colour)
    blf.position(0, points[0][0] + 6 * scale, min(max(points[0][1] + 8 * scale, 8 * scale), top - 20 * scale), 0)
    blf.draw(0, label)
    blf.disable(0, blf.SHADOW)
    gpu.state.line_width_set(1.0)
    gpu.state.blend_set("NONE")


def horizon_shown(state: bpy.types.PropertyGroup) -> tuple[tuple[float, float], Colour, str] | None:
    """Return heights at the edges, colour and label of the horizon: the user's, else the estimate."""
    if state.camera == "HORIZON":
        return photo_maths.ends(state.horizon, state.roll, aspect(state)), USER_COLOUR, f"horizon {state.horizon:.2f}"
    if not state.has_found:
        return None
    label = f"horizon as found {state.found_horizon:.2f}"
    return photo_maths.ends(state.found_horizon, state.found_roll, aspect(state)), ESTIMATE_COLOUR, label


def _draw_horizon() -> None:
    """Draw callback of image editors; in pixels of the region."""
    context = bpy.context
    if not shows_photo(context):
        return
    shown = horizon_shown(context.scene.physgen_photo)
    if shown is not None:
        region, scale = context.region, context.preferences.system.ui_scale
        draw_horizon(lambda u, v: on_screen(region, u, v), *shown, region.height, scale)


def register_horizon_drawing() -> None:
    """Add the draw callback of the horizon."""
    _horizon_handlers.append(bpy.types.SpaceImageEditor.draw_handler_add(_draw_horizon, (), "WINDOW", "POST_PIXEL"))


def unregister_horizon_drawing() -> None:
    """Remove the draw callback of the horizon."""
    for handler in _horizon_handlers:
        bpy.types.SpaceImageEditor.draw_handler_remove(handler, "WINDOW")
    _horizon_handlers.clear()
