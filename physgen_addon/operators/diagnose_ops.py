# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: explain a video, load a capture, diagnose it."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import bpy
from mathutils import Vector

from ...sim.app.stage_process import run_stage
from ...sim.diagnose.capture import Capture
from ...sim.diagnose.capture_folder import CAPTURE_FILE, load_capture
from ...sim.diagnose.diagnosis import PAGE_FILE, REPORT_FILE, read_diagnosis
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.html import require_harmless
from ..background_jobs import JobOperator, Work
from ..context import look_through_camera, turn_to, viewports
from ..interpreter import cli_command, find_python
from ..paths import folder_beside, free_folder, require_file, require_folder, stored
from ..playback import capture_scene, capture_view
from ..playback.capture_materials import FOUND, LAYERS, NOMINAL, OBSERVED
from ..props.body_props import is_body
from ..props.diagnose_props import apply_view, clear_diagnosis, fill_diagnosis
from ..props.preferences import python
from ..text import count, report_errors
from .import_ops import hide_all


def capture_folder(path: str) -> Path:
    """Return the folder of a capture, from the folder or its ``capture.json``. Raises InputError without one."""
    folder = require_folder(path, "Capture")
    folder = folder.parent if folder.name == CAPTURE_FILE else folder
    if not (folder / CAPTURE_FILE).is_file():
        raise InputError(f"{folder}: there is no {CAPTURE_FILE} in it; choose the folder of a capture")
    return folder


def report_folder(state: bpy.types.PropertyGroup) -> Path:
    """Return the folder of the diagnosis of the scene's capture, existing or not."""
    if state.report.strip():
        return require_folder(state.report, "Diagnosis")
    return folder_beside(capture_folder(state.capture), "diagnosis")


def stored_path(final: Event, name: str) -> str:
    """Return the path ``name`` of a job's last event as the scene stores it."""
    return stored(Path(str(final[name])))


def show_capture(scene: bpy.types.Scene, diagnosis: Path | None) -> Capture:
    """(Re)build the capture of ``scene`` with the diagnosis in the folder ``diagnosis``; keep the visible trial
    and layers.

    Raises InputError; then nothing has changed.
    """
    state = scene.physgen_diagnose
    capture = load_capture(capture_folder(state.capture))
    report, arrays = None, capture_scene.Diagnosed()
    if diagnosis is not None:
        report, where, prediction = read_diagnosis(diagnosis)
        arrays = capture_scene.Diagnosed(where=where, prediction=prediction)
    built_trials = capture_scene.prepare(capture, arrays)
    fresh, trial, had_motion = state.root is None, state.trial if state.trials else "", state.has_motion
    if state.root is not None:
        capture_scene.remove(state.root)
    root = state.root = capture_scene.build(scene, capture, built_trials)
    _fill_trials(state, capture)
    state.has_scores = any(arrays.score(t) is not None for t in capture.trials)
    state.has_motion = any(arrays.layer(t, NOMINAL) is not None for t in capture.trials)
    if state.has_scores:
        state.most = max(arrays.most(capture), 1e-6)
    if report is not None:
        fill_diagnosis(state, report)
    else:
        clear_diagnosis(state)
    if fresh or had_motion != state.has_motion:
        _choose_layers(state, flat=capture.camera is not None and not state.has_motion)
        state.radius = 0.03 * max(float((o.vertices.max(0) - o.vertices.min(0)).max()) for o in capture.objects)
    names = [t.name for t in capture.trials]
    state.trial = trial if trial in names else names[0]
    apply_view(state)
    capture_view.play_range(scene, root, state.trial)
    return capture


def _fill_trials(state: bpy.types.PropertyGroup, capture: Capture) -> None:
    state.trials.clear()
    for trial in capture.trials:
        line = state.trials.add()
        line.name = trial.name
        rate = (len(trial.times) - 1) / (trial.times[-1] - trial.times[0])
        what = "" if trial.role == "fit" else "; its end is withheld"
        line.label = f"{len(trial.times)} frames at {rate:.4g} Hz, {count(trial.observed.shape[1], 'point')}{what}"
    state.capture_warnings.clear()
    for text in capture.warnings:
        state.capture_warnings.add().text = text


