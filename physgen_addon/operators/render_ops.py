# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: render into the photo, and the layers of its frames in the compositor."""

import dataclasses
import itertools
import os
import sys
import tempfile
from pathlib import Path

import bpy

from ...sim.app.bake_transfer import transfer_bake
from ...sim.app.stage_process import run_stage
from ...sim.atomic import scratch_prefix
from ...sim.cache.bake_folder import MANIFEST_FILE, load_bake, load_manifest
from ...sim.errors import InputError, RenderError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.camera_path import CameraPath, save_camera_path
from ...sim.scene.folder import SCENE_FILE, load_scene
from .. import paths
from ..background_jobs import Job, JobOperator, Work
from ..compat import HEADLESS
from ..context import replace_shown, show_result
from ..frames.frame_index import FRAME_NAME, folder_for, frame_name
from ..interpreter import find_python, missing_modules, require_renderer
from ..paths import require_folder
from ..props import preferences
from ..props.body_props import bodies
from ..props.render_props import render_options
from ..render import look_nodes
from ..render.render_options import RenderOptions, render_arguments
from ..scene_io import export_animation
from ..text import count, report_errors

FIRST_NUMBER = 1
"""Number of the file of a bake's first sample."""
SCRIPT = Path(__file__).resolve().parents[2] / "batch" / "render.py"


def render_command(preferred: str = "") -> list[str]:
    """Return the command that runs ``batch/render.py``, to be followed by its arguments.

    It is this Python if that has bpy as a module, else this Blender; where its Python lacks packages, the interpreter
    that simulates (``preferred``: the one in the preferences), which may have to be probed for seconds. Raises
    NoPython, or InputError if that one cannot render either.
    """
    if missing_modules():
        # The light zip brings no packages.
        python = find_python(preferred)
        require_renderer(python)
        return [str(python), str(SCRIPT)]
    if not bpy.app.binary_path:
        return [sys.executable, str(SCRIPT)]
    # A factory start-up does not load extensions, hence not their wheels.
    paths = f"import sys; sys.path += [p for p in {[p for p in sys.path if p]!r} if p not in sys.path]"
    blender = [bpy.app.binary_path, *HEADLESS]
    return [*blender, "--python-expr", paths, "--python", str(SCRIPT), "--"]


def photo_names(scene: bpy.types.Scene) -> dict[str, str]:
    """Return by name in the photo's scene folder the name under which the object was baked."""
    names: dict[str, str] = {}
    for item in bodies(scene):
        body = item.physgen
        if body.source:
            # A duplicate is not in the photo; the first by name was imported.
            names.setdefault(body.source, body.cache or item.name)
    return names


def _output_folder(scene: bpy.types.Scene) -> Path:
    """Return the folder of frames of the chosen format."""
    path = scene.physgen.rendering.output
    if path.startswith("//") and not bpy.data.filepath:
        # Where the bake of an unsaved file waits, too.
        paths.make_unsaved_root()
        folder = paths.unsaved_root() / paths.unsaved_key() / "rendered frames"
    else:
        folder = require_folder(path, "Output")
    return folder_for(folder, render_options(scene.physgen.rendering).frame_format.suffix)


def _camera_path(scene: bpy.types.Scene, photo: Path, bake: Path) -> CameraPath | None:
    """Write the path of the scene's camera over the frames of ``bake``, relative to the scene folder ``photo``."""
    manifest = load_manifest(bake)
    first = scene.physgen.simulation.frame_start
    frames = range(first, first + max(manifest.frames_done, 1))
    camera = load_scene(photo).model.camera
    return export_animation.camera_path(scene, camera, frames, first_frame=manifest.frame_start)


DRAFT_SCALE, DRAFT_SAMPLES = 0.4, 2
"""Of the picture that is shown while a still is rendered: share of its size, and samples."""


def draft_of(options: RenderOptions) -> RenderOptions:
    """Return the options of the picture that is shown while a still is rendered with ``options``."""
    samples, scale = min(options.samples, DRAFT_SAMPLES), options.scale * DRAFT_SCALE
    return dataclasses.replace(options, samples=samples, scale=scale, format="png", bits=8)


