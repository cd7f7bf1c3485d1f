# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: import scene folders, PhysGen3D folders and Gaussian splats (menus, file browser, drag and drop)."""

from collections.abc import Iterable
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty

from ...sim.app.stage_process import run_stage
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.importers.physgen3d import read_physgen3d
from ...sim.scene.folder import SCENE_FILE
from ..background_jobs import JobOperator, Work, start_chosen
from ..context import show_photo
from ..interpreter import cli_command, find_python
from ..paths import folder_beside, require_folder
from ..props.body_props import bodies
from ..props.preferences import python
from ..scene_io.import_scene import import_notes, import_scene, import_splats
from ..text import count, report_errors

SKIP = {"SKIP_SAVE"}


def show_scene(scene: bpy.types.Scene, root: Path, *, hide_others: bool = True) -> str:
    """Import the scene folder ``root`` into ``scene`` and look through its camera; return messages to report.

    hide_others: hide objects that were in the scene before its first import. Raises InputError.
    """
    others = [] if scene.physgen.photo_root is not None or not hide_others else list(scene.objects)
    collection = import_scene(scene, root)
    hidden = hide_all(others)
    found = bodies(scene)
    choose(scene, [item for item in found if item.name in collection.all_objects])
    show_photo(bpy.context, scene)
    text = f"{count(len(found), 'object')} imported{hidden}"
    return ". ".join([text, *import_notes(collection)])


def hide_all(items: Iterable[bpy.types.Object]) -> str:
    """Hide those of ``items`` that are visible, for the viewport and for renders; return the end of a report."""
    visible = [item for item in items if not item.hide_viewport]
    for item in visible:
        item.hide_viewport = item.hide_render = True
    if not visible:
        return ""
    return f"; {', '.join(item.name for item in visible[:3])}{' …' if len(visible) > 3 else ''} hidden"


def choose(scene: bpy.types.Scene, items: list[bpy.types.Object]) -> None:
    """Make the first of ``items`` active, the others unselected."""
    layer = bpy.context.view_layer
    if bpy.context.scene != scene or not items:
        return
    # Until then the view layer lists objects of a removed import.
    layer.update()
    for item in layer.objects:
        item.select_set(item == items[0])
    layer.objects.active = items[0]


class PHYSGEN_OT_import_scene(bpy.types.Operator):
    """Open a PhysGen scene: camera, photo, ground, light and objects, matched to the photo"""

    bl_idname = "physgen.import_scene"
    bl_label = "Import PhysGen Scene"
    bl_options = {"UNDO"}  # noqa: RUF012

    filepath: StringProperty(
        name="Scene", description="scene.json of a scene folder, or the folder", subtype="FILE_PATH", options=SKIP
    )
    filter_glob: StringProperty(default="*.json", options={"HIDDEN"})
    hide_others: BoolProperty(
        name="Hide Other Objects",
        description="Hide objects already in the scene, which would obstruct the view",
        default=True,
    )

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Import and show."""
        if not self.filepath.strip():
            raise InputError(f"no scene is chosen; choose the file {SCENE_FILE} of a PhysGen scene folder")
        path = Path(bpy.path.abspath(self.filepath))
        text = show_scene(context.scene, path, hide_others=self.hide_others)
        self.report({"INFO"}, text)
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Import a dropped file directly; otherwise ask for one."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}


class _OfPhysgen3d:
    size_m: FloatProperty(
        name="Size of the First Object",
        description="Largest extent, which sets the scale of the scene; PhysGen3D does not store it",
        default=0.15,
        min=1e-4,
        max=1e3,
        soft_min=0.01,
        soft_max=10.0,
        unit="LENGTH",
    )


class PHYSGEN_OT_import_physgen3d(_OfPhysgen3d, JobOperator, bpy.types.Operator):
    """Convert an output folder of PhysGen3D to a scene folder beside it, and open that"""

    bl_idname = "physgen.import_physgen3d"
    bl_label = "Import PhysGen3D Output"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Import"

    directory: StringProperty(
        name="Folder",
        description="Folder with transform.json, meshes, mask and inpaint",
        subtype="DIR_PATH",
        options=SKIP,
    )

    def request(self, context: bpy.types.Context) -> Work:
        """Return the conversion as a child process."""
        root = require_folder(self.directory, "Folder")
        read_physgen3d(root)
        out, size, preferred = folder_beside(root, "scene"), f"{self.size_m:.7g}", python(context)

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            arguments = ("import", str(root), "--out", str(out), "--size", size)
            return run_stage(cli_command(find_python(preferred), *arguments), on_event, cancelled)

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Open the scene folder."""
        return show_scene(scene, Path(str(final["scene"])))


