# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared by the panels of the tab "PhysGen": order, locking while a bake runs, job progress, live preview."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from .. import bake_state, blend_trust, text
from ..background_jobs import Job, PHYSGEN_OT_cancel_job, progress_text, running
from ..context import TAB
from ..gizmos import SHOW_ARROWS
from ..interpreter import TERMINAL, is_set_up
from ..preview import live_preview
from ..preview.live_preview import PHYSGEN_OT_toggle_preview
from ..props.body_props import is_body
from ..props.preferences import PHYSGEN_AP_preferences, python
from ..render.render_options import VIDEO_CODECS

SCENE, OBJECTS, MOTION, SIMULATE, RENDER, WORLD, COMPOSE, DIAGNOSE = range(8)
"""``bl_order``: the order of a first visit, so that Bake is in sight; what few need comes last."""

BAKE_LABELS = {"paused": "Resume", "baked": "Bake Again", "stale": "Bake Again", "missing": "Bake Again"}
BAKE_ICONS = {"paused": "PLAY", "none": "PHYSICS"}
"""By the bake's state."""

COMMAND = f" In {TERMINAL}:"
"""Prefix of the command that installs missing packages (``interpreter``)."""


RESULTS = (".png", ".exr", *VIDEO_CODECS)
"""Suffixes of rendered files."""


class Sidebar:
    """Mixin of panels in the 3D viewport's sidebar."""

    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", TAB


def is_baking(scene: bpy.types.Scene) -> bool:
    """Return whether inputs of the bake are locked."""
    return bake_state.state(scene).status == "baking"


def settings(layout: bpy.types.UILayout, context: bpy.types.Context, *, why: bool = False) -> bpy.types.UILayout:
    """Return a column for settings that affect the bake: names left, values right; locked while one runs.

    why: draw the reason above it; once a panel is enough.
    """
    locked = is_baking(context.scene)
    if locked and why:
        text.sentences(layout, context, "Locked while baking. Pause the bake to edit.", icon="LOCKED")
    column = layout.column()
    column.use_property_split, column.use_property_decorate = True, False
    column.enabled = not locked
    return column


def edited_list(
    layout: bpy.types.UILayout, kind: str, data: Any, entries: str, index: str, add: str, remove: str, *, rows: int = 2
) -> None:
    """Draw the collection ``entries`` of ``data``, whose active one is ``index``, with buttons to add and remove one.

    kind: the class of list. add, remove: operators.
    """
    row = layout.row()
    row.template_list(kind, "", data, entries, data, index, rows=rows)
    side = row.column(align=True)
    side.operator(add, text="", icon="ADD")
    side.operator(remove, text="", icon="REMOVE")


def optional(
    layout: bpy.types.UILayout, data: Any, switched_by: str, value: str, heading: str, *, otherwise: str = ""
) -> None:
    """Draw the checkbox ``switched_by`` and, beside it, the number ``value``, which counts while that is on.

    otherwise: what counts while it is off; empty for nothing.
    """
    row = layout.row(heading=heading, align=True)
    row.prop(data, switched_by, text="")
    field = row.row(align=True)
    field.enabled = getattr(data, switched_by)
    if otherwise and not field.enabled:
        field.label(text=otherwise)
    else:
        field.prop(data, value, text="")


def draw_static_friction_note(layout: bpy.types.UILayout, context: bpy.types.Context, surface: Any) -> None:
    """Draw the effective static friction where ``surface`` (a body or the world) has less than sliding friction."""
    if surface.static_friction < surface.friction:
        words = f"Static friction counts as {surface.friction:.3g}: it is never below the sliding one."
        text.sentences(layout, context, words, icon="INFO")


def draw_trouble(layout: bpy.types.UILayout, context: bpy.types.Context, message: str, *, icon: str = "NONE") -> None:
    """Draw an error; for a Python problem, buttons that install or choose one instead of a long command."""
    words, command, _ = message.partition(COMMAND)
    text.sentences(layout, context, text.brief(words), icon=icon)
    if command:
        _draw_set_up(layout)


def _draw_set_up(layout: bpy.types.UILayout) -> None:
    row = layout.row(align=True)
    row.operator("physgen.install_python", text="Install…", icon="IMPORT")
    button = row.operator("preferences.addon_show", text="Choose…", icon="PREFERENCES")
    button.module = PHYSGEN_AP_preferences.bl_idname


