# SPDX-License-Identifier: GPL-3.0-or-later
"""Load a capture, with its diagnosis where there is one; clear it; open the report."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import bpy

from ...sim.diagnose.capture import CAPTURE_FILE, Capture, load_capture
from ...sim.diagnose.diagnosis import PAGE_FILE, REPORT_FILE, read_diagnosis
from ...sim.errors import InputError
from ..bridge import capture_scene, capture_view
from ..bridge.capture_materials import FOUND, LAYERS, NOMINAL, OBSERVED
from ..paths import folder_beside, require_folder
from ..props import report as report_props
from ..props.diagnose import apply_view
from ..reports import reports_errors
from ..text import count
from ..views import look_through_camera, turn_to, viewports


def capture_folder(path: str) -> Path:
    """The folder of a capture; its ``capture.json`` is fine too. InputError where there is none."""
    folder = require_folder(path, "Capture")
    folder = folder.parent if folder.name == CAPTURE_FILE else folder
    if not (folder / CAPTURE_FILE).is_file():
        raise InputError(f"{folder}: there is no {CAPTURE_FILE} in it; choose the folder of a capture")
    return folder


def report_folder(state: bpy.types.PropertyGroup) -> Path:
    """Where the diagnosis of the scene's capture is or will be."""
    if state.report.strip():
        return require_folder(state.report, "Diagnosis")
    return folder_beside(capture_folder(state.capture), "diagnosis")


def show_capture(scene: bpy.types.Scene, diagnosis: Path | None) -> Capture:
    """(Re)build the capture of ``scene``, with the diagnosis in the folder ``diagnosis``; what was shown stays shown.

    Raises InputError; what was there before then stays as it was.
    """
    state = scene.physgen_diagnose
    capture = load_capture(capture_folder(state.capture))
    report, arrays = None, capture_scene.Diagnosed()
    if diagnosis is not None:
        report, where, prediction = read_diagnosis(diagnosis)
        arrays = capture_scene.Diagnosed(where=where, prediction=prediction)
    takes = capture_scene.prepare(capture, arrays)
    fresh, trial, had_motion = state.root is None, state.trial if state.trials else "", state.has_motion
    if state.root is not None:
        capture_scene.remove(state.root)
    root = state.root = capture_scene.build(scene, capture, takes)
    _fill_trials(state, capture)
    state.has_scores = any(arrays.score(t) is not None for t in capture.trials)
    state.has_motion = any(arrays.layer(t, NOMINAL) is not None for t in capture.trials)
    if state.has_scores:
        state.most = max(arrays.most(capture), 1e-6)
    if report is not None:
        report_props.fill(state, report)
    else:
        report_props.clear(state)
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
        line.label = f"{len(trial.times)} frames at {rate:.4g} Hz, {trial.observed.shape[1]} points{what}"
    state.capture_warnings.clear()
    for text in capture.warnings:
        state.capture_warnings.add().text = text


def _choose_layers(state: bpy.types.PropertyGroup, *, flat: bool) -> None:
    """Before a diagnosis the recording; after it, the recording as coloured mesh and the nominal model as points.

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
    """Load the capture: its ground, camera, objects and tracked points, and its diagnosis if there is one beside it"""

    bl_idname = "physgen.load_capture"
    bl_label = "Load Capture"
    bl_options = {"UNDO"}  # noqa: RUF012

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Load and show."""
        scene = context.scene
        state = scene.physgen_diagnose
        folder = report_folder(state) if state.report.strip() or _found_beside(state) else None
        if folder is not None and not (folder / REPORT_FILE).is_file():
            folder = None
        capture = show_capture(scene, folder)
        if folder is not None:
            state.report = str(folder)
        turn_to(context, *capture_view.bounds(state.root, state.trial))
        if capture.camera is not None:
            look_through_camera(context)
        self.report({"INFO"}, f"{count(len(capture.trials), 'trial')} of {capture.root.name} loaded")
        return {"FINISHED"}


def _found_beside(state: bpy.types.PropertyGroup) -> bool:
    folder = capture_folder(state.capture)
    return (folder.with_name(f"{folder.name}_diagnosis") / REPORT_FILE).is_file()


class PHYSGEN_OT_load_diagnosis(bpy.types.Operator):
    """Read the diagnosis again and show it with the capture"""

    bl_idname = "physgen.load_diagnosis"
    bl_label = "Load Diagnosis"
    bl_options = {"UNDO"}  # noqa: RUF012

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Load and show."""
        show_capture(context.scene, report_folder(context.scene.physgen_diagnose))
        return {"FINISHED"}


class PHYSGEN_OT_clear_capture(bpy.types.Operator):
    """Take the capture out of the scene; its files stay where they are"""

    bl_idname = "physgen.clear_capture"
    bl_label = "Clear Capture"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is one."""
        return context.scene.physgen_diagnose.root is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove what was built and what was concluded."""
        state = context.scene.physgen_diagnose
        capture_scene.remove(state.root)
        state.trials.clear()
        state.capture_warnings.clear()
        state.has_motion = state.has_scores = False
        report_props.clear(state)
        return {"FINISHED"}


class PHYSGEN_OT_open_report(bpy.types.Operator):
    """Open the diagnosis' page in the browser"""

    bl_idname = "physgen.open_report"
    bl_label = "Open Report"

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Open report.html."""
        page = report_folder(context.scene.physgen_diagnose) / PAGE_FILE
        if not page.is_file():
            raise InputError(f"{page}: there is no such page; run the diagnosis again")
        webbrowser.open(page.as_uri())
        return {"FINISHED"}


class PHYSGEN_OT_follow(bpy.types.Operator):
    """Let the viewport go with the object, close to it; press again to let go"""

    bl_idname = "physgen.follow_object"
    bl_label = "Follow the Object"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is a viewport, and something in it."""
        return context.scene.physgen_diagnose.root is not None and bool(viewports(context))

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Lock the viewports to the body that is shown, or free them."""
        state = context.scene.physgen_diagnose
        spaces = viewports(context)
        if any(space.lock_object is not None for space in spaces):
            turn_to(context, *capture_view.bounds(state.root, state.trial))
            return {"FINISHED"}
        body = capture_view.shown_body(state.root, state.trial)
        if body is None:
            self.report({"WARNING"}, "no object is in sight: show the mesh of a layer")
            return {"CANCELLED"}
        for space in spaces:
            space.lock_object = body
            if space.region_3d is not None:
                space.region_3d.view_distance = 5 * max(body.dimensions)
        return {"FINISHED"}


CLASSES = (
    PHYSGEN_OT_load_capture,
    PHYSGEN_OT_load_diagnosis,
    PHYSGEN_OT_clear_capture,
    PHYSGEN_OT_open_report,
    PHYSGEN_OT_follow,
)