class PHYSGEN_OT_choose_physgen3d(_OfPhysgen3d, bpy.types.Operator):
    """Choose an output folder of PhysGen3D and open it"""

    bl_idname = "physgen.choose_physgen3d"
    bl_label = "Import PhysGen3D Output"

    directory: StringProperty(subtype="DIR_PATH", options=SKIP)
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled as the import itself."""
        return PHYSGEN_OT_import_physgen3d.poll(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the job."""
        given = {"directory": self.directory, "size_m": self.size_m}
        return start_chosen(self, context, bpy.ops.physgen.import_physgen3d, given)


class PHYSGEN_FH_scene(bpy.types.FileHandler):
    """Drop of a scene.json on a 3D viewport; other JSON files are rejected with a message."""

    bl_idname = "PHYSGEN_FH_scene"
    bl_label = "PhysGen Scene"
    bl_import_operator = "physgen.import_scene"
    bl_file_extensions = ".json"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Accept drops on 3D viewports. Blender does not pass the file's name before the drop."""
        return context.area is not None and context.area.type == "VIEW_3D"


def _draw_scene_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator(PHYSGEN_OT_import_scene.bl_idname, text="PhysGen Scene (scene.json)")
    self.layout.operator(PHYSGEN_OT_choose_physgen3d.bl_idname, text="PhysGen3D Output (folder)")


def register_scene_menu() -> None:
    """Add to File > Import."""
    bpy.types.TOPBAR_MT_file_import.append(_draw_scene_menu)


def unregister_scene_menu() -> None:
    """Remove from File > Import."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_scene_menu)


FILES = ".ply"


class _OfSplats:
    size_m: FloatProperty(
        name="Size",
        description="Largest extent of the object; splat files have no scale",
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
            ("y-down", "Y Down", "Usual for fits to photos"),
            ("y", "Y", ""),
            ("z", "Z", "As in Blender"),
            ("z-down", "Z Down", ""),
            ("x", "X", ""),
            ("x-down", "X Down", ""),
        ],
    )


class PHYSGEN_OT_import_splats(_OfSplats, JobOperator, bpy.types.Operator):
    """Import a PLY file of Gaussian splats as a simulated object, at the 3D cursor"""

    bl_idname = "physgen.import_splats"
    bl_label = "Import Gaussian Splats"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Import"

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})

    def request(self, context: bpy.types.Context) -> Work:
        """Return the fit of a body around the splats as a child process: Blender's Python lacks its packages."""
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
        """Add the result to the scene."""
        items = import_splats(scene, Path(str(final["scene"])))
        layer = bpy.context.view_layer
        if bpy.context.scene == scene:
            layer.update()
            for item in layer.objects:
                item.select_set(item in items)
            layer.objects.active = items[0]
        return f"{', '.join(item.name for item in items)} imported; choose its material, then bake"


class PHYSGEN_OT_choose_splats(_OfSplats, bpy.types.Operator):
    """Choose a PLY file of Gaussian splats to import as a simulated object"""

    bl_idname = "physgen.choose_splats"
    bl_label = "Import Gaussian Splats"

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=f"*{FILES}", options={"HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled as the import itself."""
        return PHYSGEN_OT_import_splats.poll(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the file; of a dropped one, for its size."""
        if self.filepath:
            return context.window_manager.invoke_props_dialog(self, title=Path(self.filepath).name)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw size and direction."""
        self.layout.use_property_split = True
        self.layout.prop(self, "size_m")
        self.layout.prop(self, "up")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the job."""
        given = {"filepath": self.filepath, "size_m": self.size_m, "up": self.up}
        return start_chosen(self, context, bpy.ops.physgen.import_splats, given)


class PHYSGEN_FH_splats(bpy.types.FileHandler):
    """Drop of a .ply on a 3D viewport: Blender asks whether it is a mesh or splats."""

    bl_idname = "PHYSGEN_FH_splats"
    bl_label = "Gaussian Splats for PhysGen"
    bl_import_operator = "physgen.choose_splats"
    bl_file_extensions = FILES

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Accept drops on 3D viewports."""
        return context.area is not None and context.area.type == "VIEW_3D"


def _draw_splats_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator(PHYSGEN_OT_choose_splats.bl_idname, text="Gaussian Splats for PhysGen (.ply)")


def register_splats_menu() -> None:
    """Add to File > Import."""
    bpy.types.TOPBAR_MT_file_import.append(_draw_splats_menu)


def unregister_splats_menu() -> None:
    """Remove from File > Import."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_splats_menu)
