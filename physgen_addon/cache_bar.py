# SPDX-License-Identifier: GPL-3.0-or-later
"""The bar of cached frames at the lower edge of timelines, as Blender draws it for its own point caches."""

from __future__ import annotations

from typing import Any

import bpy

from . import bake_state
from .bake_state import BakeState

HEIGHT_PX = 4.0
COLOURS = {
    "baked": (0.30, 0.62, 0.95, 0.9),
    "baking": (0.30, 0.62, 0.95, 0.9),
    "paused": (0.30, 0.62, 0.95, 0.9),
    "stale": (0.85, 0.55, 0.15, 0.9),
}
"""By the bake's state; those without frames have no bar."""
MISSING = (0.5, 0.5, 0.5, 0.45)
"""Of frames that the bake will have, and does not have yet."""

Span = tuple[float, float, tuple[float, float, float, float]]


def spans(found: BakeState | None) -> list[Span]:
    """Return what is drawn, as first and last frame and colour: half a frame on either side belongs to a frame.

    found: the last observed state; None if the scene has not been observed yet.
    """
    if found is None or found.status not in COLOURS or found.frames < 1:
        return []
    start = found.frame_start - 0.5
    done, end = start + min(found.frames_done, found.frames), start + found.frames
    drawn: list[Span] = [(start, done, COLOURS[found.status])] if done > start else []
    return [*drawn, (done, end, MISSING)] if end > done else drawn


def _draw() -> None:
    """Draw callback of timelines and dope sheets; in pixels of the region."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    context = bpy.context
    found = spans(bake_state.last_seen(context.scene))
    if not found:
        return
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    view, top = context.region.view2d, HEIGHT_PX * context.preferences.system.ui_scale
    gpu.state.blend_set("ALPHA")
    for first, last, colour in found:
        left, right = (view.view_to_region(frame, 0.0, clip=False)[0] for frame in (first, last))
        corners = [(left, 0.0, 0.0), (right, 0.0, 0.0), (right, top, 0.0), (left, top, 0.0)]
        shader.uniform_float("color", colour)
        batch_for_shader(shader, "TRIS", {"pos": corners}, indices=[(0, 1, 2), (0, 2, 3)]).draw(shader)
    gpu.state.blend_set("NONE")


_handlers: list[Any] = []


def register_cache_bar() -> None:
    """Add the draw callback."""
    _handlers.append(bpy.types.SpaceDopeSheetEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def unregister_cache_bar() -> None:
    """Remove the draw callback."""
    for handler in _handlers:
        bpy.types.SpaceDopeSheetEditor.draw_handler_remove(handler, "WINDOW")
    _handlers.clear()
