# SPDX-License-Identifier: GPL-3.0-or-later
"""Diagnose panel: where simulation and recording differ, why, and the result of adding the cause."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy

from .. import blend_trust, text
from ..operators.diagnose_ops import (
    PHYSGEN_OT_clear_capture,
    PHYSGEN_OT_diagnose,
    PHYSGEN_OT_explain_video,
    PHYSGEN_OT_follow,
    PHYSGEN_OT_load_capture,
    PHYSGEN_OT_load_diagnosis,
    PHYSGEN_OT_open_report,
)
from ..operators.effect_ops import PHYSGEN_OT_add_effect, PHYSGEN_OT_clear_overlay, PHYSGEN_OT_show_overlay
from ..playback.capture_materials import FOUND, LAYERS, NOMINAL, OBSERVED
from .sidebar import DIAGNOSE, Sidebar, draw_job, optional

WORTH_SAYING = 0.01
"""Least share of the largest error at which the simulator's own is mentioned."""
TITLES = {OBSERVED: "Observed", NOMINAL: "Nominal", FOUND: "Found"}
ICONS = {OBSERVED: "STRIP_COLOR_09", NOMINAL: "STRIP_COLOR_02", FOUND: "STRIP_COLOR_04"}


class PHYSGEN_UL_effects(bpy.types.UIList):
    """List of effects by probability."""

    def draw_item(
        self,
        context: bpy.types.Context,
        layout: bpy.types.UILayout,
        data: Any,
        item: Any,
        icon: int,
        active_data: Any,
        active_property: str,
    ) -> None:
        """Draw the name and a bar with the probability."""
        split = layout.split(factor=0.52)
        split.label(text=text.readable(item.name))
        split.progress(factor=item.probability, text=f"{100 * item.probability:.0f} %")


class PHYSGEN_PT_diagnose(Sidebar, bpy.types.Panel):
    """Compares a recording of the real motion with the simulation"""

    bl_idname = "PHYSGEN_PT_diagnose"
    bl_label = "Diagnose"
    bl_order = DIAGNOSE
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw capture, trial, Diagnose, and the verdict."""
        layout, state = self.layout, context.scene.physgen_diagnose
        column = layout.column(align=True)
        column.label(text="Recording of the real motion")
        column.prop(state, "capture", text="")
        row = column.row(align=True)
        row.operator(PHYSGEN_OT_load_capture.bl_idname, text="Reload" if state.root else "Load Capture", icon="IMPORT")
        if state.root is not None:
            row.operator(PHYSGEN_OT_clear_capture.bl_idname, text="", icon="TRASH")
        if state.root is None:
            text.sentences(layout, context, "Choose a capture, a folder with capture.json, or open From a Video below.")
            return
        row = layout.row(align=True)
        row.prop(state, "trial")
        row.prop(state.root, "hide_viewport", text="")
        label = next((t.label for t in state.trials if t.name == state.trial), "")
        text.sentences(layout, context, label)
        for warning in state.capture_warnings:
            text.sentences(layout, context, warning.text, icon="ERROR")
        column = layout.column(align=True)
        column.label(text="Results")
        row = column.row(align=True)
        row.prop(state, "report", text="", placeholder="Beside the capture")
        row.operator(PHYSGEN_OT_load_diagnosis.bl_idname, text="", icon="FILE_REFRESH")
        if not draw_job(layout, context, "Diagnosis"):
            row = layout.row()
            row.scale_y = 1.4
            row.operator(PHYSGEN_OT_diagnose.bl_idname, icon="VIEWZOOM")
        if state.has_report:
            _draw_verdict(layout, context, state)


class _Part(Sidebar):
    bl_parent_id = "PHYSGEN_PT_diagnose"


class PHYSGEN_PT_diagnose_video(_Part, bpy.types.Panel):
    """A video instead of a capture: tracked, diagnosed, and compared side by side"""

    bl_label = "From a Video"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the video, what is known of its body, and Explain a Video."""
        layout, video = self.layout, context.scene.physgen_diagnose.video
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        column.prop(video, "file")
        column.prop(video, "kind")
        sizes = {"ball": ("diameter",), "cylinder": ("diameter", "height"), "box": ("edges",), "mesh": ("mesh",)}
        for name in sizes[video.kind]:
            column.prop(video, name)
        optional(column, video, "own_fps", "fps", "True Frame Rate", otherwise="The file's")
        column.prop(video, "start")
        optional(column, video, "own_end", "end", "Last Frame", otherwise="The last one")
        if not draw_job(layout, context, "Explanation"):
            row = layout.row()
            row.scale_y = 1.4
            row.operator(PHYSGEN_OT_explain_video.bl_idname, icon="VIEWZOOM")
        path = Path(bpy.path.abspath(video.comparison))
        # A .blend from elsewhere may set any path here, and the operating system opens it: a program would run.
        if video.comparison and not blend_trust.is_pending(video.comparison) and blend_trust.may_open(path, (".mp4",)):
            layout.operator("wm.path_open", text="Play Comparison", icon="PLAY").filepath = str(path)


