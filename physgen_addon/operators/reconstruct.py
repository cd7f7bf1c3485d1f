# SPDX-License-Identifier: GPL-3.0-or-later
"""Run ``physgen reconstruct`` on the photo and its boxes, and open the scene that it makes."""

from __future__ import annotations

import math
from pathlib import Path

import bpy

from ...sim.app.process import run_stage
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.names import fitting_names
from ..interpreter import cli_command, find_python
from ..jobs import JobOperator, Work
from ..paths import folder_beside, require_folder
from ..props.preferences import python
from .draw_box import LEAST_PX
from .import_scene import show_scene


def scene_folder(state: bpy.types.PropertyGroup) -> Path:
    """Where the scene of the photo will be: where the artist says, else beside the .blend, else beside the photo.

    A temporary folder would be gone with everything in it when Blender closes. Raises InputError where nothing can be
    written.
    """
    if state.output.strip():
        return require_folder(state.output, "Scene Folder")
    photo = Path(bpy.path.abspath(state.path)).resolve()
    beside = Path(bpy.data.filepath).resolve().parent if bpy.data.filepath else photo.parent
    return folder_beside(beside / photo.stem, "scene")


def arguments(state: bpy.types.PropertyGroup) -> list[str]:
    """The command's arguments for the photo, its boxes and the camera. Raises InputError for what is missing."""
    path = Path(bpy.path.abspath(state.path))
    if state.image is None or not state.path or not path.is_file():
        raise InputError("there is no photo; open one first")
    if not state.boxes:
        raise InputError("there is no box; draw one around each object that is to move")
    # The command takes sizes from the first box on, so boxes with one go first.
    boxes = sorted(state.boxes, key=lambda box: box.size_m <= 0)
    # A name that begins with a dash would be taken for an option.
    names = fitting_names([box.name.strip(" -") for box in boxes])
    for box in boxes:
        if box.x1 - box.x0 < LEAST_PX or box.y1 - box.y0 < LEAST_PX:
            raise InputError(f"box {box.name}: is {box.x1 - box.x0} x {box.y1 - box.y0} pixels; draw it larger")
    sizes = [f"{box.size_m:.7g}" for box in boxes if box.size_m > 0]
    found = [str(path.resolve()), "--box", *(f"{box.x0},{box.y0},{box.x1},{box.y1}" for box in boxes)]
    found += ["--name", *names]
    if sizes:
        found += ["--size", *sizes]
    if state.use_pitch:
        found += ["--pitch", f"{math.degrees(state.pitch):.7g}"]
    return found


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
        """The reconstruction as a child process."""
        state = context.scene.physgen_photo
        given, out, preferred = arguments(state), scene_folder(state), python(context)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            command = cli_command(find_python(preferred), "reconstruct", *given, "--out", str(out))
            return run_stage(command, on_event, cancelled)

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Open the scene folder."""
        return show_scene(scene, Path(str(final["scene"])))


CLASSES = (PHYSGEN_OT_reconstruct,)
