# SPDX-License-Identifier: GPL-3.0-or-later
"""Move the horizon over the photo, in any image editor that shows it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

from .. import horizon_maths
from ..chosen import scene_with
from ..photo_view import on_screen, place_under, region_under, shows_photo, why_not_seen
from ..views import redraw

TOLD, FOUND = (0.2, 0.9, 1.0, 1.0), (1.0, 1.0, 1.0, 0.8)
HELP = (
    "Drag the horizon: the middle moves it, left and right third turn it    Enter, Esc, right click: done    "
    "It may lie outside the photo"
)

_handlers: list[Any] = []


def aspect(state: bpy.types.PropertyGroup) -> float:
    """Width over height of the photo."""
    return state.width / max(state.height, 1)


def take_over(state: bpy.types.PropertyGroup) -> None:
    """Let the horizon be told from now on, beginning with the one that was found last."""
    if state.camera == "HORIZON":
        return
    found = (state.found_horizon, state.found_roll)
    state.horizon, state.roll = found if state.has_found else (horizon_maths.usual(aspect(state)), 0.0)
    state.camera = "HORIZON"


def drag(state: bpy.types.PropertyGroup, start: tuple[float, float], at: float, by: float) -> None:
    """Set horizon and roll, which were ``start``, as after a drag by the fraction ``by`` of the height from ``at``."""
    left, right = horizon_maths.dragged(*horizon_maths.ends(*start, aspect(state)), at, by)
    state.horizon, state.roll = horizon_maths.of_ends(left, right, aspect(state))


class PHYSGEN_OT_set_horizon(bpy.types.Operator):
    """Drag the horizon over the photo. Begins with the one that was found last"""

    bl_idname = "physgen.set_horizon"
    bl_label = "Set Horizon"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The photo is seen."""
        why = why_not_seen(context)
        if why:
            cls.poll_message_set(why)
        return not why

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show the horizon and wait for drags."""
        take_over(context.scene.physgen_photo)
        self._scene = context.scene.session_uid
        self._grip: tuple[bpy.types.Region, tuple[float, float], tuple[float, float]] | None = None
        context.window.cursor_modal_set("MOVE_Y")
        context.workspace.status_text_set(HELP)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Drags, until it is done."""
        scene = scene_with(self._scene)
        if scene is None or scene.physgen_photo.image is None:
            return self._end(context, "CANCELLED")
        state = scene.physgen_photo
        if event.type in ("RET", "NUMPAD_ENTER", "ESC", "RIGHTMOUSE") and event.value == "PRESS":
            return self._end(context, "FINISHED")
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            region = region_under(context, state.image, event)
            if region is None:
                # Whoever clicks elsewhere wants to do something else.
                return self._end(context, "FINISHED")
            self._grip = (region, place_under(region, event), (state.horizon, state.roll))
        elif self._grip is None:
            # Zooming and panning go on.
            return {"PASS_THROUGH"}
        elif event.type == "MOUSEMOVE":
            region, begun, start = self._grip
            drag(state, start, begun[0], place_under(region, event)[1] - begun[1])
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._grip = None
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator itself: another file is loaded, or it quits."""
        self._end(context, "CANCELLED")

    def _end(self, context: bpy.types.Context, how: str) -> set[str]:
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        redraw("IMAGE_EDITOR")
        return {how}


def draw_horizon(
    place: Callable[[float, float], Any],
    ends: tuple[float, float],
    colour: tuple[float, float, float, float],
    label: str,
    top: float,
    scale: float,
) -> None:
    """The line from the photo's left to its right edge, its name above it, and handles where it is told, not found.

    place: pixels of the region by fractions of the photo. top: of the region; a line above it is named at its border.
    """
    import blf
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    left, right = ends
    points = [place(u, left + u * (right - left)) for u in (0.0, 1 / 6, 0.5, 5 / 6, 1.0)]
    gpu.state.blend_set("ALPHA")
    # Dark below bright, to be seen on every photo.
    for width, tone in ((4.0, (0.0, 0.0, 0.0, 0.6 * colour[3])), (2.0, colour)):
        gpu.state.line_width_set(width * scale)
        shader.uniform_float("color", tone)
        batch_for_shader(shader, "LINES", {"pos": [(*points[0], 0.0), (*points[-1], 0.0)]}).draw(shader)
        size = (3 + width) * scale
        for x, y in points[1:-1] if colour == TOLD else ():
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


def horizon_shown(state: bpy.types.PropertyGroup) -> tuple[tuple[float, float], tuple[float, ...], str] | None:
    """Heights at the edges, colour and name of the horizon to draw: the one that is told, else the one found."""
    if state.camera == "HORIZON":
        return horizon_maths.ends(state.horizon, state.roll, aspect(state)), TOLD, f"horizon {state.horizon:.2f}"
    if not state.has_found:
        return None
    label = f"horizon as found {state.found_horizon:.2f}"
    return horizon_maths.ends(state.found_horizon, state.found_roll, aspect(state)), FOUND, label


def _draw() -> None:
    """Called by Blender when an image editor draws; in pixels of its region."""
    context = bpy.context
    if not shows_photo(context):
        return
    shown = horizon_shown(context.scene.physgen_photo)
    if shown is not None:
        region, scale = context.region, context.preferences.system.ui_scale
        draw_horizon(lambda u, v: on_screen(region, u, v), *shown, region.height, scale)


CLASSES = (PHYSGEN_OT_set_horizon,)


def register() -> None:
    """Draw the horizon over the photo from now on."""
    _handlers.append(bpy.types.SpaceImageEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    """Draw it no more."""
    for handler in _handlers:
        bpy.types.SpaceImageEditor.draw_handler_remove(handler, "WINDOW")
    _handlers.clear()
