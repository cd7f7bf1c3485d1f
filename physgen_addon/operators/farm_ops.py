# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: the scene as a job for a farm, run here or written for Flamenco or SLURM by the verb ``batch``."""

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from ...sim.app.bake_options import BakeOptions
from ...sim.app.bake_transfer import transfer_physics
from ...sim.app.scene_variant import save_variant
from ...sim.app.stage_process import run_stage
from ...sim.atomic import write_bytes
from ...sim.errors import InputError, RenderError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.folder import load_scene
from .. import blend_trust
from ..background_jobs import JobOperator, Work
from ..interpreter import cli_command, find_python, require_renderer
from ..paths import require_folder, require_writable
from ..props.preferences import python
from ..props.render_props import render_options
from ..render.render_options import RenderOptions, flagged_fields
from .bake_ops import exported
from .render_ops import photo_names

JOB_FILE, SCENE = "job.toml", "scene"
"""File of the job, and folder of its scene beside it."""
NAME, CLIP = "results", "clip"
"""Names of the job, which is that of the folder of its results, and of its only scene there."""
START = {
    "flamenco": ("job.json", "Submit job.json to Flamenco (see docs/farm.md)."),
    "slurm": ("submit.sh", "Run submit.sh on the cluster."),
}
"""Of a job that was written for another machine: the file that starts it, and the next step."""
VARIANT = "base"
"""Of the only variant, as the job file calls it."""


def arguments(folder: Path, target: str) -> list[str]:
    """Return the words after ``physgen`` that run the job in ``folder``, or write it for ``target``."""
    words = ["batch", str(folder / JOB_FILE)]
    return words if target == "local" else [*words, "--export", target, "--out", str(folder / target)]


def command(scene: bpy.types.Scene) -> str:
    """Return the same as a command to be typed where PhysGen is installed."""
    rendering = scene.physgen.rendering
    return shlex.join(["physgen", *arguments(Path(bpy.path.abspath(rendering.farm_folder)), rendering.farm)])


def written(scene: bpy.types.Scene) -> tuple[Path, str] | None:
    """Return where the job is that was written for the chosen farm, and the next step; None if there is none.

    Nothing is looked for where somebody else's file points and the user has not agreed to it.
    """
    rendering = scene.physgen.rendering
    if rendering.farm not in START or blend_trust.is_pending(rendering.farm_folder):
        return None
    folder = Path(bpy.path.abspath(rendering.farm_folder)) / rendering.farm
    name, step = START[rendering.farm]
    return (folder, step) if (folder / name).is_file() else None


def job_text(bake: BakeOptions, render: RenderOptions, *, video: str, chunk: int) -> str:
    """Return the job file (docs/farm.md): the scene folder beside it, baked and rendered with these options."""
    rendered = {item.name: getattr(render, item.name) for item, _, _ in flagged_fields()}
    changed = {item.name: rendered[item.name] for item, _, _ in flagged_fields() if rendered[item.name] != item.default}
    tables: dict[str, Mapping[str, Any]] = {
        "": {"format": "physgen-jobs/1", "name": NAME},
        "[defaults.bake]": {
            name: getattr(bake, name) for name in ("frames", "fps", "slow", "quality", "arch", "seed", "points")
        },
        "[defaults.render]": {**changed, "video": [video], "chunk": chunk},
        "[[scenes]]": {"name": CLIP, "scene": SCENE},
    }
    lines: list[str] = []
    for header, table in tables.items():
        # Strings, numbers, truth and lists of strings are written alike in JSON and in TOML.
        lines += [header, *(f"{name} = {json.dumps(value)}" for name, value in table.items()), ""]
    return "\n".join(lines).lstrip("\n")


class PHYSGEN_OT_farm(JobOperator, bpy.types.Operator):
    """Bake and render the whole clip as a job of tasks that survive crashes: on this machine, or written for a farm"""

    bl_idname = "physgen.farm"
    bl_label = "Farm"
    job_title = "Farm"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with a photo, in a saved file or with a folder elsewhere, and without a running job."""
        state = context.scene.physgen
        if not state.folder:
            cls.poll_message_set("This scene has no photo: a farm renders into photos")
            return False
        if state.rendering.farm_folder.startswith("//") and not bpy.data.filepath:
            cls.poll_message_set("Save the file first: the job is beside it")
            return False
        return super().poll(context)

    def request(self, context: bpy.types.Context) -> Work:
        """Write the job, and return the command that runs or exports it."""
        scene = context.scene
        rendering = scene.physgen.rendering
        folder, target = require_folder(rendering.farm_folder, "Farm Folder"), rendering.farm
        photo = load_scene(require_folder(scene.physgen.folder, "Scene Folder"))
        root, bake = exported(scene)
        model = transfer_physics(photo, load_scene(root), photo_names(scene))
        require_writable(folder)
        save_variant(photo, model, out=folder / SCENE)
        text = job_text(bake, render_options(rendering), video=rendering.video, chunk=rendering.farm_chunk)
        write_bytes(folder / JOB_FILE, text.encode())
        preferred = python(context)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            interpreter = find_python(preferred)
            if target == "local":
                # Each task is a process of that interpreter; Blender itself cannot be one.
                require_renderer(interpreter)
            line = cli_command(interpreter, *arguments(folder, target))

            def relay(event: Event) -> None:
                # Of "clip/base/render-0001-0024" the task alone: there is one scene, and one variant of it.
                task = str(event.get("message") or "").removeprefix(f"{CLIP}/{VARIANT}/")
                on_event({**event, "stage": "", "message": task} if event.get("event") == "progress" else event)

            return {**run_stage(line, relay, cancelled, failure=RenderError), "folder": str(folder)}

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Report what was made."""
        rendering, folder = scene.physgen.rendering, Path(str(final["folder"]))
        if rendering.farm != "local":
            return f"The job is written to {folder / rendering.farm}. {START[rendering.farm][1]}"
        video = folder / NAME / CLIP / VARIANT / f"video.{rendering.video}"
        if not video.is_file():
            raise InputError(f"{video}: is not there, although the job has ended; see {folder / NAME}")
        rendering.result = str(video)
        return f"Rendered {video}"


class PHYSGEN_OT_copy_farm_command(bpy.types.Operator):
    """Copy the command that does the same in a terminal"""

    bl_idname = "physgen.copy_farm_command"
    bl_label = "Copy Command"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put it into the clipboard."""
        context.window_manager.clipboard = command(context.scene)
        self.report({"INFO"}, f"Copied: {context.window_manager.clipboard}")
        return {"FINISHED"}
