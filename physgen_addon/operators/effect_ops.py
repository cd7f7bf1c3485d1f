# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: add the effect that a diagnosis found, and compare the bakes before and after."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...sim.app.add_effect import AddRequest, add_and_bake, found_effects, with_effects
from ...sim.app.stage_process import run_stage
from ...sim.cache.bake_folder import load_bake
from ...sim.diagnose.diagnosis import REPORT_FILE
from ...sim.errors import PhysGenError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.folder import Scene, load_scene
from ...sim.validation import read_json
from ..background_jobs import JobOperator, Work
from ..context import turn_to
from ..interpreter import cli_command, find_python
from ..paths import bake_folder, folder_beside, require_folder
from ..playback import capture_view
from ..props.preferences import python
from ..text import report_errors
from .diagnose_ops import report_folder, stored_path


class PHYSGEN_OT_add_effect(JobOperator, bpy.types.Operator):
    """Add the found effect to the scene folder and bake it; without a reference bake, bake that first"""

    bl_idname = "physgen.add_found_effect"
    bl_label = "Add Effect and Bake"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Bake"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if an effect was found that can be added."""
        state = context.scene.physgen_diagnose
        if not state.has_report or state.verdict in ("none", "unknown"):
            cls.poll_message_set("The diagnosis names no effect that could be added")
            return False
        return super().poll(context)

    def request(self, context: bpy.types.Context) -> Work:
        """Add the effect to the scene; return one or two bakes as child processes."""
        state = context.scene.physgen_diagnose
        folder = load_scene(require_folder(state.scene_folder, "Scene"))
        found = found_effects(read_json(report_folder(state) / REPORT_FILE))
        with_effects(folder.model, found)
        bake_before = not state.before.strip()
        # A bake from an earlier run is reused while the scene is unchanged.
        beside = folder_beside(folder.root, "bake_before")
        request = AddRequest(
            found=found,
            before=beside if bake_before else require_folder(state.before, "Bake Before"),
            after=bake_folder(folder_beside(folder.root, "bake_after")),
            bake_before=bake_before,
        )
        settings = ("--frames", str(state.frames), "--fps", repr(state.fps), "--quality", state.quality)
        preferred = python(context)

        def run_bake(scene: Scene, out: Path, on_event: OnEvent, cancelled: IsCancelled) -> Event:
            command = cli_command(find_python(preferred), "bake", str(scene.root), "--out", str(out), *settings)
            return run_stage(command, on_event, cancelled)

        return lambda on_event, cancelled: add_and_bake(
            folder, request=request, run_bake=run_bake, on_event=on_event, cancelled=cancelled
        )

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show both bakes."""
        state = scene.physgen_diagnose
        # Undo may have cleared the property.
        state.scene_folder = stored_path(final, "scene")
        state.before, state.after = stored_path(final, "before"), stored_path(final, "after")
        show_overlay(scene)
        return "Effect added; the bakes before and after are overlaid"


class PHYSGEN_OT_show_overlay(bpy.types.Operator):
    """Show the bakes before and after in this scene"""

    bl_idname = "physgen.show_overlay"
    bl_label = "Show Before and After"
    bl_options = {"UNDO"}  # noqa: RUF012

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Load both."""
        show_overlay(context.scene)
        return {"FINISHED"}


def show_overlay(scene: bpy.types.Scene) -> None:
    """Show both bakes of the scene folder in ``scene`` and hide the capture. Raises InputError."""
    state = scene.physgen_diagnose
    folder = load_scene(require_folder(state.scene_folder, "Scene"))
    bakes = {
        capture_view.BEFORE: load_bake(require_folder(state.before, "Bake Before")),
        capture_view.AFTER: load_bake(require_folder(state.after, "Bake After")),
    }
    first, last, rate = capture_view.overlay_frame_range(folder, bakes[capture_view.AFTER])
    built: list[bpy.types.Collection] = []
    try:
        for which, bake in bakes.items():
            built.append(capture_view.build_overlay(scene, folder, bake, which))
    except PhysGenError:
        for collection in built:
            capture_view.remove_overlay(collection)
        raise
    for old in (state.before_root, state.after_root):
        if old is not None:
            capture_view.remove_overlay(old)
    state.before_root, state.after_root = built
    if state.root is not None:
        state.root.hide_viewport = state.root.hide_render = True
    capture_view.show_overlay(*built, choice=state.overlay)
    low, high = capture_view.overlay_bounds(built[1])
    turn_to(bpy.context, 2 * low - high, 2 * high - low)
    scene.frame_start, scene.frame_end = first, last
    capture_view.set_rate(scene, rate)


class PHYSGEN_OT_clear_overlay(bpy.types.Operator):
    """Remove both bakes from the scene and show the capture again; files are kept"""

    bl_idname = "physgen.clear_overlay"
    bl_label = "Clear Overlay"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove the two collections."""
        state = context.scene.physgen_diagnose
        for collection in (state.before_root, state.after_root):
            if collection is not None:
                capture_view.remove_overlay(collection)
        if state.root is not None:
            state.root.hide_viewport = state.root.hide_render = False
            capture_view.play_range(context.scene, state.root, state.trial)
        return {"FINISHED"}
