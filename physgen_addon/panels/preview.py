# SPDX-License-Identifier: GPL-3.0-or-later
"""The live preview's button and what it is doing, for the panel that simulates; the arrows' switch."""

from __future__ import annotations

import bpy

from .. import text
from ..gizmos import SHOW_ARROWS
from ..operators.preview import PHYSGEN_OT_toggle_preview
from ..preview import live
from .sidebar import draw_trouble

NOTICE = 120
"""Characters of a notice."""

WORDS = {
    "starting": ("Starting the worker", "TIME"),
    "compiling": ("Preparing: seconds, once", "TIME"),
    "running": ("Simulating", "PLAY"),
    "playing": ("Playing", "PLAY"),
}


def draw_preview(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The button; below it what the preview is doing, and what differs from the bake."""
    session = live.session()
    column = layout.column(align=True)
    column.operator(
        PHYSGEN_OT_toggle_preview.bl_idname,
        text="Stop Live Preview" if session is not None else "Live Preview",
        icon="PAUSE" if session is not None else "PLAY",
        depress=session is not None,
    )
    if session is None:
        return
    scene = session.scene()
    if scene is not None and scene != context.scene:
        column.label(text=f"On in scene {scene.name}", icon="INFO")
        return
    if session.state == "error":
        draw_trouble(column, context, session.message, icon="ERROR")
        return
    words, icon = WORDS[session.state]
    column.label(text=f"{words}: {session.message}" if session.message else words, icon=icon)
    # What is said of each mesh would push the Bake button out of sight; a bake says all of it.
    for notice in session.notices[:1]:
        text.sentences(column, context, text.brief(notice, NOTICE), icon="INFO")
    if len(session.notices) > 1:
        column.label(text=f"and {len(session.notices) - 1} more; a bake says them all", icon="BLANK1")


def draw_arrows(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The switch of the arrows in the viewport, for the panel of the motion."""
    layout.prop(context.window_manager, SHOW_ARROWS, icon="EMPTY_SINGLE_ARROW")
