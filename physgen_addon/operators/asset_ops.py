# SPDX-License-Identifier: GPL-3.0-or-later
"""Assets: materials that bring their matter along, and the operator that registers the library of them.

``setup/assets.py`` (``make assets``) builds the library. Of its materials each has the name of a preset as a custom
property; an object that one is dropped on gets that preset.
"""

from collections.abc import Iterable
from pathlib import Path

import bpy
from bpy.app.handlers import persistent
from bpy.props import StringProperty

from ...sim.errors import InputError
from ..props import material_props
from ..text import report_errors

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
