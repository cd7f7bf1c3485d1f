# SPDX-License-Identifier: GPL-3.0-or-later
"""The preferences' buttons: is there a Python that simulates, and what to type where there is none."""

import bpy

from ...sim.errors import Cancelled
from ...sim.events import Event, IsCancelled, OnEvent
from .. import interpreter
from ..jobs import JobOperator, Work
from ..props import preferences


class PHYSGEN_OT_check_python(JobOperator, bpy.types.Operator):
    """Start the interpreter that would simulate and ask it whether it has all that is needed"""

    bl_idname = "physgen.check_python"
    bl_label = "Check"
    job_title = "Check"

    def request(self, context: bpy.types.Context) -> Work:
        """The check, anew: what was installed meanwhile counts."""
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
            return {"event": "done", "python": str(python), "version": interpreter.python_version(python)}

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show the answer on the preferences' page; NoPython, to be reported as an error, where it is a no."""
        if not final["python"]:
            reason, command = str(final["reason"]), str(final["command"])
            preferences.show_check(bpy.context, "NO", reason, command)
            raise interpreter.NoPython(reason, command)
        sentence = f"Python {final['version']} simulates: {final['python']}"
        preferences.show_check(bpy.context, "YES", sentence, "")
        return sentence


class PHYSGEN_OT_copy_command(bpy.types.Operator):
    """Copy the command; paste it into a terminal and press Check when it has ended"""

    bl_idname = "physgen.copy_command"
    bl_label = "Copy"

    command: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """To the clipboard."""
        context.window_manager.clipboard = self.command
        self.report({"INFO"}, "copied")
        return {"FINISHED"}


CLASSES = (PHYSGEN_OT_check_python, PHYSGEN_OT_copy_command)