class PHYSGEN_PT_diagnose_show(_Part, bpy.types.Panel):
    """Visible layers of the capture"""

    bl_label = "Show"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown if a capture is loaded."""
        return context.scene.physgen_diagnose.root is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw one line a layer; then colours and sizes."""
        layout, state = self.layout, context.scene.physgen_diagnose
        grid = layout.column(align=True)
        for name in LAYERS:
            split = grid.split(factor=0.38, align=True)
            split.active = name == OBSERVED or state.has_motion
            split.label(text=TITLES[name], icon=ICONS[name])
            row = split.row(align=True)
            layer = getattr(state, name)
            for key in ("points", "trail", "body"):
                row.prop(layer, key, toggle=True)
        if not state.has_motion:
            text.sentences(layout, context, "Press Diagnose to see how the models move.")
        colours = layout.column()
        colours.active = state.has_scores
        colours.prop(state, "colours")
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        scale = column.row()
        scale.active = state.colours and state.has_scores
        scale.prop(state, "most", text="Dark Red (m/s²)")
        column.prop(state, "radius")
        column.prop(state, "trail_s")
        layout.operator(PHYSGEN_OT_follow.bl_idname, icon="CON_FOLLOWTRACK")


class PHYSGEN_PT_diagnose_causes(_Part, bpy.types.Panel):
    """Candidate causes, and how much of the gap each closes"""

    bl_label = "Causes"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown if there is a diagnosis."""
        return context.scene.physgen_diagnose.has_report

    def draw(self, context: bpy.types.Context) -> None:
        """Draw ranking, gap, warnings and suggested experiments."""
        layout, state = self.layout, context.scene.physgen_diagnose
        rows = min(max(len(state.effects), 2), 5)
        layout.template_list("PHYSGEN_UL_effects", "", state, "effects", state, "effect_index", rows=rows)
        if 0 <= state.effect_index < len(state.effects):
            _draw_effect(layout, state.effects[state.effect_index])
        _draw_gap(layout, context, state)
        for warning in state.warnings:
            text.sentences(layout, context, warning.text, icon="ERROR")
        if state.next_experiment:
            text.sentences(layout, context, f"Record next: {state.next_experiment}", icon="CAMERA_DATA")


def _draw_verdict(layout: bpy.types.UILayout, context: bpy.types.Context, state: Any) -> None:
    box = layout.box()
    text.sentences(box, context, state.summary)
    if state.alternatives and state.verdict == "none":
        # Of other verdicts the summary names them.
        names = ", ".join(text.readable(name).lower() for name in state.alternatives.split(", "))
        text.sentences(box, context, f"Too small for this recording to rule out: {names}.", icon="QUESTION")
    box.operator(PHYSGEN_OT_open_report.bl_idname, icon="URL")


def _draw_effect(layout: bpy.types.UILayout, effect: Any) -> None:
    if not len(effect.parameters) and not effect.has_closed:
        return
    column = layout.box().column(align=True)
    for item in effect.parameters:
        split = column.split(factor=0.45)
        split.label(text=text.readable(item.name))
        split.label(text=text.number(item.value, item.unit))
        if math.isfinite(item.low) and math.isfinite(item.high):
            split = column.split(factor=0.45)
            split.active = False
            split.label(text="95 % between")
            split.label(text=text.interval(item.low, item.high))
    if effect.has_closed:
        split = column.split(factor=0.45)
        split.label(text="Closes")
        split.label(text=f"{text.percent(effect.closed)} of the gap")


def _draw_gap(layout: bpy.types.UILayout, context: bpy.types.Context, state: Any) -> None:
    column = layout.column(align=True)
    column.label(text="Error on held-out motion")
    rows = (
        ("As believed", state.before_m),
        ("Re-tuned only", state.refitted_m),
        ("With the effect", state.after_m),
        ("Noise floor", state.floor_m),
    )
    box = column.box().column(align=True)
    most = max(value for _, value in rows)
    for title, value in rows:
        split = box.split(factor=0.52)
        split.label(text=title)
        share = min(value / most, 1.0) if most > 0 and value > 0 else 0.0
        split.progress(factor=share, text=text.length(value))
    if not state.resolvable:
        text.sentences(box, context, "Too close to the noise floor to quantify the closure.")
    elif state.closed > -1:
        box.label(text=f"{text.percent(state.closed)} of the gap is closed")
    if state.numerics_m >= WORTH_SAYING * most > 0:
        text.sentences(box, context, f"{text.length(state.numerics_m)} of it is the simulator's own error.")


class PHYSGEN_PT_diagnose_add(_Part, bpy.types.Panel):
    """Add the found effect to a scene and bake it"""

    bl_label = "Add to a Scene"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Shown if there is a diagnosis, or bakes to compare."""
        state = context.scene.physgen_diagnose
        return state.has_report or state.before_root is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw scene folder, bake settings, the button, the overlay."""
        layout, state = self.layout, context.scene.physgen_diagnose
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        column.prop(state, "scene_folder")
        column.prop(state, "before", placeholder="Baked first")
        column.prop(state, "frames")
        column.prop(state, "fps")
        column.prop(state, "quality")
        draw_job(layout, context, "Bake")
        row = layout.row()
        row.scale_y = 1.4
        row.operator(PHYSGEN_OT_add_effect.bl_idname, icon="ADD")
        if state.verdict in ("none", "unknown"):
            text.sentences(layout, context, "The diagnosis names no effect that could be added.")
        if state.after:
            column = layout.column(align=True)
            column.prop(state, "after", text="")
            column.operator(PHYSGEN_OT_show_overlay.bl_idname, icon="OVERLAY")
        if state.before_root is not None:
            row = layout.row(align=True)
            row.prop(state, "overlay", expand=True)
            row.operator(PHYSGEN_OT_clear_overlay.bl_idname, text="", icon="TRASH")
