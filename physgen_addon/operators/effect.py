# SPDX-License-Identifier: GPL-3.0-or-later
"""Add what a diagnosis found to a scene folder, bake it again, and lay the two bakes over each other."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...sim.app.add_effect import AddRequest, add_and_bake, found_effects, with_effects
from ...sim.app.process import run_stage
from ...sim.diagnose.diagnosis import REPORT_FILE
from ...sim.errors import PhysGenError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.folder import load_scene
from ...sim.scene.json_fields import read_json
from ..bridge import capture_view, overlay
from ..interpreter import cli_command, find_python
from ..jobs import JobOperator, Work
from ..paths import bake_folder, folder_beside, require_folder
from ..props.preferences import python
from ..reports import reports_errors
from ..views import turn_to
from .capture import report_folder


class PHYSGEN_OT_add_effect(JobOperator, bpy.types.Operator):
    """Add the found effect to the scene folder and bake it; where no bake from before is named, bake that first"""

    bl_idname = "physgen.add_found_effect"
    bl_label = "Add Effect and Bake"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Bake"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Something was found that can be added."""
        state = context.scene.physgen_diagnose
        if not state.has_report or state.verdict in ("none", "unknown"):
            cls.poll_message_set("The diagnosis names no effect that could be added")
            return False
        return super().poll(context)

    def request(self, context: bpy.types.Context) -> Work:
        """The effect into the scene, and one or two bakes as child processes."""
        state = context.scene.physgen_diagnose
        scene_root = require_folder(state.scene_folder, "Scene")
        found = found_effects(read_json(report_folder(state) / REPORT_FILE))
        with_effects(load_scene(scene_root).scene, found)
        bake_before = not state.before.strip()
        # One from an earlier run is not made again as long as the scene is still the same.
        beside = folder_beside(scene_root, "bake_before")
        before = beside if bake_before else require_folder(state.before, "Bake Before")
        request = AddRequest(
            scene=scene_root,
            found=found,
            before=before,
            after=bake_folder(folder_beside(scene_root, "bake_after")),
            bake_before=bake_before,
        )
        settings = ("--frames", str(state.frames), "--fps", repr(state.fps), "--quality", state.quality)
        preferred = python(context)

        def run_bake(scene: Path, out: Path, on_event: OnEvent, cancelled: IsCancelled) -> Event:
            command = cli_command(find_python(preferred), "bake", str(scene), "--out", str(out), *settings)
            return run_stage(command, on_event, cancelled)

        return lambda on_event, cancelled: add_and_bake(request, run_bake, on_event, cancelled)

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show both bakes."""
        state = scene.physgen_diagnose
        # Undo may have emptied the field meanwhile.
        state.scene_folder = str(final["scene"])
        state.before, state.after = str(final["before"]), str(final["after"])
        show_overlay(scene)
        return "the effect is in the scene; before and after lie over each other"


class PHYSGEN_OT_show_overlay(bpy.types.Operator):
    """Show the bakes before and after in this scene"""

    bl_idname = "physgen.show_overlay"
    bl_label = "Show Before and After"
    bl_options = {"UNDO"}  # noqa: RUF012

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Load both."""
        show_overlay(context.scene)
        return {"FINISHED"}


def show_overlay(scene: bpy.types.Scene) -> None:
    """Both bakes of the scene's scene folder into ``scene``, the capture out of sight. Raises InputError."""
    state = scene.physgen_diagnose
    folder = require_folder(state.scene_folder, "Scene")
    bakes = {
        overlay.BEFORE: require_folder(state.before, "Bake Before"),
        overlay.AFTER: require_folder(state.after, "Bake After"),
    }
    first, last, rate = overlay.frame_range(folder, bakes[overlay.AFTER])
    built: list[bpy.types.Collection] = []
    try:
        for which, bake in bakes.items():
            built.append(overlay.build(scene, folder, bake, which))
    except PhysGenError:
        for collection in built:
            overlay.remove(collection)
        raise
    for old in (state.before_root, state.after_root):
        if old is not None:
            overlay.remove(old)
    state.before_root, state.after_root = built
    if state.root is not None:
        state.root.hide_viewport = state.root.hide_render = True
    overlay.show(*built, choice=state.overlay)
    low, high = overlay.bounds(built[1])
    turn_to(bpy.context, 2 * low - high, 2 * high - low)
    scene.frame_start, scene.frame_end = first, last
    capture_view.set_rate(scene, rate)


class PHYSGEN_OT_clear_overlay(bpy.types.Operator):
    """Take both bakes out of the scene and show the capture again; their files stay where they are"""

    bl_idname = "physgen.clear_overlay"
    bl_label = "Clear Overlay"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove the two collections."""
        state = context.scene.physgen_diagnose
        for collection in (state.before_root, state.after_root):
            if collection is not None:
                overlay.remove(collection)
        if state.root is not None:
            state.root.hide_viewport = state.root.hide_render = False
            capture_view.play_range(context.scene, state.root, state.trial)
        return {"FINISHED"}


CLASSES = (PHYSGEN_OT_add_effect, PHYSGEN_OT_show_overlay, PHYSGEN_OT_clear_overlay)