def _choose_layers(state: bpy.types.PropertyGroup, *, flat: bool) -> None:
    """Choose visible layers: the recording; with a diagnosis, the recording as coloured mesh and the nominal
    model as points.

    flat: the points are pixels of unknown depth, to which a mesh cannot be fitted.
    """
    chosen = {
        OBSERVED: {"points": True, "trail": True, "body": not flat},
        NOMINAL: {"points": state.has_motion, "trail": state.has_motion, "body": False},
        FOUND: {"points": False, "trail": False, "body": False},
    }
    for name in LAYERS:
        for key, value in chosen[name].items():
            setattr(getattr(state, name), key, value)


class PHYSGEN_OT_load_capture(bpy.types.Operator):
    """Load the capture: its ground, camera, objects and tracked points, and a diagnosis beside it"""

    bl_idname = "physgen.load_capture"
    bl_label = "Load Capture"
    bl_options = {"UNDO"}  # noqa: RUF012

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Load and show."""
        scene = context.scene
        state = scene.physgen_diagnose
        folder = report_folder(state) if state.report.strip() or _found_beside(state) else None
        if folder is not None and not (folder / REPORT_FILE).is_file():
            folder = None
        is_first = state.root is None
        capture = show_capture(scene, folder)
        hidden = _show_first(scene) if is_first else ""
        if folder is not None:
            state.report = stored(folder)
        turn_to(context, *capture_view.capture_bounds(state.root, state.trial))
        if capture.camera is not None:
            look_through_camera(context)
        trials = f"{count(len(capture.trials), 'trial')} of {capture_folder(state.capture).name}"
        self.report({"INFO"}, f"{trials} loaded{hidden}")
        return {"FINISHED"}


def _show_first(scene: bpy.types.Scene) -> str:
    """Go to the middle of the recording, where trails show its motion, and hide what it lies inside; return the end of
    a report.
    """
    scene.frame_set((scene.frame_start + scene.frame_end) // 2)
    return _hide_around(scene)


def _hide_around(scene: bpy.types.Scene) -> str:
    """Hide meshes that the recording lies inside, such as Blender's default cube; return the end of a report."""
    state = scene.physgen_diagnose
    low, high = capture_view.capture_bounds(state.root, state.trial)
    middle, own = (low + high) / 2, set(state.root.all_objects)

    def is_around(item: bpy.types.Object) -> bool:
        if item.type != "MESH" or item in own or is_body(item):
            return False
        corners = [item.matrix_world @ Vector(corner) for corner in item.bound_box]
        return all(min(c[axis] for c in corners) < middle[axis] < max(c[axis] for c in corners) for axis in range(3))

    return hide_all(item for item in scene.objects if is_around(item))


def _found_beside(state: bpy.types.PropertyGroup) -> bool:
    folder = capture_folder(state.capture)
    return (folder.with_name(f"{folder.name}_diagnosis") / REPORT_FILE).is_file()


class PHYSGEN_OT_load_diagnosis(bpy.types.Operator):
    """Reload the diagnosis and show it with the capture"""

    bl_idname = "physgen.load_diagnosis"
    bl_label = "Load Diagnosis"
    bl_options = {"UNDO"}  # noqa: RUF012

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Load and show."""
        show_capture(context.scene, report_folder(context.scene.physgen_diagnose))
        return {"FINISHED"}


class PHYSGEN_OT_clear_capture(bpy.types.Operator):
    """Remove the capture from the scene; its files are kept"""

    bl_idname = "physgen.clear_capture"
    bl_label = "Clear Capture"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if there is one."""
        return context.scene.physgen_diagnose.root is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove its objects and results."""
        state = context.scene.physgen_diagnose
        capture_scene.remove(state.root)
        state.trials.clear()
        state.capture_warnings.clear()
        state.has_motion = state.has_scores = False
        clear_diagnosis(state)
        return {"FINISHED"}


class PHYSGEN_OT_open_report(bpy.types.Operator):
    """Open the report of the diagnosis in the browser"""

    bl_idname = "physgen.open_report"
    bl_label = "Open Report"

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Open report.html."""
        page = report_folder(context.scene.physgen_diagnose) / PAGE_FILE
        require_harmless(page)
        webbrowser.open(page.as_uri())
        return {"FINISHED"}


