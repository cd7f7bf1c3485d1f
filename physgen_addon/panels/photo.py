# SPDX-License-Identifier: GPL-3.0-or-later
"""Start from a photo: the photo, its boxes, Reconstruct. In the image editor, and in the 3D viewport's Scene panel."""

from __future__ import annotations

from typing import Any

import bpy

from ...sim.errors import PhysGenError
from .. import text
from ..operators.draw_box import PHYSGEN_OT_draw_box
from ..operators.photo import PHYSGEN_OT_open_photo, PHYSGEN_OT_remove_box, PHYSGEN_OT_use_image
from ..operators.reconstruct import PHYSGEN_OT_reconstruct
from ..photo_request import scene_folder
from ..photo_scene import made_folder
from ..views import TAB
from .job import draw_job
from .photo_details import draw_asking, draw_camera, draw_details, draw_files


class PHYSGEN_UL_boxes(bpy.types.UIList):
    """The boxes: name of the object, and its size."""

    def draw_item(
        self,
        context: bpy.types.Context,
        layout: bpy.types.UILayout,
        data: Any,
        item: Any,
        icon: int,
        active_data: Any,
        active_property: str,
    ) -> None:
        """The name can be changed by a double click."""
        row = layout.row(align=True)
        row.prop(item, "name", text="", emboss=False, icon="SELECT_SET")
        right = row.row()
        right.alignment = "RIGHT"
        right.label(text=text.length(item.size_m) if item.size_m > 0 else "")


def draw_photo(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """All that it takes from a photo to a scene."""
    state = context.scene.physgen_photo
    column = layout.column(align=True)
    column.operator(PHYSGEN_OT_open_photo.bl_idname, text="Open Photo" if state.image is None else state.image.name)
    editor = context.space_data.type == "IMAGE_EDITOR"
    if editor and context.space_data.image not in (None, state.image):
        column.operator(PHYSGEN_OT_use_image.bl_idname, icon="IMAGE_DATA")
    if state.image is None:
        text.sentences(layout, context, "A photo of things that stand on a table or floor. It can be dropped here.")
        return
    _draw_boxes(layout, context, state)
    if 0 <= state.box_index < len(state.boxes):
        draw_details(layout, context, state.boxes[state.box_index])
    draw_camera(layout, context, state)
    draw_files(layout, context, state)
    draw_asking(layout, context, state)
    layout.prop(state, "output", text="Save To")
    if not state.output.strip():
        try:
            text.sentences(layout, context, f"Makes {scene_folder(state).name} beside the {_beside()}.")
        except PhysGenError as error:
            text.sentences(layout, context, str(error), icon="ERROR")
    row = layout.row()
    row.scale_y = 1.4
    again = made_folder(state) is not None
    row.operator(
        PHYSGEN_OT_reconstruct.bl_idname, text="Reconstruct Again" if again else "Reconstruct", icon="MESH_MONKEY"
    )
    if again:
        text.sentences(layout, context, "Only what a change concerns is done anew; physics that you changed stays.")
    draw_job(layout)


def _draw_boxes(layout: bpy.types.UILayout, context: bpy.types.Context, state: bpy.types.PropertyGroup) -> None:
    row = layout.row()
    row.template_list("PHYSGEN_UL_boxes", "", state, "boxes", state, "box_index", rows=3)
    buttons = row.column(align=True)
    buttons.operator(PHYSGEN_OT_draw_box.bl_idname, text="", icon="ADD")
    buttons.operator(PHYSGEN_OT_remove_box.bl_idname, text="", icon="REMOVE")
    layout.operator(PHYSGEN_OT_draw_box.bl_idname, icon="SELECT_SET")
    if not state.boxes:
        text.sentences(layout, context, "Draw a box around each object that is to move.")
        return
    if not 0 <= state.box_index < len(state.boxes):
        return
    box = state.boxes[state.box_index]
    column = layout.column(align=True)
    column.use_property_split, column.use_property_decorate = True, False
    column.prop(box, "size_m")
    if not any(other.size_m > 0 for other in state.boxes):
        text.sentences(layout, context, "Give one object its size; without one it is guessed.")


def _beside() -> str:
    return ".blend file" if bpy.data.filepath else "photo"


class PHYSGEN_PT_photo(bpy.types.Panel):
    """A photo that becomes a scene"""

    bl_idname = "PHYSGEN_PT_photo"
    bl_label = "Start from a Photo"
    bl_space_type, bl_region_type, bl_category = "IMAGE_EDITOR", "UI", TAB

    def draw(self, context: bpy.types.Context) -> None:
        """The same as in the 3D viewport."""
        draw_photo(self.layout, context)


CLASSES = (PHYSGEN_UL_boxes, PHYSGEN_PT_photo)
