# SPDX-License-Identifier: GPL-3.0-or-later
"""Run ``physgen diagnose`` on the loaded capture."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...sim.app.process import run_stage
from ...sim.events import Event, IsCancelled, OnEvent
from ..interpreter import cli_command, find_python
from ..jobs import JobOperator, Work
from ..props.preferences import python
from .capture import capture_folder, report_folder, show_capture


class PHYSGEN_OT_diagnose(JobOperator, bpy.types.Operator):
    """Find out where simulation and recording part, which effect is missing, and how much of the gap it closes"""

    bl_idname = "physgen.diagnose"
    bl_label = "Diagnose"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Diagnosis"

    def request(self, context: bpy.types.Context) -> Work:
        """The diagnosis as a child process."""
        state = context.scene.physgen_diagnose
        capture = capture_folder(state.capture)
        out = report_folder(state)
        preferred = python(context)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            command = cli_command(find_python(preferred), "diagnose", str(capture), "--out", str(out))
            return {"out": str(out), **run_stage(command, on_event, cancelled), "capture": str(capture)}

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show what was found, also where undo has meanwhile taken the capture out of the scene."""
        state, out = scene.physgen_diagnose, Path(str(final["out"]))
        state.capture = str(final["capture"])
        show_capture(scene, out)
        state.report = str(out)
        return str(state.summary)


CLASSES = (PHYSGEN_OT_diagnose,)
