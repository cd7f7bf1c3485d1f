# SPDX-License-Identifier: GPL-3.0-or-later
"""Render the bake into the photo: ``batch/render.py`` in a Blender of its own, so that this one stays usable."""

import importlib.util
import os
import sys
import tempfile
from pathlib import Path

import bpy

from ...sim.app.placed_bake import place_bake
from ...sim.app.process import run_stage
from ...sim.cache.manifest import MANIFEST_FILE, load_manifest
from ...sim.errors import InputError, RenderError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.camera_path import CameraPath, save_camera_path
from ...sim.scene.folder import SCENE_FILE, load_scene
from ..bridge import export_camera
from ..bridge.ledger import frame_name
from ..bridge.option_flags import render_arguments
from ..jobs import JobOperator, Work
from ..paths import require_folder
from ..props.body import bodies
from ..props.rendering import render_options
from ..views import show_result

SCRIPT = Path(__file__).resolve().parents[2] / "batch" / "render.py"
NEEDED = {"scipy": "scipy", "trimesh": "trimesh", "PIL": "Pillow", "cv2": "OpenCV", "OpenImageIO": "OpenImageIO"}
"""Modules that rendering into a photo imports, and what people call them."""


def missing_modules() -> list[str]:
    """What this Blender's Python lacks for rendering into a photo, as people call it."""
    return [title for module, title in NEEDED.items() if importlib.util.find_spec(module) is None]


def render_command() -> list[str]:
    """The command that runs ``batch/render.py``, to be followed by its arguments.

    It is this Python where that has bpy as a module, else this Blender.
    """
    if not bpy.app.binary_path:
        return [sys.executable, str(SCRIPT)]
    # A factory start-up does not load extensions, so it would not find their wheels.
    paths = f"import sys; sys.path += [p for p in {[p for p in sys.path if p]!r} if p not in sys.path]"
    blender = [bpy.app.binary_path, "--background", "--factory-startup", "--python-exit-code", "1"]
    return [*blender, "--python-expr", paths, "--python", str(SCRIPT), "--"]


def photo_names(scene: bpy.types.Scene) -> dict[str, str]:
    """By name in the photo's scene folder, the name under which the object was baked."""
    names: dict[str, str] = {}
    for item in bodies(scene):
        body = item.physgen
        if body.source:
            # A duplicate is not in the photo; what comes first by name is what was imported.
            names.setdefault(body.source, body.cache or item.name)
    return names


def _output_folder(scene: bpy.types.Scene) -> Path:
    path = scene.physgen.rendering.output
    if path.startswith("//") and not bpy.data.filepath:
        raise InputError(f"Output is {path!r}, beside a file that is not saved yet: save it, or choose a folder")
    return require_folder(path, "Output")


def _camera_path(scene: bpy.types.Scene, photo: Path, bake: Path) -> CameraPath | None:
    """What the scene's camera does over the frames of ``bake``, against that of the scene folder ``photo``."""
    manifest = load_manifest(bake)
    first = scene.physgen.simulation.frame_start
    frames = range(first, first + max(manifest.frames_done, 1))
    camera = load_scene(photo).scene.camera
    return export_camera.camera_path(scene, camera, frames, first_frame=manifest.frame_start)


class _Render(JobOperator):
    job_title = "Render"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """A scene with a photo, a bake to render, nothing else under way."""
        state = context.scene.physgen
        if not state.folder:
            cls.poll_message_set("This scene has no photo: render it as any scene of Blender")
            return False
        if not state.simulation.bake:
            cls.poll_message_set("Bake first (see Simulate)")
            return False
        return super().poll(context)

    def _work(self, scene: bpy.types.Scene, *choices: str) -> Work:
        lacking = missing_modules()
        if lacking:
            raise RenderError(
                f"this Blender's Python lacks {', '.join(lacking)}, needed to render into a photo: install PhysGen "
                "from the zip for your system, which brings them, or render with `physgen render`"
            )
        bake = require_folder(scene.physgen.simulation.bake, "Bake")
        if not (bake / MANIFEST_FILE).is_file():
            raise InputError(f"{bake}: holds no bake; bake again, or find it with Find Lost (see Simulate, Cache)")
        photo, baked_scene = require_folder(scene.physgen.folder, "Scene Folder"), bake.parent.parent / "scene"
        names, strangers = photo_names(scene), [item.name for item in bodies(scene) if not item.physgen.source]
        out = _output_folder(scene)
        arguments = ["--out", str(out), "--parent", str(os.getpid()), "--json", *choices]
        arguments += render_arguments(render_options(scene.physgen.rendering))
        start = render_command()
        path = _camera_path(scene, photo, bake)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            if strangers:
                message = f"not in the photo, so not rendered into it: {', '.join(strangers)}"
                on_event({"event": "notice", "message": message})
            with tempfile.TemporaryDirectory(prefix="physgen-render-") as scratch:
                rendered = bake
                if (baked_scene / SCENE_FILE).is_file():
                    rendered = Path(scratch) / "bake"
                    place_bake(photo, baked_scene, bake, rendered, names, on_event)
                command = [*start, str(photo), "--bake", str(rendered), *arguments]
                if path is not None:
                    save_camera_path(Path(scratch) / "camera.json", path)
                    command += ["--camera", str(Path(scratch) / "camera.json")]
                # Which frames were asked for is not in the result.
                return {**run_stage(command, on_event, cancelled, failure=RenderError, restarts=1), "out": str(out)}

        return work


class PHYSGEN_OT_render_still(_Render, bpy.types.Operator):
    """Render the current frame into the photo"""

    bl_idname = "physgen.render_still"
    bl_label = "Render Still"

    def request(self, context: bpy.types.Context) -> Work:
        """The current frame."""
        scene = context.scene
        simulation = scene.physgen.simulation
        manifest = load_manifest(require_folder(simulation.bake, "Bake"))
        first = simulation.frame_start
        sample = scene.frame_current - first
        if not 0 <= sample < manifest.frames_done:
            last = first + manifest.frames_done - 1
            raise InputError(f"frame {scene.frame_current} is not baked: go to one from {first} to {last}")
        number = manifest.frame_start + sample
        work = self._work(scene, "--frames", str(number))
        name = frame_name(number, render_options(scene.physgen.rendering).frame_format.suffix)
        return lambda on_event, cancelled: {**work(on_event, cancelled), "still": name}

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show it."""
        path = Path(str(final["out"])) / str(final["still"])
        if not path.is_file():
            raise RenderError(f"{path}: is not there, although rendering has ended; render again")
        scene.physgen.rendering.result = str(path)
        image = bpy.data.images.load(str(path), check_existing=True)
        image.reload()
        show_result(bpy.context, image)
        return f"rendered {path}"


class PHYSGEN_OT_render_video(_Render, bpy.types.Operator):
    """Render all baked frames into the photo, and a video of them. Frames that are up to date are not rendered again"""

    bl_idname = "physgen.render_video"
    bl_label = "Render Video"

    def request(self, context: bpy.types.Context) -> Work:
        """All frames."""
        scene = context.scene
        name = f"video.{scene.physgen.rendering.video}"
        work = self._work(scene, "--video", str(_output_folder(scene) / name))
        return lambda on_event, cancelled: {**work(on_event, cancelled), "video": name}

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Say where it is."""
        path = Path(str(final["out"])) / str(final["video"])
        scene.physgen.rendering.result = str(path)
        return f"rendered {path}"


CLASSES = (PHYSGEN_OT_render_still, PHYSGEN_OT_render_video)
