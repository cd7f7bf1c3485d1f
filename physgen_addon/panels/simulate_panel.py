# SPDX-License-Identifier: GPL-3.0-or-later
"""Simulate panel: quality, frames, folder; the bake and its state."""

from __future__ import annotations

import time
from pathlib import Path

import bpy

from .. import text
from ..background_jobs import running
from ..bake_state import BakeState, shows, state
from ..operators.bake_cache_ops import (
    PHYSGEN_OT_free_bake,
    PHYSGEN_OT_free_old_bakes,
    PHYSGEN_OT_free_one_bake,
    PHYSGEN_OT_relink_caches,
)
from ..operators.bake_ops import PHYSGEN_OT_bake, PHYSGEN_OT_estimate_bake, PHYSGEN_OT_pause_bake
from ..operators.world_ops import PHYSGEN_OT_frames_from_scene, PHYSGEN_OT_play_bake_only
from ..props.body_props import bodies
from .sidebar import (
    COMMAND,
    SIMULATE,
    Sidebar,
    draw_bake_button,
    draw_preview,
    draw_progress,
    draw_trouble,
    draw_trust,
    is_baking,
    settings,
)


class PHYSGEN_PT_simulate(Sidebar, bpy.types.Panel):
    """Simulate the scene"""

    bl_idname = "PHYSGEN_PT_simulate"
    bl_label = "Simulate"
    bl_order = SIMULATE

    def draw(self, context: bpy.types.Context) -> None:
        """Draw settings, estimate, buttons and the bake's state."""
        layout, scene = self.layout, context.scene
        simulation = scene.physgen.simulation
        column = settings(layout, context)
        column.prop(simulation, "quality")
        frames = column.column(align=True)
        row = frames.row(align=True)
        row.prop(simulation, "frame_start", text="Frames")
        row.operator(PHYSGEN_OT_frames_from_scene.bl_idname, text="", icon="TIME")
        frames.prop(simulation, "frame_end", text="To")
        column.prop(simulation, "slow")
        _draw_length(layout, context, simulation)
        lacking = _lacking(scene)
        if not lacking:
            draw_preview(layout, context)
        elif running() is None and not is_baking(scene):
            text.sentences(layout, context, lacking, icon="INFO")
        _draw_bake(layout, context, state(scene), ready=not lacking)


def _draw_length(layout: bpy.types.UILayout, context: bpy.types.Context, simulation: bpy.types.PropertyGroup) -> None:
    frames = simulation.frame_end - simulation.frame_start + 1
    rate = context.scene.render.fps / context.scene.render.fps_base
    if frames < 2:
        text.sentences(layout, context, "The last frame must come after the first.", icon="ERROR")
        return
    shown = f"{frames} frames: {frames / rate:.2g} s at {rate:.4g} fps"
    if simulation.slow != 1.0:
        shown += f", {frames / rate / simulation.slow:.2g} s of motion"
    text.sentences(layout, context, shown)


def _lacking(scene: bpy.types.Scene) -> str:
    """Return why nothing can be baked yet; empty if it can."""
    found = bodies(scene)
    if found and all(item.physgen.role == "collider" for item in found):
        return "Nothing moves yet: give an object the role Moves (see Objects)."
    if not found and scene.physgen_photo.image is not None:
        first = "reconstruct the photo" if scene.physgen_photo.boxes else "draw boxes and reconstruct the photo"
        return f"Nothing moves yet: {first} (see Scene)."
    if not found:
        return "Nothing moves yet: select a mesh, then Simulate Selected (see Scene)."
    return ""


def _draw_bake(layout: bpy.types.UILayout, context: bpy.types.Context, found: BakeState, *, ready: bool) -> None:
    if found.status == "baking":
        job = running()
        if job is None:
            # A bake by another Blender, or one that was killed, is running.
            text.sentences(layout, context, found.message, icon="INFO")
            return
        draw_progress(layout, context, job)
        layout.operator(PHYSGEN_OT_pause_bake.bl_idname, icon="PAUSE")
        return
    other = running()
    if other is not None:
        what = "Another bake" if other.title == PHYSGEN_OT_bake.job_title else other.title
        text.sentences(layout, context, f"{what} is running; bake when it is done.", icon="INFO")
    draw_bake_button(layout, found.status, ready=ready)
    if not ready and found.status == "none":
        return
    _draw_status(layout, context, found)
    estimate = layout.row(align=True)
    estimate.enabled = ready
    estimate.operator(PHYSGEN_OT_estimate_bake.bl_idname, text="Estimate Time and Memory", icon="SORTTIME")
    if found.estimate_text:
        text.sentences(layout, context, found.estimate_text)