def draw_missing_python(layout: bpy.types.UILayout, context: bpy.types.Context) -> bool:
    """Draw that the Python which simulates is still to be set up, before anything is tried; return whether it is."""
    if is_set_up(python(context)):
        return False
    box = layout.box()
    words = "Before the first bake: simulations run in a Python of their own, which is not set up yet."
    text.sentences(box, context, words, icon="INFO")
    _draw_set_up(box)
    return True


def draw_bake_button(layout: bpy.types.UILayout, status: str, *, ready: bool = True) -> None:
    """Draw *Bake*, as it is called in that state of the bake; grey where nothing can be baked yet."""
    row = layout.row(align=True)
    row.scale_y = 1.4
    row.enabled = ready
    label, icon = BAKE_LABELS.get(status, "Bake"), BAKE_ICONS.get(status, "FILE_REFRESH")
    row.operator(bake_state.BAKE_OPERATOR, text=label, icon=icon)


def draw_result(layout: bpy.types.UILayout, rendering: bpy.types.PropertyGroup) -> None:
    """Draw the name of what was rendered last, and buttons that open it and its folder."""
    if not rendering.result or blend_trust.is_pending(rendering.result):
        return
    path = Path(bpy.path.abspath(rendering.result))
    # A .blend from elsewhere may set any path here, and Open passes it to the operating system.
    if not blend_trust.may_open(path, RESULTS):
        return
    row = layout.row(align=True)
    row.label(text=path.name, icon="CHECKMARK")
    row.operator("wm.path_open", text="Open").filepath = str(path)
    if blend_trust.may_open(path.parent):
        row.operator("wm.path_open", text="", icon="FILE_FOLDER").filepath = str(path.parent)


def draw_trust(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw what somebody else's file asks for, and the way to agree to it; nothing where nothing waits."""
    waiting = len(blend_trust.pending(context.scene))
    if waiting:
        box = layout.box()
        words = f"This file names {text.count(waiting, 'path')} outside its folder, left alone until you agree."
        text.sentences(box, context, words, icon="ERROR")
        box.operator("physgen.trust_file", text="Look and Agree…", icon="CHECKMARK").go_on = False


def active_body(context: bpy.types.Context) -> Any:
    """Return the active object if it is simulated."""
    item = context.active_object
    return item if is_body(item) else None


def is_in(item: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Return whether ``item`` is in the scene; a deleted object lives on while it is referenced."""
    return scene.objects.get(item.name) == item


def draw_job(layout: bpy.types.UILayout, context: bpy.types.Context, *titles: str) -> bool:
    """Draw progress and Cancel of the running job if it has one of ``titles``, else that another runs; return whether
    any does.
    """
    job = running()
    if job is None:
        return False
    if job.title in titles:
        draw_progress(layout, context, job).operator(PHYSGEN_OT_cancel_job.bl_idname, text="", icon="X")
    else:
        text.sentences(layout, context, f"{job.title} is running; continue when it is done.", icon="INFO")
    return True


def draw_progress(layout: bpy.types.UILayout, context: bpy.types.Context, job: Job) -> bpy.types.UILayout:
    """Draw a progress bar and the message of ``job``; return the bar's row, for a button beside it."""
    column = layout.column(align=True)
    row = column.row(align=True)
    row.scale_y = 1.4
    row.progress(factor=job.fraction or 0.0, text=progress_text(job))
    words = job.message or _frames_done(job)
    if words:
        text.sentences(column, context, words)
    return row


def _frames_done(job: Job) -> str:
    """Return how far a job of frames is, in words; a line that stays, so that what is below it does not jump."""
    if job.stage not in ("bake", "render") or job.done is None:
        return ""
    words = f"Frame {job.done} of {job.total}"
    return f"{words}; Space plays them" if job.stage == "bake" and job.done > 0 else words


NOTICE = 120
"""Maximum length of a notice in characters."""

WORDS = {
    "starting": ("Starting the worker", "TIME"),
    "compiling": ("Preparing: seconds, once", "TIME"),
    "running": ("Simulating", "PLAY"),
    "playing": ("Playing", "PLAY"),
}


def draw_preview(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the button, the preview's state, and differences from the bake."""
    session = live_preview.session()
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
    # All notices would push the Bake button out of sight; a bake reports all of them.
    for notice in session.notices[:1]:
        text.sentences(column, context, text.brief(notice, NOTICE), icon="INFO")
    if len(session.notices) > 1:
        column.label(text=f"and {len(session.notices) - 1} more; a bake lists them all", icon="BLANK1")


def draw_arrows(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the toggle of the viewport arrows, for the panel of initial motion."""
    layout.prop(context.window_manager, SHOW_ARROWS, icon="EMPTY_SINGLE_ARROW")
