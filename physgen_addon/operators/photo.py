# SPDX-License-Identifier: GPL-3.0-or-later
"""Choose the photo that is to become a scene, and keep its list of boxes."""

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ...sim.errors import InputError
from ..bridge.photo_image import SUFFIXES, load_photo_image
from ..photo_masks import drop_mask
from ..reports import reports_errors
from ..views import TAB, show_beside


def set_photo(scene: bpy.types.Scene, path: Path) -> None:
    """Make the photo at ``path`` the one of ``scene``; the boxes of another go. Raises InputError if it is none."""
    image, size = load_photo_image(path)
    state = scene.physgen_photo
    old = state.image
    state.image, (state.width, state.height) = image, size
    if Path(bpy.path.abspath(state.path)) != path:
        for box in state.boxes:
            drop_mask(box)
        state.boxes.clear()
        state.has_found = False
    state.path = str(path)
    if old is not None and old.users == 0:
        bpy.data.images.remove(old)


class PHYSGEN_OT_open_photo(bpy.types.Operator):
    """Choose a photo that becomes a scene: draw a box around each object, then press Reconstruct"""

    bl_idname = "physgen.open_photo"
    bl_label = "Start from a Photo"
    bl_options = {"UNDO"}  # noqa: RUF012

    filepath: StringProperty(name="Photo", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=";".join(f"*{suffix}" for suffix in SUFFIXES), options={"HIDDEN"})

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Load and show it."""
        if not self.filepath.strip():
            raise InputError("no photo is chosen; choose a JPEG, PNG, TIFF or WebP file")
        set_photo(context.scene, Path(bpy.path.abspath(self.filepath)).resolve())
        show_beside(context, context.scene.physgen_photo.image, TAB)
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """A dropped file at once; otherwise ask for one."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}


class PHYSGEN_OT_use_image(bpy.types.Operator):
    """Start from the photo that this image editor shows"""

    bl_idname = "physgen.use_image"
    bl_label = "Use This Image"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """It is a file."""
        image = getattr(context.space_data, "image", None)
        if image is None or image.source != "FILE" or not image.filepath:
            cls.poll_message_set("The image editor shows no picture that is a file")
            return False
        return True

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        """Take it."""
        path = bpy.path.abspath(context.space_data.image.filepath)
        set_photo(context.scene, Path(path).resolve())
        context.space_data.image = context.scene.physgen_photo.image
        return {"FINISHED"}


class PHYSGEN_OT_remove_box(bpy.types.Operator):
    """Remove the chosen box"""

    bl_idname = "physgen.remove_box"
    bl_label = "Remove Box"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """One is chosen."""
        state = context.scene.physgen_photo
        return 0 <= state.box_index < len(state.boxes)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove it; the next one is chosen."""
        state = context.scene.physgen_photo
        drop_mask(state.boxes[state.box_index])
        state.boxes.remove(state.box_index)
        state.box_index = max(0, min(state.box_index, len(state.boxes) - 1))
        return {"FINISHED"}


class PHYSGEN_FH_photo(bpy.types.FileHandler):
    """A photo that is dropped on PhysGen's tab. Elsewhere Blender's own use of pictures goes first, and stays."""

    bl_idname = "PHYSGEN_FH_photo"
    bl_label = "PhysGen: Start from This Photo"
    bl_import_operator = "physgen.open_photo"
    bl_file_extensions = ";".join(SUFFIXES)

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Onto a sidebar that shows the tab."""
        area, region = context.area, context.region
        if area is None or region is None or area.type not in ("VIEW_3D", "IMAGE_EDITOR") or region.type != "UI":
            return False
        return region.active_panel_category == TAB


CLASSES = (PHYSGEN_OT_open_photo, PHYSGEN_OT_use_image, PHYSGEN_OT_remove_box, PHYSGEN_FH_photo)


def _draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator(PHYSGEN_OT_open_photo.bl_idname, text="PhysGen Photo (.jpg, .png)")


def register() -> None:
    """Into File > Import."""
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    """Out of it."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
