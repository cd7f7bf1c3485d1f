# SPDX-License-Identifier: GPL-3.0-or-later
"""Switch the live preview on and off."""

from collections.abc import Callable, Sequence
from pathlib import Path

import bpy

from ..interpreter import cli_command, find_python
from ..preview import live
from ..props import preferences
from ..props.body import bodies


def worker_command(preferred: str) -> Callable[[Path], Sequence[str]]:
    """How the worker is started; finding the interpreter can take seconds, so it is left to the client's thread."""

    def command(runs: Path) -> Sequence[str]:
        return cli_command(find_python(preferred), "preview", "--out", str(runs))

    return command


class PHYSGEN_OT_toggle_preview(bpy.types.Operator):
    """Run the scene coarsely whenever something changes, and play that in the viewport. The bake is not touched"""

    bl_idname = "physgen.toggle_preview"
    bl_label = "Live Preview"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """It is on, or something could move."""
        if live.session() is not None or any(item.physgen.role == "dynamic" for item in bodies(context.scene)):
            return True
        cls.poll_message_set("Add an object to the simulation first")
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        """On or off; returns at once."""
        if live.session() is not None:
            live.stop()
        else:
            live.start(context.scene, worker_command(preferences.python(context)))
        return {"FINISHED"}


CLASSES = (PHYSGEN_OT_toggle_preview,)
