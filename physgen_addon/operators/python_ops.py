# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the preferences: check the Python interpreter, and copy the command that installs one."""

import bpy

from ...sim.errors import Cancelled
from ...sim.events import Event, IsCancelled, OnEvent
from .. import interpreter
from ..background_jobs import JobOperator, Work
from ..props import preferences


class PHYSGEN_OT_check_python(JobOperator, bpy.types.Operator):
    """Start the interpreter for simulations and check that it has all required packages"""

    bl_idname = "physgen.check_python"
    bl_label = "Check"
    job_title = "Check"

    def request(self, context: bpy.types.Context) -> Work:
        """Return the check, without cached results."""
        preferred = preferences.python(context)
        preferences.show_check(context, "", "", "")

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            interpreter.forget()
            try:
                python = interpreter.find_python(preferred)
            except interpreter.NoPython as error:
                return {"event": "done", "python": "", "reason": error.reason, "command": error.command}
            if cancelled():
                raise Cancelled("the check was cancelled")
            answer = {"event": "done", "python": str(python), "version": interpreter.python_version(python)}
            try:
                if interpreter.missing_modules():
                    interpreter.require_renderer(python)
            except interpreter.NoPython as error:
                return {**answer, "reason": error.reason, "command": error.command}
            return {**answer, "reason": "", "command": ""}

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show the result in the preferences; NoPython is also reported as an error."""
        if not final["python"]:
            reason, command = str(final["reason"]), str(final["command"])
            preferences.show_check(bpy.context, "NO", reason, command)
            raise interpreter.NoPython(reason, command)
        sentence = str(final["reason"]) or f"Python {final['version']} simulates: {final['python']}"
        preferences.show_check(bpy.context, "NO" if final["reason"] else "YES", sentence, str(final["command"]))
        return sentence


class PHYSGEN_OT_copy_command(bpy.types.Operator):
    """Copy the command; run it in a terminal, then press Check"""

    bl_idname = "physgen.copy_command"
    bl_label = "Copy"

    command: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Copy to the clipboard."""
        context.window_manager.clipboard = self.command
        self.report({"INFO"}, "copied")
        return {"FINISHED"}