def _draw_status(layout: bpy.types.UILayout, context: bpy.types.Context, found: BakeState) -> None:
    """Draw the bake's state in a box, with possible actions."""
    advice = text.brief(found.advice)
    if found.status == "none":
        if found.trouble:
            # The buttons that mend a missing Python are in sight already, in Scene.
            words, command, _ = found.trouble.partition(COMMAND)
            text.sentences(layout, context, text.brief(f"{words} (see Scene)" if command else words), icon="ERROR")
        text.sentences(layout, context, advice)
        return
    draw_trust(layout, context)
    box = layout.box()
    if found.trouble:
        draw_trouble(box, context, found.trouble, icon="ERROR")
    if found.status == "missing":
        text.sentences(box, context, advice, icon="ERROR")
        row = box.row(align=True)
        row.operator(PHYSGEN_OT_relink_caches.bl_idname, text="Find It", icon="FILE_FOLDER")
        row.operator(PHYSGEN_OT_free_bake.bl_idname, text="Free", icon="TRASH")
        return
    words, icon = {
        "baked": (f"Baked: {found.frames_done} frames", "CHECKMARK"),
        "paused": (f"{found.frames_done} of {found.frames} frames are baked and play", "PAUSE"),
        "stale": (f"{found.frames_done} frames are baked and still play", "ERROR"),
    }[found.status]
    text.sentences(box, context, words, icon=icon)
    if advice:
        text.sentences(box, context, advice)
    last = context.scene.physgen.simulation.frame_end
    if found.status == "baked" and context.scene.frame_end > last:
        column = box.column(align=True)
        text.sentences(column, context, f"Playback goes on to frame {context.scene.frame_end}, without motion.")
        column.operator(PHYSGEN_OT_play_bake_only.bl_idname, text=f"End Playback at {last}", icon="PREVIEW_RANGE")
    row = box.row(align=True)
    row.label(text=f"{text.storage(found.disk_bytes)} on disk")
    row.operator(PHYSGEN_OT_free_bake.bl_idname, text="Free", icon="TRASH")


LISTED = 8
"""Bakes in the list; *Free Old* deletes the others without listing them."""


def _draw_bakes(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw every bake of the scene: frames, size, age, whose it is, and a button that frees it."""
    scene = context.scene
    found = state(scene).bakes
    column = layout.column(align=True)
    for bake in found[:LISTED]:
        shown = shows(scene, Path(bake.folder))
        row = column.row(align=True)
        frames = f"{bake.frames}" if bake.frames_done == bake.frames else f"{bake.frames_done} of {bake.frames}"
        age = text.age(time.time() - bake.written)
        row.label(text=f"{frames} frames, {text.storage(bake.size)}, {age}", icon="PLAY" if shown else "FILE_CACHE")
        row.operator(PHYSGEN_OT_free_one_bake.bl_idname, text="", icon="TRASH", emboss=False).folder = bake.folder
        others = [Path(name).name for name in bake.files if name != bpy.data.filepath]
        if others:
            text.sentences(column, context, f"also used by {', '.join(others[:3])}", icon="FILE_BLEND")
    if len(found) > LISTED:
        column.label(text=f"and {len(found) - LISTED} more", icon="BLANK1")


class PHYSGEN_PT_cache(Sidebar, bpy.types.Panel):
    """Location of the bakes, and what computes them"""

    bl_parent_id = "PHYSGEN_PT_simulate"
    bl_label = "Cache and Device"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw folder, device, seed, and relinking of lost bakes."""
        layout, simulation = self.layout, context.scene.physgen.simulation
        column = settings(layout, context)
        column.prop(simulation, "cache", text="Folder")
        if simulation.cache.startswith("//") and not bpy.data.filepath:
            words = "Until this file is saved, bakes are in a temporary folder."
            text.sentences(column, context, words, icon="INFO")
        column.prop(simulation, "device")
        column.prop(simulation, "seed")
        _draw_bakes(layout, context)
        row = layout.row(align=True)
        row.operator(PHYSGEN_OT_relink_caches.bl_idname, text="Find Lost", icon="FILE_FOLDER")
        row.operator(PHYSGEN_OT_free_old_bakes.bl_idname, text="Free Old", icon="TRASH")
