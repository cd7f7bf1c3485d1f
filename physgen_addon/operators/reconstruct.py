# SPDX-License-Identifier: GPL-3.0-or-later
"""Run ``physgen reconstruct`` on the photo and its boxes, and open the scene that it makes."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import bpy

from ...sim.app.process import run_stage
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.folder import load_scene
from ..interpreter import cli_command, find_python
from ..jobs import JobOperator, Work
from ..kept_changes import changes, remember, restore
from ..photo_masks import write_masks
from ..photo_request import arguments, mask_files, photo_file, scene_folder
from ..photo_scene import report_page, take_camera
from ..props.preferences import python
from ..reports import reports_errors
from .import_scene import show_scene


class PHYSGEN_OT_reconstruct(JobOperator, bpy.types.Operator):
    """Make a scene of the photo: cut out what is in the boxes, fill in the background, find camera, ground and light"""

    bl_idname = "physgen.reconstruct"
    bl_label = "Reconstruct"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Reconstruction"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is a photo with a box."""
        state = context.scene.physgen_photo
        if state.image is None or not state.boxes:
            cls.poll_message_set("Open a photo and draw a box around each object")
            return False
        return super().poll(context)

    def request(self, context: bpy.types.Context) -> Work:
        """The reconstruction as a child process, which reads the masks from files."""
        state = context.scene.physgen_photo
        given, out, preferred = arguments(state), scene_folder(state), python(context)
        write_masks(dict(mask_files(state, out).values()))

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            command = cli_command(find_python(preferred), "reconstruct", *given, "--out", str(out))
            return run_stage(command, on_event, cancelled)

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Open the scene folder, with what was changed by hand in an earlier one; show the horizon that was found."""
        root, photo = Path(str(final["scene"])), photo_file(scene.physgen_photo)
        changed = changes(scene, photo)
        sentence = show_scene(scene, root)
        remember(scene, photo)
        restore(scene, changed)
        take_camera(scene.physgen_photo, load_scene(root).scene.camera)
        return sentence


class PHYSGEN_OT_open_photo_report(bpy.types.Operator):
    """Open the page of pictures of every stage in the browser"""

    bl_idname = "physgen.open_photo_report"
    bl_label = "Open Report"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """The last reconstruction wrote one."""
        if report_page(context.scene.physgen_photo) is None:
            cls.poll_message_set("Switch Write Report on and reconstruct")
            return False
        return True

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Open report.html."""
        page = report_page(context.scene.physgen_photo)
        if page is None:
            raise InputError("there is no report of this photo; switch Write Report on and reconstruct")
        webbrowser.open(page.as_uri())
        return {"FINISHED"}


CLASSES = (PHYSGEN_OT_reconstruct, PHYSGEN_OT_open_photo_report)