class PHYSGEN_OT_follow(bpy.types.Operator):
    """Make the viewport follow the object closely; press again to release"""

    bl_idname = "physgen.follow_object"
    bl_label = "Follow the Object"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with a viewport and a visible object."""
        return context.scene.physgen_diagnose.root is not None and bool(viewports(context))

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Lock the viewports to the visible body, or release them."""
        state = context.scene.physgen_diagnose
        spaces = viewports(context)
        if any(space.lock_object is not None for space in spaces):
            turn_to(context, *capture_view.capture_bounds(state.root, state.trial))
            return {"FINISHED"}
        body = capture_view.shown_body(state.root, state.trial)
        if body is None:
            self.report({"WARNING"}, "no object is visible: show the mesh of a layer")
            return {"CANCELLED"}
        for space in spaces:
            space.lock_object = body
            if space.region_3d is not None:
                space.region_3d.view_distance = 5 * max(body.dimensions)
        return {"FINISHED"}


class PHYSGEN_OT_diagnose(JobOperator, bpy.types.Operator):
    """Find where simulation and recording differ, which effect is missing, and how much of the gap it closes"""

    bl_idname = "physgen.diagnose"
    bl_label = "Diagnose"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Diagnosis"

    def request(self, context: bpy.types.Context) -> Work:
        """Return the diagnosis as a child process."""
        state = context.scene.physgen_diagnose
        capture = capture_folder(state.capture)
        out = report_folder(state)
        preferred = python(context)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            command = cli_command(find_python(preferred), "diagnose", str(capture), "--out", str(out))
            return {"out": str(out), **run_stage(command, on_event, cancelled), "capture": str(capture)}

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show the result, also if undo has meanwhile removed the capture from the scene."""
        state, out = scene.physgen_diagnose, Path(str(final["out"]))
        state.capture = stored_path(final, "capture")
        show_capture(scene, out)
        state.report = stored(out)
        return str(state.summary)


def body_text(video: bpy.types.PropertyGroup) -> str:
    """Return the body of ``video`` as ``--object`` takes it. Raises InputError for a mesh without a file."""
    if video.kind == "mesh":
        return f"mesh:file={require_file(video.mesh, 'Mesh')}"
    if video.kind == "box":
        return "box:" + ",".join(f"{axis}={edge:.6g}" for axis, edge in zip("xyz", video.edges, strict=True))
    height = f",height={video.height:.6g}" if video.kind == "cylinder" else ""
    return f"{video.kind}:diameter={video.diameter:.6g}{height}"


class PHYSGEN_OT_explain_video(JobOperator, bpy.types.Operator):
    """Follow the body in the video, and find why its motion differs from the simulation; no capture is needed"""

    bl_idname = "physgen.explain_video"
    bl_label = "Explain a Video"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Explanation"

    def request(self, context: bpy.types.Context) -> Work:
        """Return tracking, diagnosis and comparison as a child process."""
        video = context.scene.physgen_diagnose.video
        source = require_file(video.file, "Video")
        out = free_folder(folder_beside(source.with_suffix(""), "explained"))
        rate = ("--fps-override", f"{video.fps:.9g}") if video.fps > 0 else ()
        part = ("--start-frame", str(video.start), *(("--end-frame", str(video.end)) if video.end > 0 else ()))
        arguments = ("explain", str(source), "--object", body_text(video), *rate, *part, "--out", str(out))
        preferred = python(context)
        return lambda on_event, cancelled: run_stage(
            cli_command(find_python(preferred), *arguments), on_event, cancelled
        )

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show the capture with its diagnosis; the comparison can be played from the panel."""
        state = scene.physgen_diagnose
        state.capture, state.report, state.video.comparison = (
            stored_path(final, name) for name in ("capture", "diagnosis", "video")
        )
        is_first = state.root is None
        show_capture(scene, Path(str(final["diagnosis"])))
        if is_first:
            _show_first(scene)
        turn_to(bpy.context, *capture_view.capture_bounds(state.root, state.trial))
        return str(state.summary)
