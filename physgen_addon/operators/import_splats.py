# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of Gaussian splats into the scene, as objects that are simulated: menu, file browser."""

from pathlib import Path

import bpy
from bpy.props import EnumProperty, FloatProperty, StringProperty

from ...sim.app.process import run_stage
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from ..bridge.import_splats import import_splats
from ..interpreter import cli_command, find_python
from ..jobs import JobOperator, Work, start_chosen
from ..paths import folder_beside
from ..props.preferences import python

FILES = "*.ply"


class _OfSplats:
    size_m: FloatProperty(
        name="Size",
        description="Largest extent of the object; files of splats do not say how large things are",
        default=0.15,
        min=1e-4,
        max=1e3,
        soft_min=0.01,
        soft_max=10.0,
        unit="LENGTH",
    )
    up: EnumProperty(
        name="Up",
        description="Axis of the file that points up, or down",
        items=[
            ("y-down", "Y Down", "As fits to photos mostly have it"),
            ("y", "Y", ""),
            ("z", "Z", "As Blender has it"),
            ("z-down", "Z Down", ""),
            ("x", "X", ""),
            ("x-down", "X Down", ""),
        ],
    )


class PHYSGEN_OT_import_splats(_OfSplats, JobOperator, bpy.types.Operator):
    """Turn a PLY file of Gaussian splats into an object that is simulated, at the 3D cursor"""

    bl_idname = "physgen.import_splats"
    bl_label = "Import Gaussian Splats"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Import"

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})

    def request(self, context: bpy.types.Context) -> Work:
        """The body around the splats as a child process: Blender's Python lacks what finds it."""
        if not self.filepath.strip():
            raise InputError("no file is chosen; choose a PLY file of Gaussian splats")
        file = Path(bpy.path.abspath(self.filepath))
        if not file.is_file():
            raise InputError(f"{file}: there is no such file; choose a PLY file of Gaussian splats")
        out, preferred = folder_beside(file, "scene"), python(context)
        options = ("--size", f"{self.size_m:.7g}", "--up", self.up)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            arguments = ("import", str(file), "--out", str(out), *options)
            return run_stage(cli_command(find_python(preferred), *arguments), on_event, cancelled)

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Put what came of it into the scene."""
        items = import_splats(scene, Path(str(final["scene"])))
        layer = bpy.context.view_layer
        if bpy.context.scene == scene:
            layer.update()
            for item in layer.objects:
                item.select_set(item in items)
            layer.objects.active = items[0]
        return f"{', '.join(item.name for item in items)} imported; choose its material, then bake"


class PHYSGEN_OT_choose_splats(_OfSplats, bpy.types.Operator):
    """Choose a PLY file of Gaussian splats, which becomes an object that is simulated"""

    bl_idname = "physgen.choose_splats"
    bl_label = "Import Gaussian Splats"

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=FILES, options={"HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """As the import itself."""
        return PHYSGEN_OT_import_splats.poll(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the file."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the job."""
        given = {"filepath": self.filepath, "size_m": self.size_m, "up": self.up}
        return start_chosen(self, context, bpy.ops.physgen.import_splats, given)


CLASSES = (PHYSGEN_OT_import_splats, PHYSGEN_OT_choose_splats)


def _draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator(PHYSGEN_OT_choose_splats.bl_idname, text="Gaussian Splats for PhysGen (.ply)")


def register() -> None:
    """Into File > Import."""
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    """Out of it."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