class _Render(JobOperator):
    job_title = "Render"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with a photo and a bake, and without a running job."""
        state = context.scene.physgen
        if not state.folder:
            cls.poll_message_set("This scene has no photo: render it as any Blender scene")
            return False
        if not state.simulation.bake:
            cls.poll_message_set("Bake first (see Scene)")
            return False
        return super().poll(context)

    def _work(self, scene: bpy.types.Scene, *choices: str, drafts: bool = False) -> Work:
        """Return the job that renders ``choices``. drafts: a draft of it comes first, as the detail ``draft``."""
        bake = require_folder(scene.physgen.simulation.bake, "Bake")
        if not (bake / MANIFEST_FILE).is_file():
            raise InputError(f"{bake}: holds no bake; bake again, or press Find Lost (see Cache and Device)")
        photo, baked_scene = require_folder(scene.physgen.folder, "Scene Folder"), bake.parent.parent / "scene"
        names, strangers = photo_names(scene), [item.name for item in bodies(scene) if not item.physgen.source]
        out = _output_folder(scene)
        arguments = ["--out", str(out)]
        options = render_options(scene.physgen.rendering)
        arguments += render_arguments(options)
        preferred = preferences.python(bpy.context)
        path = _camera_path(scene, photo, bake)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            if strangers:
                message = f"not in the photo, so not rendered into it: {', '.join(strangers)}"
                on_event({"event": "notice", "message": message})
            start = render_command(preferred)
            with tempfile.TemporaryDirectory(prefix=scratch_prefix("render")) as scratch:
                rendered = bake
                if (baked_scene / SCENE_FILE).is_file():
                    rendered = Path(scratch) / "bake"
                    transfer_bake(
                        load_scene(photo),
                        load_scene(baked_scene),
                        load_bake(bake),
                        out=rendered,
                        names=names,
                        on_event=on_event,
                    )
                command = [*start, str(photo), "--bake", str(rendered)]
                command += ["--parent", str(os.getpid()), "--json", *choices]
                if path is not None:
                    save_camera_path(Path(scratch) / "camera.json", path)
                    command += ["--camera", str(Path(scratch) / "camera.json")]
                if drafts:
                    drafted = Path(scratch) / "draft"
                    quick = [*command, "--out", str(drafted), *render_arguments(draft_of(options))]
                    found = run_stage(quick, on_event, cancelled, failure=RenderError, restarts=1)
                    on_event({"event": "detail", "draft": str(drafted / str(found["files"][0]))})
                command += arguments
                # The result does not contain the requested range.
                return {**run_stage(command, on_event, cancelled, failure=RenderError, restarts=1), "out": str(out)}

        return work


class PHYSGEN_OT_render_still(_Render, bpy.types.Operator):
    """Render the current frame into the photo"""

    bl_idname = "physgen.render_still"
    bl_label = "Render Still"

    def request(self, context: bpy.types.Context) -> Work:
        """Return the job for the current frame."""
        scene = context.scene
        simulation = scene.physgen.simulation
        manifest = load_manifest(require_folder(simulation.bake, "Bake"))
        first = simulation.frame_start
        sample = scene.frame_current - first
        if not 0 <= sample < manifest.frames_done:
            last = first + manifest.frames_done - 1
            raise InputError(f"frame {scene.frame_current} is not baked: go to one from {first} to {last}")
        number = manifest.frame_start + sample
        name = frame_name(number, render_options(scene.physgen.rendering).frame_format.suffix)
        # Where there is a picture already it may be up to date, and then it is there at once.
        drafts = not bpy.app.background and not (_output_folder(scene) / name).is_file()
        work = self._work(scene, "--frames", str(number), drafts=drafts)
        self._draft = ""
        return lambda on_event, cancelled: {**work(on_event, cancelled), "still": name}

    def progressed(self, scene: bpy.types.Scene, job: Job) -> None:
        """Show the draft, once it is there."""
        path = job.details.get("draft")
        if path is not None and not self._draft and Path(path).is_file():
            image = bpy.data.images.load(path)
            image.name = "Draft"
            # Its file is a temporary one.
            image.pack()
            self._draft = image.name
            show_result(bpy.context, image)

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show it, in place of the draft."""
        path = Path(str(final["out"])) / str(final["still"])
        if not path.is_file():
            raise RenderError(f"{path}: is not there, although rendering has ended; render again")
        scene.physgen.rendering.result = str(path)
        image = bpy.data.images.load(str(path), check_existing=True)
        image.reload()
        draft = bpy.data.images.get(self._draft)
        if draft is None or not replace_shown(draft, image):
            show_result(bpy.context, image)
        return f"Rendered {path}"


class PHYSGEN_OT_render_video(_Render, bpy.types.Operator):
    """Render all baked frames into the photo, and a video of them. Up-to-date frames are not rendered again"""

    bl_idname = "physgen.render_video"
    bl_label = "Render Video"

    def request(self, context: bpy.types.Context) -> Work:
        """Return the job for all frames."""
        scene = context.scene
        name = f"video.{scene.physgen.rendering.video}"
        work = self._work(scene, "--video", str(_output_folder(scene) / name))
        return lambda on_event, cancelled: {**work(on_event, cancelled), "video": name}

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Report its path."""
        path = Path(str(final["out"])) / str(final["video"])
        scene.physgen.rendering.result = str(path)
        return f"Rendered {path}"


class PHYSGEN_OT_look_nodes(bpy.types.Operator):
    """Open the rendered frames in Blender's compositor, their layers apart: plate, shadow, objects, masks, grain.
    Untouched, the nodes give the frames themselves
    """

    bl_idname = "physgen.look_nodes"
    bl_label = "Compositor Nodes"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled in Blender 5.0 and later, once frames with layers were rendered."""
        rendering = context.scene.physgen.rendering
        if not look_nodes.available():
            cls.poll_message_set("Needs Blender 5.0")
            return False
        if rendering.format != "exr_layers" or not rendering.result:
            cls.poll_message_set("Render with the format EXR Layers first")
            return False
        return True

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Make or refresh them."""
        scene = context.scene
        out = _output_folder(scene)
        found = {int(path.stem): path for path in out.glob("*.exr") if FRAME_NAME.fullmatch(path.name)}
        if not found:
            raise InputError(f"{out}: has no frames with layers; render with the format EXR Layers")
        # Numbers begin at 1 for the bake's first sample. A sequence of Blender has no gaps.
        first = min(found)
        frames = [found[number] for number in itertools.takewhile(found.__contains__, itertools.count(first))]
        start = scene.physgen.simulation.frame_start + first - FIRST_NUMBER
        look_nodes.add_look_nodes(scene, frames, first_frame=start)
        self.report({"INFO"}, f"{count(len(frames), 'frame')} in the compositor; render the image (F12) to see them")
        return {"FINISHED"}
