# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: reconstruct the photo, agree to the paths that its file names, read the report."""

import webbrowser
from collections.abc import Mapping
from pathlib import Path

import bpy
from bpy.props import BoolProperty

from ...sim.app.stage_process import run_stage
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.html import require_harmless
from ...sim.scene.folder import load_scene
from .. import bake_state, blend_trust
from ..background_jobs import JobOperator, Work
from ..context import close_beside
from ..interpreter import cli_command, find_python
from ..photo.photo_image import (
    write_masks,
)
from ..photo.photo_request import (
    arguments,
    mask_files,
    named_boxes,
    photo_file,
    report_page,
    scene_folder,
    take_camera,
)
from ..props.body_props import bodies
from ..props.preferences import python
from ..scene_io.import_physics import find_edits, remember_imported, restore_edits
from ..text import report_errors
from .import_ops import show_scene


class PHYSGEN_OT_trust_file(bpy.types.Operator):
    """Agree to the paths outside its folder that this file names; each is shown first"""

    bl_idname = "physgen.trust_file"
    bl_label = "Paths in This File"

    go_on: BoolProperty(name="Reconstruct Then", default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show every line."""
        manager = context.window_manager
        title = "This file names paths outside its folder. Use them?"
        return manager.invoke_props_dialog(self, width=560, title=title, confirm_text="Trust This File")

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the lines."""
        for claim in blend_trust.pending(context.scene):
            self.layout.label(text=claim.line(), icon="FILE")
        self.layout.label(text="Choose Cancel if you do not know who made this file.")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Agree; where Reconstruct asked, go on with it."""
        blend_trust.agree(context.scene)
        bake_state.mark_dirty()
        if self.go_on and not bpy.app.background:
            bpy.ops.physgen.reconstruct("INVOKE_DEFAULT")
        return {"FINISHED"}


class PHYSGEN_OT_reconstruct(JobOperator, bpy.types.Operator):
    """Make a scene of the photo: cut the objects out, fill the places behind them, estimate camera, ground and light"""

    bl_idname = "physgen.reconstruct"
    bl_label = "Reconstruct"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Reconstruction"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with a photo and a box."""
        state = context.scene.physgen_photo
        if state.image is None or not state.boxes:
            cls.poll_message_set("Open a photo and draw a box around each object")
            return False
        return super().poll(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first, where the file came with settings that read outside its folder."""
        if blend_trust.pending(context.scene) and not bpy.app.background:
            bpy.ops.physgen.trust_file("INVOKE_DEFAULT")
            return {"CANCELLED"}
        return super().invoke(context, event)

    def request(self, context: bpy.types.Context) -> Work:
        """Return the reconstruction as a child process, which reads the masks from files."""
        blend_trust.require_agreed(context.scene)
        state = context.scene.physgen_photo
        given, out, preferred = arguments(state), scene_folder(state), python(context)
        materials = chosen_materials(context.scene)
        write_masks(dict(mask_files(state, out).values()))

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            command = cli_command(find_python(preferred), "reconstruct", *given, "--out", str(out))
            return {**run_stage(command, on_event, cancelled), "materials": materials}

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Open the scene folder and reapply the user's edits of an earlier one; show the estimated horizon."""
        root, photo = Path(str(final["scene"])), photo_file(scene.physgen_photo)
        changed = find_edits(scene, photo)
        if clip := final.get("clip"):
            # The length and slow motion that suit the chosen motion. Imported times become frames by them.
            simulation = scene.physgen.simulation
            simulation.frame_end, simulation.slow = simulation.frame_start + clip["frames"] - 1, clip["slow"]
        sentence = show_scene(scene, root)
        close_beside(scene)
        # Undo may have cleared what was chosen at the start; what has been chosen since counts.
        set_materials(scene, {**final["materials"], **chosen_materials(scene)})
        remember_imported(scene, photo)
        restore_edits(scene, changed)
        take_camera(scene.physgen_photo, load_scene(root).model.camera)
        return sentence


def chosen_materials(scene: bpy.types.Scene) -> dict[str, str]:
    """Return the presets that were chosen for boxes, by object name."""
    return {name: str(box.preset) for name, box in named_boxes(scene.physgen_photo) if box.preset != "auto"}


def set_materials(scene: bpy.types.Scene, chosen: Mapping[str, str]) -> None:
    """Give the imported objects of ``scene`` their ``chosen`` presets, see ``chosen_materials``."""
    for item in bodies(scene):
        if preset := chosen.get(item.physgen.source):
            item.physgen.material.preset = preset


class PHYSGEN_OT_open_photo_report(bpy.types.Operator):
    """Open the report with images of every stage in the browser"""

    bl_idname = "physgen.open_photo_report"
    bl_label = "Open Report"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if the last reconstruction wrote one."""
        if report_page(context.scene.physgen_photo) is None:
            cls.poll_message_set("Enable Write Report and reconstruct")
            return False
        return True

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Open report.html."""
        page = report_page(context.scene.physgen_photo)
        if page is None:
            raise InputError("there is no report of this photo; enable Write Report and reconstruct")
        require_harmless(page)
        webbrowser.open(page.as_uri())
        return {"FINISHED"}
