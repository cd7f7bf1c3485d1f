# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: open a sample, and register the asset library, whose materials bring their matter along.

``setup/assets.py`` (``make assets``) builds the library. Of its materials each has the name of a preset as a custom
property; an object that one is dropped on gets that preset.
"""

import math
import shutil
from collections.abc import Iterable
from pathlib import Path

import bpy
from bpy.app.handlers import persistent
from bpy.props import EnumProperty, StringProperty

from ...sim.errors import InputError
from ...sim.files import read_toml
from .. import paths
from ..context import TAB, show_beside, show_whole
from ..photo.photo_image import drop_mask
from ..props import material_props
from ..props.body_props import is_body
from ..scene_io.sample_scene import add_sample
from ..text import report_errors
from .bake_ops import warm_up
from .import_ops import choose, hide_all
from .photo_ops import add_box, set_photo

DEMO = Path(__file__).resolve().parents[2] / "presets" / "demo"
DEMO_NAME = "coffee"
"""The demo's photo and its boxes: ``NAME.jpg``, ``NAME.toml``."""
MAX_BYTES = 1 << 20
LAST_FRAME = 40
"""Of the mesh sample: the jelly has come to rest and the sand has spread."""


class PHYSGEN_OT_open_sample(bpy.types.Operator):
    """Open a sample to try PhysGen; the next click is Bake, or Reconstruct"""

    bl_idname = "physgen.open_sample"
    bl_label = "Open Sample"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    sample: EnumProperty(
        name="Sample",
        description="Sample to open",
        items=[
            ("MESHES", "Meshes", "Jelly, sand, wood and a ramp; press Bake. What is in the scene is hidden"),
            ("PHOTO", "Photo", "A cup of coffee with a box around it; press Reconstruct"),
        ],
        options={"SKIP_SAVE"},
    )

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """Return that of the sample."""
        return str(cls.bl_rna.properties["sample"].enum_items[properties.sample].description)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled in Object Mode."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave Edit Mode first")
        return context.mode == "OBJECT"

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Open it."""
        if self.sample == "PHOTO":
            self.report({"INFO"}, open_photo(context))
        else:
            self.report({"INFO"}, open_meshes(context))
        return {"FINISHED"}


def open_meshes(context: bpy.types.Context) -> str:
    """Add the mesh sample to the context's scene and look through its camera; return what to report."""
    scene = context.scene
    hidden = hide_all(item for item in scene.objects if not is_body(item))
    simulation = scene.physgen.simulation
    choose(scene, add_sample(scene))
    simulation.frame_start, simulation.frame_end = 1, LAST_FRAME
    warm_up(context)
    show_whole(context, scene, colours="MATERIAL", light="STUDIO")
    return f"The sample is open: press Bake{hidden}"


def open_photo(context: bpy.types.Context) -> str:
    """Open a copy of the demo's photo with its boxes; return what to report. InputError if it cannot be copied.

    The copy is among the user's files: the scene folder is made beside it while the .blend is unsaved.
    """
    photo = paths.user_folder("samples", create=True) / f"{DEMO_NAME}.jpg"
    try:
        if not photo.is_file():
            shutil.copyfile(DEMO / photo.name, photo)
        known = read_toml(DEMO / f"{DEMO_NAME}.toml", MAX_BYTES, what="sample")
    except OSError as error:
        raise InputError(f"{photo}: cannot be written ({error.strerror or error}); check the permissions") from error
    scene = context.scene
    set_photo(scene, photo)
    state = scene.physgen_photo
    for box in state.boxes:
        drop_mask(box)
    state.boxes.clear()
    state.camera, state.pitch = "PITCH", math.radians(known["pitch"])
    given = zip(known["boxes"], known["names"], known["sizes"], known["presets"], strict=True)
    for corners, name, size, preset in given:
        x0, y0, x1, y1 = (round(number) for number in corners)
        box = add_box(scene, (x0, y0, x1, y1), name)
        # Of jelly, as in the demo: one of plastic bakes seven times as long and shows nothing but that it slides.
        box.size_m, box.preset = size, preset
    show_beside(context, state.image, TAB)
    return "The sample is open: press Reconstruct"


PRESET = "physgen_preset"
"""Custom property of a material: preset that an object with it is made of."""
TAKEN = "physgen_preset_taken"
"""Custom property of an object: preset that it has got from a material, so that later choices stay."""
LIBRARY, FILE = "PhysGen", "physgen_assets.blend"
"""Name of the asset library in the preferences, and the file that makes a folder one."""


def take_dropped(items: Iterable[bpy.types.Object]) -> list[str]:
    """Give those meshes of ``items`` that have got a material with a preset since that preset; return their names."""
    changed = []
    for item in items:
        material = item.active_material if item.type == "MESH" else None
        preset = str(material.get(PRESET, "")) if material is not None else ""
        if preset == item.get(TAKEN, "") or not item.is_editable:
            continue
        # Another material without a preset says nothing about matter; the same one dropped again does.
        item[TAKEN] = preset
        if material_props.find_preset(preset) is not None:
            item.physgen.material.preset = preset
            changed.append(item.name)
    return changed


@persistent
def _on_change(scene: bpy.types.Scene, graph: bpy.types.Depsgraph | None = None) -> None:
    """Look at what has changed alone: an object that gets a material is updated itself."""
    if graph is not None:
        shaded = (u for u in graph.updates if u.is_updated_geometry or u.is_updated_shading)
        take_dropped(u.id.original for u in shaded if isinstance(u.id, bpy.types.Object))


def register_material_drop() -> None:
    """Watch for materials that objects get."""
    bpy.app.handlers.depsgraph_update_post.append(_on_change)


def unregister_material_drop() -> None:
    """Watch no more."""
    bpy.app.handlers.depsgraph_update_post.remove(_on_change)


class PHYSGEN_OT_add_assets(bpy.types.Operator):
    """Register a folder with PhysGen's assets among the asset libraries of Blender's preferences"""

    bl_idname = "physgen.add_assets"
    bl_label = "Add Asset Library"

    directory: StringProperty(
        name="Folder", description=f"Folder that holds {FILE}", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the folder: choosing it is the user's consent."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Register it, or point the library that is there to it."""
        folder = Path(bpy.path.abspath(self.directory.strip() or "."))
        if not self.directory.strip() or not (folder / FILE).is_file():
            raise InputError(f"{folder}: holds no {FILE}; make it with `make assets`, or choose its folder")
        libraries = context.preferences.filepaths.asset_libraries
        known = next((library for library in libraries if library.name == LIBRARY), None)
        if known is None:
            known = libraries.new(name=LIBRARY, directory=str(folder))
        known.path = str(folder)
        context.preferences.is_dirty = True
        self.report({"INFO"}, f"{LIBRARY} is among the asset libraries: open an asset browser and choose it")
        return {"FINISHED"}
