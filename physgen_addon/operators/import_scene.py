# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene folders and PhysGen3D's output folders into the scene: menus, file browser, drag and drop.

A folder itself cannot be dropped on Blender: file handlers go by the ending of a file's name. Its scene.json can.
"""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, FloatProperty, StringProperty

from ...sim.app.process import run_stage
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.importers.physgen3d import read_physgen3d
from ...sim.scene.folder import SCENE_FILE
from ..bridge.import_scene import import_notes, import_scene
from ..interpreter import cli_command, find_python
from ..jobs import JobOperator, Work, start_chosen
from ..paths import folder_beside, require_folder
from ..props.body import bodies
from ..props.preferences import python
from ..reports import reports_errors
from ..text import count
from ..views import show_photo

SKIP = {"SKIP_SAVE"}


def show_scene(scene: bpy.types.Scene, root: Path, *, hide_others: bool = True) -> str:
    """Import the scene folder ``root`` into ``scene`` and look through its camera; the sentences to report.

    hide_others: what was in the scene before its first import would stand in the picture. Raises InputError.
    """
    others = [] if scene.physgen.photo_root is not None or not hide_others else list(scene.objects)
    collection = import_scene(scene, root)
    visible = [item for item in others if not item.hide_viewport]
    for item in visible:
        item.hide_viewport = item.hide_render = True
    found = bodies(scene)
    _choose(scene, [item for item in found if item.name in collection.all_objects])
    show_photo(bpy.context, scene)
    text = f"{count(len(found), 'object')} imported"
    if visible:
        text += f"; {', '.join(item.name for item in visible[:3])}{' …' if len(visible) > 3 else ''} hidden"
    return ". ".join([text, *import_notes(collection)])


def _choose(scene: bpy.types.Scene, items: list[bpy.types.Object]) -> None:
    """Make the first of ``items`` the chosen object, the others unselected."""
    layer = bpy.context.view_layer
    if bpy.context.scene != scene or not items:
        return
    # Until then it lists objects that an earlier import's removal has taken away.
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
        description="Hide what is in the scene already, because it would stand in the picture",
        default=True,
    )

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Import and show."""
        if not self.filepath.strip():
            raise InputError(f"no scene is chosen; choose the file {SCENE_FILE} of a PhysGen scene folder")
        path = Path(bpy.path.abspath(self.filepath))
        text = show_scene(context.scene, path, hide_others=self.hide_others)
        self.report({"INFO"}, text)
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """A dropped file at once; otherwise ask for one."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}


class _OfPhysgen3d:
    size_m: FloatProperty(
        name="Size of the First Object",
        description="Its largest extent, which sets the scale of the scene; PhysGen3D does not know it",
        default=0.15,
        min=1e-4,
        max=1e3,
        soft_min=0.01,
        soft_max=10.0,
        unit="LENGTH",
    )


class PHYSGEN_OT_import_physgen3d(_OfPhysgen3d, JobOperator, bpy.types.Operator):
    """Turn an output folder of PhysGen3D into a scene folder beside it, and open that"""

    bl_idname = "physgen.import_physgen3d"
    bl_label = "Import PhysGen3D Output"
    bl_options = {"UNDO"}  # noqa: RUF012
    job_title = "Import"

    directory: StringProperty(
        name="Folder", description="With transform.json, meshes, mask and inpaint", subtype="DIR_PATH", options=SKIP
    )

    def request(self, context: bpy.types.Context) -> Work:
        """The conversion as a child process."""
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
        """As the import itself."""
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
    """A scene.json that is dropped on a 3D viewport; other JSON files are refused with a message."""

    bl_idname = "PHYSGEN_FH_scene"
    bl_label = "PhysGen Scene"
    bl_import_operator = "physgen.import_scene"
    bl_file_extensions = ".json"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Onto a 3D viewport. Blender does not tell the file's name before it is dropped."""
        return context.area is not None and context.area.type == "VIEW_3D"


CLASSES = (
    PHYSGEN_OT_import_scene,
    PHYSGEN_OT_import_physgen3d,
    PHYSGEN_OT_choose_physgen3d,
    PHYSGEN_FH_scene,
)


def _draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator(PHYSGEN_OT_import_scene.bl_idname, text="PhysGen Scene (scene.json)")
    self.layout.operator(PHYSGEN_OT_choose_physgen3d.bl_idname, text="PhysGen3D Output (folder)")


def register() -> None:
    """Into File > Import."""
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    """Out of it."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
