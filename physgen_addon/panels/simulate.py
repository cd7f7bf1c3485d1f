# SPDX-License-Identifier: GPL-3.0-or-later
"""Simulate: how finely, which frames, where; the bake and how it stands."""

from __future__ import annotations

from typing import Any

import bpy

from ..jobs import progress_text, running
from ..operators.world import PHYSGEN_OT_frames_from_scene
from ..props.body import bodies
from . import text
from .sidebar import SIMULATE, Sidebar, button, exists, is_baking, settings, state


class PHYSGEN_PT_simulate(Sidebar, bpy.types.Panel):
    """Let it happen"""

    bl_idname = "PHYSGEN_PT_simulate"
    bl_label = "Simulate"
    bl_order = SIMULATE

    def draw(self, context: bpy.types.Context) -> None:
        """Settings, estimate, the buttons, how the bake stands."""
        layout, scene = self.layout, context.scene
        simulation = scene.physgen.simulation
        column = settings(layout, context, why=True)
        column.prop(simulation, "quality")
        frames = column.column(align=True)
        row = frames.row(align=True)
        row.prop(simulation, "frame_start", text="Frames")
        row.operator(PHYSGEN_OT_frames_from_scene.bl_idname, text="", icon="TIME")
        frames.prop(simulation, "frame_end", text="To")
        column.prop(simulation, "device")
        _draw_length(layout, context, simulation)
        trouble = _trouble(scene)
        if trouble and not is_baking(scene):
            text.sentences(layout, context, trouble, icon="INFO")
        if not exists("physgen.bake"):
            text.sentences(layout, context, "This build cannot bake.", icon="ERROR")
            return
        _draw_bake(layout, context, state(scene), ready=not trouble)


def _draw_length(layout: bpy.types.UILayout, context: bpy.types.Context, simulation: Any) -> None:
    frames = simulation.frame_end - simulation.frame_start + 1
    rate = context.scene.render.fps / context.scene.render.fps_base
    if frames < 2:
        text.sentences(layout, context, "The last frame must come after the first.", icon="ERROR")
        return
    text.sentences(layout, context, f"{frames} frames, {frames / rate:.3g} s at {rate:.4g} frames a second")


def _trouble(scene: bpy.types.Scene) -> str:
    """Why nothing can be baked yet; empty when it can."""
    if not any(item.physgen.role == "dynamic" for item in bodies(scene)):
        return "Nothing moves yet: add an object to the simulation (see Objects)."
    return ""


def _draw_bake(layout: bpy.types.UILayout, context: bpy.types.Context, found: Any, *, ready: bool) -> None:
    status = found.status if found is not None else "none"
    if status == "baking":
        if running() is None:
            # Another Blender, or one that was killed, whose bake goes on.
            text.sentences(layout, context, found.message, icon="INFO")
            return
        _draw_progress(layout)
        row = layout.row(align=True)
        button(row, "physgen.pause_bake", text="Pause", icon="PAUSE")
        button(row, "physgen.cancel_job", text="Cancel", icon="CANCEL")
        return
    other = running()
    if other is not None:
        text.sentences(layout, context, f"{other.title} is running; bake when it is done.", icon="INFO")
    labels = {"paused": "Resume", "baked": "Bake Again", "stale": "Bake Again", "missing": "Bake Again"}
    icons = {"paused": "PLAY", "none": "PHYSICS"}
    row = layout.row(align=True)
    row.scale_y = 1.4
    row.enabled = ready
    button(row, "physgen.bake", text=labels.get(status, "Bake"), icon=icons.get(status, "FILE_REFRESH"))
    _draw_status(layout, context, found, status)
    estimate = layout.row(align=True)
    estimate.enabled = ready
    button(estimate, "physgen.estimate_bake", text="Estimate Time and Memory", icon="SORTTIME")
    if found is not None and found.estimate_text:
        text.sentences(layout, context, found.estimate_text)


def _draw_progress(layout: bpy.types.UILayout) -> None:
    job = running()
    if job is None:
        return
    column = layout.column(align=True)
    row = column.row()
    row.scale_y = 1.4
    row.progress(factor=job.fraction or 0.0, text=progress_text(job))
    if job.message:
        column.label(text=job.message)


def _draw_status(layout: bpy.types.UILayout, context: bpy.types.Context, found: Any, status: str) -> None:
    """What is there, in a box, with what can be done about it."""
    if status == "none":
        text.sentences(
            layout, context, text.brief(found.message) if found is not None and found.message else "Not baked yet."
        )
        return
    words, icon = {
        "baked": (f"Baked: {found.frames_done} frames", "CHECKMARK"),
        "paused": (f"{found.frames_done} of {found.frames} frames are baked and play", "PAUSE"),
        "stale": (f"{found.frames_done} frames are baked and still play", "ERROR"),
        "missing": (text.brief(found.message) or "The bake's files are not there", "ERROR"),
    }[status]
    box = layout.box()
    text.sentences(box, context, words, icon=icon)
    message = found.message or ("Out of date: something has changed since." if status == "stale" else "")
    if message and status != "missing":
        text.sentences(box, context, text.brief(message))
    row = box.row(align=True)
    if status == "missing":
        button(row, "physgen.relink_caches", text="Find It", icon="FILE_FOLDER")
        return
    row.label(text=f"{text.storage(found.disk_bytes)} on disk")
    button(row, "physgen.free_bake", text="Free", icon="TRASH")


class PHYSGEN_PT_cache(Sidebar, bpy.types.Panel):
    """Where bakes are kept"""

    bl_parent_id = "PHYSGEN_PT_simulate"
    bl_label = "Cache"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Folder, seed, find lost bakes."""
        layout, simulation = self.layout, context.scene.physgen.simulation
        column = settings(layout, context)
        column.prop(simulation, "cache", text="Folder")
        if simulation.cache.startswith("//") and not bpy.data.filepath:
            words = "Until this file is saved, bakes wait in a temporary folder."
            text.sentences(column, context, words, icon="INFO")
        column.prop(simulation, "seed")
        row = layout.row(align=True)
        button(row, "physgen.relink_caches", text="Find Lost", icon="FILE_FOLDER")
        button(row, "physgen.free_old_bakes", text="Free Old", icon="TRASH")


CLASSES = (PHYSGEN_PT_simulate, PHYSGEN_PT_cache)
